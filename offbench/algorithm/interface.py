"""What an algorithm is: a subclass of `Algorithm`.

    Config                      frozen dataclass of `setting`s: CLI flags, help, config.json; the training itself
                                reads batch_size, normalize and, if there is one, top (share of best episodes)
    setup(c)                    creates the networks; every one that is an attribute is part of a checkpoint
    noise_spec(c)               the random numbers of one update, by name
    phase(step)                 the kind of update at a step
    update(batch, noise, phase) one update, in place; returns {name: [runs]}, the columns of losses.csv
    policy(run)                 the policy file's kind and layers

Every tensor has the run axis first; runs of a stack share shapes and every setting that is not `per_run`.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Hashable, Iterator, Mapping, Sequence
from numbers import Integral
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, NamedTuple, Protocol, Unpack

import torch
from torch import Tensor
from typing_extensions import TypeVar

from offbench.algorithm.networks import Network, NetworkOptions, Parameters, Schedule
from offbench.common.errors import OffbenchError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

C = TypeVar("C", default=Any)

NOT_LOADED = torch.empty(0, device="meta")  # an operation on it fails


class Batch(NamedTuple):
    """Transitions of one update.

    Attributes:
        observations, next_observations: [runs, batch, obs], normalized if the settings say so.
        actions: [runs, batch, act] in [-1, 1].
        rewards: [runs, batch].
        masks: [runs, batch], 1 - terminations: 0 where nothing is left to bootstrap from.
        next_actions: [runs, batch, act], the data's actions at the next observations; only for an algorithm that sets
            `uses_next_actions`.
        next_action_masks: [runs, batch], 0 where the data has no next action, at the end of an episode: next_actions
            holds zeros there.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    masks: Tensor
    next_actions: Tensor = NOT_LOADED
    next_action_masks: Tensor = NOT_LOADED


class Distribution(NamedTuple):
    """The shape and distribution of random numbers for one update of one run."""

    shape: tuple[int, ...]
    name: Literal["normal", "uniform"]


def normal(*shape: int) -> Distribution:
    """Return the standard normal distribution, for an array of a shape."""
    return Distribution(shape, "normal")


def uniform(*shape: int) -> Distribution:
    """Return the uniform distribution in [-1, 1], for an array of a shape."""
    return Distribution(shape, "uniform")


NoiseSpec = dict[str, Distribution]
Noise = Mapping[str, Tensor]  # each [runs, *shape]
Logs = dict[str, Tensor]  # each [runs]


class PolicyParts(NamedTuple):
    """A policy file's kind (see offbench/rollouts/policy.py) and weights, each layer (weight [in, out], bias [out]).

    Attributes:
        activation: activation between the layers, `relu` or `tanh`.
        critic, samples: only for the kind `best_by_q`: Q of (observation, action), and the number of actions to choose
            from.
    """

    kind: str
    layers: list[tuple[Tensor, Tensor]]
    critic: list[tuple[Tensor, Tensor]] = []  # noqa: RUF012 (never changed)
    samples: int = 1
    activation: str = "relu"


class Learned(Protocol):
    """Something whose tensors belong in a checkpoint: a network, a target, a temperature."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by name, each [ensemble, runs, ...] or []: a resume writes into them."""
        ...


