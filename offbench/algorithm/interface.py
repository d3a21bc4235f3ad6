"""What an algorithm is.

    class Config            frozen dataclass of `setting`s: CLI flags, help, config.json; the training itself
                            reads batch_size, normalize and, if there is one, top (share of best episodes)
    class Algorithm(config, observation_dim, action_dim, run_seeds, device)
        draws               the random numbers of one update, by name
        kind(step)          which sort of update comes at a step
        update(batch, noise, kind) -> {name: [runs]}
        learned             {name: Network, Target or Learned}: all that a checkpoint keeps
        policy(run)         the policy file's kind and layers

Every tensor has the run axis first; runs of a stack share shapes and every setting that is not `per_run`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from offbench.common.errors import OffbenchError


class Batch(NamedTuple):
    """Transitions of one update.

    Attributes:
        observations, next_observations: [runs, batch, obs], normalised if the settings say so.
        actions: [runs, batch, act] in [-1, 1].
        rewards: [runs, batch].
        masks: [runs, batch], 1 - terminations: 0 where nothing is left to bootstrap from.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    masks: Tensor


class Draw(NamedTuple):
    """Random numbers of one update of one run: their shape and how they are distributed."""

    shape: tuple[int, ...]
    distribution: Literal["normal", "uniform"]  # uniform in [-1, 1]


class PolicyParts(NamedTuple):
    """A policy file's kind (see offbench/policy.py) and weights, each layer (weight [in, out], bias [out]).

    Attributes:
        activation: between the layers, `relu` or `tanh`.
        critic, samples: for the kind `best_by_q` alone: Q of (observation, action), and how many to choose from.
    """

    kind: str
    layers: list[tuple[Tensor, Tensor]]
    critic: list[tuple[Tensor, Tensor]] = []  # noqa: RUF012 (never changed)
    samples: int = 1
    activation: str = "relu"


class Keeps(Protocol):
    """Something whose tensors belong into a checkpoint (a network, a target, a temperature)."""

    def tensors(self) -> dict[str, Tensor]: ...


class Algorithm(Protocol):
    """A stack of runs of one algorithm."""

    Config: ClassVar[type]
    learned: Mapping[str, Keeps]

    def __init__(
        self,
        config: Any,
        observation_dim: int,
        action_dim: int,
        run_seeds: Sequence[int],
        device: torch.device | str,
    ) -> None: ...

    @property
    def draws(self) -> dict[str, Draw]:
        """The random numbers that each update gets, beside the batch."""
        ...

    def kind(self, step: int) -> str:
        """Return which sort of update comes at `step` (from 0)."""
        ...

    def update(self, batch: Batch, noise: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
        """Do one update in place; return what is logged, each [runs]."""
        ...

    def policy(self, run: int) -> PolicyParts:
        """Return what the policy file of one run is made of."""
        ...


def check_logs(logs: Any, runs: int, where: str) -> None:
    """Raise OffbenchError if an update returned something else than logs, each a tensor [runs]; reads shapes alone."""
    if not isinstance(logs, Mapping):
        raise OffbenchError(f"{where} must return a dict of logs, not a {type(logs).__name__}")
    for name, value in logs.items():
        tensor = isinstance(value, Tensor)
        if not tensor or value.shape != (runs,):
            found = f"one {list(value.shape)}" if tensor else f"a {type(value).__name__}"
            raise OffbenchError(f"{where}: log {name!r} must be a tensor [runs] = [{runs}], got {found}")
        if value.requires_grad:  # the sums of logs would keep the graph of every update
            raise OffbenchError(f"{where}: log {name!r} must be detached: {name}.detach()")


def stack_configs(configs: Sequence[Any], device: torch.device | str) -> Any:
    """Return one config for a stack: `per_run` settings as tensors [runs], the others as they are.

    A word among numbers (beta = "adaptive") becomes -1 minus its place among the setting's choices.

    Raises:
        OffbenchError: the runs differ in a setting that cannot differ within a stack.
    """
    values: dict[str, Any] = {}
    for field in dataclasses.fields(configs[0]):
        column = [getattr(config, field.name) for config in configs]
        if field.metadata.get("per_run"):
            words = field.metadata.get("choices") or ()
            numbers = [-1.0 - words.index(value) if isinstance(value, str) else float(value) for value in column]
            values[field.name] = torch.tensor(numbers, dtype=torch.float32, device=device)
        elif any(value != column[0] for value in column):
            raise OffbenchError(f"runs of one stack cannot differ in {field.name}")
        else:
            values[field.name] = column[0]
    return SimpleNamespace(**values)
