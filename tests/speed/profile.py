"""Where the time of a recording and of an update goes: `python -m tests.speed.profile`, with nothing else running.

Writes docs/results/profile-KIND.md, KIND the processor's vector instructions. One process of one thread.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch

from offbench.agents.ladder import read_ladder
from offbench.algorithm import mlp
from offbench.algorithm.bfloat16_layer import Bfloat16Layer
from offbench.algorithm.cpu_capture import Trace
from offbench.algorithm.mlp import matmul_backend
from offbench.common.files import write_bytes
from offbench.common.provenance import hardware, has_bfloat16
from offbench.common.tables import markdown
from offbench.envs.environments import make_env
from offbench.envs.recipes import load_recipe
from offbench.rollouts.rollouts import PARALLEL_EPISODES, EpisodeTask, play
from offbench.training.captured_update import TRACED_UPDATES
from tests.speed.__main__ import DOCS
from tests.speed.sides import ENV, stack_of

ROUNDS = 5  # the least of so many is taken: whatever disturbs adds to it
PRODUCTS, ACTIVATIONS = "matrix products, biases included", "activations and the products with one output's gradient"
HALVES = "matrix products in bfloat16, with the rounding of their factors and results"
OPTIMISER, REST = "Adam and Polyak averaging", "all else: losses, sampling, copies, overhead of small operations"


def recording() -> dict[str, float]:
    """Return microseconds a step: of the physics, of the rest of the environment, and of all that is around it."""
    recipe = load_recipe(ENV)
    assert recipe.folder is not None
    ladder = read_ladder(recipe.folder / "behaviour")
    assert ladder is not None
    policy = ladder.load(ladder.role("medium")).to_bytes()
    task = EpisodeTask(recipe.env_spec(), policy, 0, (), tuple(range(PARALLEL_EPISODES)), False)
    episodes = play(task)
    env = make_env(task.env_spec)
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


def update(algorithm: str, precision: str) -> dict[str, float]:
    """Return milliseconds of an update (2-layer networks), by what a replay calls."""
    with matmul_backend("bfloat16" if precision == "bfloat16" else "numpy"):
        stack = stack_of(algorithm)
        stack.train(2 * TRACED_UPDATES)  # records each phase
    kinds = [list(calls(recording)) for recording in stack.captured_update._traces.values()]
    spent: dict[str, float] = {}
    with torch.inference_mode():
        for part, call in itertools.chain(*kinds):
            found = []
            for _ in range(ROUNDS):
                began = time.perf_counter()
                call()
                found.append(time.perf_counter() - began)
            spent[part] = spent.get(part, 0.0) + 1e3 * min(found) / len(kinds)
    return spent


def calls(trace: Trace) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield each call of a replay, those within the networks' passes one by one, with the part that it belongs to."""
    for call in trace.calls:
        owner = getattr(call, "__self__", None)
        if isinstance(owner, mlp.ForwardPass | mlp.BackwardPass):
            for inner in owner.calls:
                function = inner.func if isinstance(inner, partial) else inner
                bfloat16 = isinstance(getattr(function, "__self__", None), Bfloat16Layer)
                named = {np.matmul: PRODUCTS, np.copyto: REST}
                yield HALVES if bfloat16 else named.get(function, ACTIVATIONS), inner
        else:
            function = call.func if isinstance(call, partial) else call
            name = getattr(function, "__name__", str(function))
            yield OPTIMISER if name.startswith(("_fused_adam", "lerp")) else REST, call


def rows(what: str, unit: str, parts: dict[str, float]) -> list[list[str]]:
    """Return the parts as rows of a table, with their shares."""
    whole = sum(parts.values())
    return [[what, name, f"{value:.2f} {unit}", f"{100 * value / whole:.0f}%"] for name, value in parts.items()]


def main() -> None:
    """Measure, print and write."""
    found = rows("a recorded step of hopper, medium", "µs", recording())
    for precision in ("float32", "bfloat16") if has_bfloat16() else ("float32",):
        for algorithm in ("td3_bc", "bdb", "cql"):
            found += rows(f"an update of {algorithm}, {precision}", "ms", update(algorithm, precision))
    text = "\n".join(markdown(["of", "part", "takes", "share"], found)) + "\n"
    print(text)
    write_bytes(DOCS / "results" / f"profile-{hardware()['vectors'].lower()}.md", text.encode())


if __name__ == "__main__":
    main()