class Algorithm(Generic[C]):
    """A stack of runs of one algorithm: `class TD3BC(Algorithm[Config])`, Config being its settings.

    Args:
        config: what `stack_configs` returns for the runs' Configs: each setting that is `per_run` is a tensor [runs].
        observation_dim, action_dim: widths of observations and actions.
        run_seeds: one seed for each run.
        device: where the networks are, and all tensors of an update.

    Attributes:
        capture: whether updates may be recorded and replayed, which is faster. A replay repeats only tensor
            operations, so all updates of a phase must do the same ones.
        uses_next_actions: whether batches hold `next_actions`.
    """

    Config: ClassVar[type[DataclassInstance]]
    capture: ClassVar[bool] = True
    uses_next_actions: ClassVar[bool] = False

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        for base in cls.__dict__.get("__orig_bases__", ()):
            if typing.get_origin(base) is Algorithm and isinstance(typing.get_args(base)[0], type):
                cls.Config = typing.get_args(base)[0]

    def __init__(
        self,
        config: C,
        observation_dim: int,
        action_dim: int,
        run_seeds: Sequence[int],
        device: torch.device | str,
    ) -> None:
        self.config = config
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self.run_seeds, self.device = tuple(run_seeds), torch.device(device)
        self._networks = 0  # number of networks so far: the index of the next one, which its weights depend on
        self.setup(config)

    def setup(self, c: C) -> None:
        """Create the networks, as attributes. Their initial weights depend on the order of creation."""
        raise NotImplementedError(f"{type(self).__name__} has no setup(c)")

    def noise_spec(self, c: C) -> NoiseSpec:
        """Return the random numbers that each update gets; nothing else in an update may be random."""
        return {}

    def phase(self, step: int) -> Hashable:
        """Return the kind of update at `step`, from 0. All updates of a phase do the same operations."""
        return None

    def update(self, batch: Batch, noise: Noise, phase: Any) -> Logs:
        """Perform one update of every run; return what is logged, always the same names in a phase."""
        raise NotImplementedError(f"{type(self).__name__} has no update(batch, noise, phase)")

    def policy(self, run: int) -> PolicyParts:
        """Return what the policy file of one run is made of; by default the network `actor`.

        It is a `tanh` policy, or a `squashed_gaussian` if the network has two outputs for each action dimension.
        """
        actor = getattr(self, "actor", None)
        if not isinstance(actor, Network):
            raise OffbenchError(f"{type(self).__name__} has no network `actor`: make it in setup, or define policy")
        kind = "tanh" if actor.sizes[-1] == self.action_dim else "squashed_gaussian"
        return PolicyParts(kind, actor.layers(run), activation=actor.activation)

    def q_values(self, observations: Tensor, actions: Tensor) -> Tensor | None:
        """Return Q(s, a) [runs, batch] for the similar score, None if the algorithm has no critic.

        By default that of the network `critic`, the first of an ensemble.

        Args:
            observations: [runs, batch, obs], normalized if the settings say so.
            actions: [runs, batch, act] in [-1, 1].
        """
        critic = getattr(self, "critic", None)
        return critic.frozen(observations, actions, members=0) if isinstance(critic, Network) else None

    @property
    def learned(self) -> dict[str, Learned]:
        """Everything that a checkpoint keeps: networks, targets and parameters among the attributes, by name."""
        return dict(_learned("", vars(self)))

    def network(
        self,
        inputs: int,
        outputs: int | None,
        learning_rate: float | Schedule,
        *,
        ensemble_size: int | None = None,
        **options: Unpack[NetworkOptions],
    ) -> Network:
        """Return a network for each run.

        Args:
            outputs: width of the outputs; None for a single number without an axis of its own.
            ensemble_size: networks for each run; None for a single one without an ensemble axis.
            options: see `Network`; `hidden` is the setting of that name by default.
        """
        index, self._networks = self._networks, self._networks + 1
        if "hidden" not in options:
            settings: Any = self.config
            options["hidden"] = settings.hidden
        return Network(
            inputs=inputs,
            outputs=outputs,
            run_seeds=self.run_seeds,
            index=index,
            learning_rate=learning_rate,
            ensemble_size=ensemble_size,
            device=self.device,
            **options,
        )

    def actor_network(
        self, outputs: int, learning_rate: float | Schedule, **options: Unpack[NetworkOptions]
    ) -> Network:
        """Return a network from observations to `outputs`: [runs, batch, outputs]."""
        return self.network(self.observation_dim, outputs, learning_rate, **options)

    def critic_network(
        self, learning_rate: float | Schedule, ensemble_size: int | None = 2, **options: Unpack[NetworkOptions]
    ) -> Network:
        """Return an ensemble from observations and actions to a number: [ensemble, runs, batch]."""
        inputs = self.observation_dim + self.action_dim
        return self.network(inputs, None, learning_rate, ensemble_size=ensemble_size, **options)

    def value_network(self, learning_rate: float | Schedule, **options: Unpack[NetworkOptions]) -> Network:
        """Return a network from observations to a number: [runs, batch]."""
        return self.network(self.observation_dim, None, learning_rate, **options)

    def parameters(self, size: int | None, learning_rate: float | Schedule, initial: float = 0.0) -> Parameters:
        """Return `size` numbers for each run, `value` [runs, size], or one, `value` [runs], if `size` is None."""
        flat = torch.full((1, len(self.run_seeds), size or 1), initial, device=self.device)
        return Parameters(flat, learning_rate, scalar=size is None)


