"""`evaluate --similarity`: how often a policy's action counts as the dataset's (the BDB paper's Table 2).

The paper gives no formula; its numbers count samples of a batch of 256 that pass a yes/no test "based on the current
Q-value". offbench computes two readings of it:

    q_similar       |Q1(s, pi(s)) - Q1(s, a)| <= tolerance |Q1(s, a)|
    action_similar  root mean square of pi(s) - a over the dimensions <= action_tolerance, actions in [-1, 1]
"""

from __future__ import annotations

import dataclasses
import math
import shlex
from dataclasses import dataclass
from pathlib import Path

from offbench.common.errors import OffbenchError
from offbench.common.files import read_json, write_json
from offbench.common.scores import MAX_VALUE
from offbench.common.seeds import Purpose, check_seed, generator
from offbench.common.settings import check_count, read_back
from offbench.training.run import Run


class NoCriticError(OffbenchError):
    """A run's algorithm has no critic, so it has no similar score."""


@dataclass(frozen=True)
class Similarity:
    """A run's similarity.json.

    Attributes:
        step: step of the checkpoint.
        samples: transitions drawn from the run's dataset.
        q_similar, action_similar: percent of the samples, by the two readings.
    """

    step: int
    samples: int
    q_similar: float
    tolerance: float
    action_similar: float
    action_tolerance: float

    def __post_init__(self) -> None:
        """Raise OffbenchError for numbers that no evaluation has."""
        percents, tolerances = (self.q_similar, self.action_similar), (self.tolerance, self.action_tolerance)
        if self.step < 0 or self.samples < 1 or not all(0 <= percent <= 100 for percent in percents):
            raise OffbenchError("step, samples or a percentage is out of range")
        if not all(0 <= tolerance < MAX_VALUE for tolerance in tolerances):
            raise OffbenchError("a tolerance is out of range")


def similarity(
    path: str | Path,
    *,
    tolerance: float = 0.05,
    action_tolerance: float = 0.1,
    samples: int = 2560,
    seed: int = 0,
    algorithm: str | type | None = None,
) -> Similarity:
    """Return a run's similar score in both readings, and write it to the run's similarity.json.

    Args:
        path: the run's folder.
        samples: transitions drawn from the run's dataset (ten batches of 256).
        algorithm: the run's algorithm, if no installed package has it: `./my_algo.py:ReBRAC`, or the class.

    Raises:
        NoCriticError: the algorithm has no critic.
        OffbenchError: no run or checkpoint there, or the algorithm's code has changed.
    """
    import torch  # slow to import; reports only read similarity.json

    from offbench.training.restore import restore

    if not (0 <= tolerance < math.inf and 0 <= action_tolerance < math.inf):
        raise OffbenchError(f"tolerances must be finite numbers from 0, not {tolerance} and {action_tolerance}")
    samples, seed = check_count("samples", samples), check_seed(seed)
    run = Run(Path(path))
    stack = restore(run, algorithm)
    rng = generator(seed, Purpose.SAMPLE)
    batch = stack.store.batch(torch.from_numpy(rng.integers(stack.store.sizes[0], size=(1, samples))))
    policy = stack.normalized_policy(0)  # as the critic sees observations and actions
    noise = policy.draw(rng, samples) if policy.needs_noise(deterministic=True) else None
    pi = torch.from_numpy(policy.act(batch.observations[0].numpy(), noise)).unsqueeze(0)
    q_pi, q_data = (stack.algorithm.q_values(batch.observations, a) for a in (pi, batch.actions))
    if q_pi is None or q_data is None:
        raise NoCriticError(f"{path}: {run.config().algorithm} has no critic to compare by")
    distance = (pi - batch.actions).square().mean(-1).sqrt().flatten()
    score = Similarity(
        stack.step,
        samples,
        100 * float(((q_pi - q_data).abs() <= tolerance * q_data.abs()).float().mean()),
        tolerance,
        100 * float((distance <= action_tolerance).float().mean()),
        action_tolerance,
    )
    with run.locked():
        write_json(_file(run), dataclasses.asdict(score))
    return score


def read_similarity(run: Run) -> Similarity | None:
    """Read a run's similarity.json; None if there is none. Raises OffbenchError if it is damaged."""
    path = _file(run)
    if not path.exists():
        return None
    remedy = f"write it again with `offbench evaluate {shlex.quote(str(run.folder))} --similarity`"
    return read_back(Similarity, read_json(path, remedy), path, remedy)


def _file(run: Run) -> Path:
    return run.folder / "similarity.json"
