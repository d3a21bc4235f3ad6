"""Where the time of a recording and of an update goes: `python -m tests.speed.profile`, with nothing else running.

Writes docs/results/profile-KIND.md, KIND the processor's vector instructions. One process of one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import mujoco
import pytest

from offbench import networks, perceptron
from offbench.environments import make_env
from offbench.files import write_bytes
from offbench.ladder import read_ladder
from offbench.provenance import hardware
from offbench.recipes import load_recipe
from offbench.rollout import LANES, Episode, Task, play
from offbench.tables import markdown
from tests.speed.__main__ import DOCS
from tests.speed.sides import ENV, train

ROUNDS = 5  # the least of so many is taken: whatever disturbs adds to it
PRODUCTS, OPTIMISER = "matrix products, biases and activations of the forward passes", "Adam and Polyak averaging"
WATCHED = [
    (perceptron, "affine", PRODUCTS),
    (perceptron, "product", PRODUCTS),
    (networks.Learned, "descend", OPTIMISER),
    (networks.Target, "follow", OPTIMISER),
]


def recording() -> dict[str, float]:
    """Return microseconds a step: of the physics, of the rest of the environment, and of all that is around it."""
    recipe = load_recipe(ENV)
    assert recipe.folder is not None
    ladder = read_ladder(recipe.folder / "behaviour")
    assert ladder is not None
    policy = ladder.load(ladder.role("medium")).to_bytes()
    task = Task(recipe.env_spec(), policy, 0, (), tuple(range(LANES)), False, False)
    episodes = [episode for episode in play(task) if isinstance(episode, Episode)]
    env = make_env(task.spec)
    inner: Any = env.unwrapped
    model, data, skip = inner.model, inner.data, inner.frame_skip

    def physics(action: Any) -> None:
        data.ctrl[:] = action
        mujoco.mj_step(model, data, nstep=skip)

    def along(step: Callable[[Any], Any]) -> float:
        spent = 0.0
        for episode in episodes:
            env.reset(seed=episode.seed)
            began = time.perf_counter()
            for action in episode.actions:
                step(action)
            spent += time.perf_counter() - began
        return spent

    def whole() -> float:
        began = time.perf_counter()
        play(task)
        return time.perf_counter() - began

    steps = sum(map(len, episodes))
    ways = (lambda: along(physics), lambda: along(env.step), whole)
    alone, step, everything = (1e6 * min(way() for _ in range(ROUNDS)) / steps for way in ways)
    return {
        "mj_step": alone,
        "the rest of Gymnasium's step: observation, reward, end": step - alone,
        "policy and bookkeeping of a worker": everything - step,
    }


def update(algorithm: str) -> dict[str, float]:
    """Return milliseconds of an update (2-layer networks): in matrix products, in the optimiser, and in all else."""
    spent: dict[str, float] = {}

    def timed(owner: Any, name: str, part: str) -> Callable[..., Any]:
        function = getattr(owner, name)

        def call(*arguments: Any, **named: Any) -> Any:
            began = time.perf_counter()
            found = function(*arguments, **named)
            spent[part] += time.perf_counter() - began
            return found

        return call

    work = train(algorithm, hidden="256,256")
    with pytest.MonkeyPatch.context() as patch:
        for owner, name, part in WATCHED:
            patch.setattr(owner, name, timed(owner, name, part))
        found = []
        for _ in range(ROUNDS):
            spent = dict.fromkeys((part for _, _, part in WATCHED), 0.0)
            began = time.perf_counter()
            updates = work()
            whole = 1e3 * (time.perf_counter() - began) / updates
            found.append((whole, {part: 1e3 * seconds / updates for part, seconds in spent.items()}))
    everything, parts = min(found, key=lambda pair: pair[0])
    rest = "all else: losses, gradients of activations, sampling, overhead of small operations"
    return parts | {rest: everything - sum(parts.values())}


def rows(what: str, unit: str, parts: dict[str, float]) -> list[list[str]]:
    """Return the parts as rows of a table, with their shares."""
    whole = sum(parts.values())
    return [[what, name, f"{value:.2f} {unit}", f"{100 * value / whole:.0f}%"] for name, value in parts.items()]


def main() -> None:
    """Measure, print and write."""
    found = rows("a recorded step of hopper, medium", "µs", recording())
    for algorithm in ("td3_bc", "bdb", "cql"):
        found += rows(f"an update of {algorithm}", "ms", update(algorithm))
    text = "\n".join(markdown(["of", "part", "takes", "share"], found)) + "\n"
    print(text)
    write_bytes(DOCS / "results" / f"profile-{hardware()['hardware']['vectors'].lower()}.md", text.encode())


if __name__ == "__main__":
    main()