def _learned(prefix: str, values: Mapping[Any, Any]) -> Iterator[tuple[str, Learned]]:
    """Yield the learned parts among values, those in lists and dicts too, with their names: `critic`, `critics.0`."""
    for name, value in values.items():
        if isinstance(value, list | tuple):
            value = dict(enumerate(value))
        if isinstance(value, dict):
            yield from _learned(f"{prefix}{name}.", value)
        elif callable(getattr(value, "tensors", None)):
            yield f"{prefix}{name}", value


def check_logs(logs: object, runs: int, where: str) -> None:
    """Raise OffbenchError unless an update returned logs, each a tensor [runs]; reads only shapes."""
    if not isinstance(logs, Mapping):
        raise OffbenchError(f"{where} must return a dict of logs, not a {type(logs).__name__}")
    if "step" in logs:
        raise OffbenchError(f"{where}: 'step' is the column of steps in losses.csv; give that log another name")
    for name, value in logs.items():
        tensor = isinstance(value, Tensor)
        if not tensor or value.shape != (runs,):
            got = f"one {list(value.shape)}" if tensor else f"a {type(value).__name__}"
            raise OffbenchError(f"{where}: log {name!r} must be a tensor [runs] = [{runs}], got {got}")


def check_noise_spec(spec: object, where: str) -> None:
    """Raise OffbenchError unless a noise_spec has a known distribution, with a valid shape, for each name."""
    if not isinstance(spec, Mapping):
        raise OffbenchError(f"{where} must return a dict, not a {type(spec).__name__}")
    for name, distribution in spec.items():
        known = isinstance(distribution, Distribution) and distribution.name in ("normal", "uniform")
        if not known or not all(isinstance(size, Integral) and int(size) >= 0 for size in distribution.shape):
            wanted = "normal(*shape) or uniform(*shape) with sizes from 0"
            raise OffbenchError(f"{where}: {name!r} must be {wanted}, not {distribution!r:.80}")


class _NumbersOrWords(NamedTuple):
    """A setting that is a number in some runs of a stack and a word in others."""

    numbers: Tensor  # [runs], NaN where it is a word
    words: dict[str, Tensor]  # [runs] of each word: whether the run has it


def per_sample(value: Any, **words: Tensor) -> Tensor:
    """Return a `per_run` setting as [runs, 1], to combine with [runs, batch].

    Args:
        words: for a setting that can also be a word: the values in runs with that word, [runs, batch]. The result
            then has this shape.
    """
    if not isinstance(value, _NumbersOrWords):
        result: Tensor = value.unsqueeze(-1)
        return result
    result = value.numbers.unsqueeze(-1)
    for word, tensor in words.items():
        result = torch.where(value.words[word].unsqueeze(-1), tensor, result)
    return result


def has_word(value: Any, word: str) -> Tensor:
    """Return in which runs a `per_run` setting is a word, [runs]."""
    mask: Tensor = value.words[word]
    return mask


def stack_configs(configs: Sequence[DataclassInstance], device: torch.device | str) -> Any:
    """Return one config for a stack: `per_run` settings as tensors [runs], the others as they are.

    A `per_run` setting that may be a word (beta = "adaptive") is read by `per_sample`.

    Raises:
        OffbenchError: the runs differ in a setting that cannot differ within a stack.
    """
    values: dict[str, Any] = {}
    for field in dataclasses.fields(configs[0]):
        column = [getattr(config, field.name) for config in configs]
        if field.metadata.get("per_run"):
            numbers = [float("nan") if isinstance(value, str) else float(value) for value in column]
            tensor = torch.tensor(numbers, dtype=torch.float32, device=device)
            words = {
                word: torch.tensor([value == word for value in column], device=device)
                for word in field.metadata.get("choices") or ()
            }
            values[field.name] = _NumbersOrWords(tensor, words) if words else tensor
        elif any(value != column[0] for value in column):
            raise OffbenchError(f"runs of one stack cannot differ in {field.name}")
        else:
            values[field.name] = column[0]
    return SimpleNamespace(**values)
