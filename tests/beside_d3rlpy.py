"""TD3+BC of d3rlpy on the data that ours has learned from: `python -m tests.beside_d3rlpy`, after `make bench` (which
installs d3rlpy) and `offbench benchmark baselines`, writes docs/results/beside-d3rlpy.md.

d3rlpy learns, in an environment of its own, from `offbench export --format npz` and hands its weights over as arrays;
here they play as offbench policies, 10 episodes every 5,000 updates as in the grid. Two seeds take some 10 minutes on
two cores.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
PEER = ROOT / ".venv-peers" / "bin" / "python"
FILE = ROOT / "docs" / "results" / "beside-d3rlpy.md"
DATASET, ENV_ID = "hopper-medium-v0", "Hopper-v5"
SEEDS, STEPS, EVERY, EPISODES = 2, 50_000, 5_000, 10


def learn(data: str, seed: str, folder: str, steps: str = str(STEPS), every: str = str(EVERY)) -> None:
    """Train d3rlpy's TD3+BC by its defaults; run by d3rlpy's interpreter. Leaves `folder`/<step>.npz."""
    import d3rlpy
    import torch

    torch.set_num_threads(1)
    d3rlpy.seed(int(seed))
    found = np.load(data, allow_pickle=False)
    keys = ("observations", "actions", "rewards", "terminals", "timeouts")
    dataset = d3rlpy.dataset.MDPDataset(*(found[key] for key in keys))
    scaler = d3rlpy.preprocessing.StandardObservationScaler()
    learner = d3rlpy.algos.TD3PlusBCConfig(observation_scaler=scaler).create(device="cpu:0")
    probe = found["observations"][:100]

    def hand_over(_: Any, __: int, step: int) -> None:
        linear = [m for m in learner.impl.policy.modules() if isinstance(m, torch.nn.Linear)]
        arrays = {f"w{i}": m.weight.detach().numpy().T for i, m in enumerate(linear)}
        arrays |= {f"b{i}": m.bias.detach().numpy() for i, m in enumerate(linear)}
        arrays |= {"mean": scaler.mean, "std": scaler.std + scaler.eps, "probe": probe}
        np.savez(Path(folder) / f"{step}.npz", **arrays, actions=learner.predict(probe))

    learner.fit(
        dataset,
        n_steps=int(steps),
        n_steps_per_epoch=int(every),
        show_progress=False,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        epoch_callback=hand_over,
    )


def play(path: Path, env_id: str = ENV_ID) -> tuple[float, float]:
    """Return mean return and mean length of what has been handed over; it must act here as it did there."""
    from offbench import evaluate
    from offbench.rollouts.policy import Policy

    found = np.load(path, allow_pickle=False)
    layers = tuple((found[f"w{i}"], found[f"b{i}"]) for i in range(3))
    bound = np.ones_like(layers[-1][1])  # d3rlpy's actions lie in [-1, 1], as hopper's do
    policy = Policy("tanh", layers, found["mean"].ravel(), found["std"].ravel(), -bound, bound, env_id)
    np.testing.assert_allclose(policy.act(found["probe"], None), found["actions"], atol=1e-4)
    file = path.with_suffix(".safetensors")
    file.write_bytes(policy.to_bytes())
    played = evaluate(file, episodes=EPISODES)
    return float(np.mean(played.returns)), float(np.mean(played.lengths))


def ours(runs: str) -> list[list[tuple[float, float]]]:
    """Return (mean return, mean length) of each evaluation of each of our runs."""
    from offbench.analysis.results import read_results

    entries = read_results(runs).entries.items()
    found = [entry for (task, method), entry in entries if (task.dataset, method.label) == (DATASET, "td3_bc")]
    if len(found) != 1:
        raise SystemExit(f"no runs of td3_bc on {DATASET} below {runs}: run `offbench benchmark baselines`")
    curves = [[np.mean(run.evaluations[step], axis=0) for step in steps()] for run in found[0].runs]
    return [[(float(ret), float(length)) for ret, length in curve] for curve in curves]


def steps() -> range:
    """Return the steps of the evaluations."""
    return range(EVERY, STEPS + 1, EVERY)


def theirs() -> list[list[tuple[float, float]]]:
    """Train and play d3rlpy's, all seeds at once."""
    from offbench import export

    with tempfile.TemporaryDirectory() as place:
        data = Path(place) / "data.npz"
        export(DATASET, data, style="npz")
        folders = [Path(place) / str(seed) for seed in range(SEEDS)]
        started = []
        for seed, folder in enumerate(folders):
            folder.mkdir()
            started.append(subprocess.Popen([PEER, __file__, data, str(seed), folder]))
        codes = [process.wait() for process in started]
        if any(codes):
            raise SystemExit("d3rlpy stopped: see above")
        return [[play(folder / f"{step}.npz") for step in steps()] for folder in folders]


def main() -> None:
    """Write the table."""
    from offbench.common.tables import markdown

    parser = argparse.ArgumentParser(prog="python -m tests.beside_d3rlpy", description=__doc__)
    parser.add_argument("--runs", default="runs", help="where `offbench benchmark baselines` has put its runs")
    curves = {"offbench": ours(parser.parse_args().runs), "d3rlpy 2.8.1": theirs()}
    header = ["TD3+BC on hopper-medium-v0"] + [f"{step:,}" for step in steps()] + ["mean return"]
    rows = []
    for name, found in curves.items():
        for seed, curve in enumerate(found):
            cells = [f"{ret:,.0f} ({length:.0f})" for ret, length in curve]
            rows.append([f"{name}, seed {seed}", *cells, f"{np.mean([ret for ret, _ in curve]):,.0f}"])
    FILE.write_text("\n".join(markdown(header, rows)) + "\n")


if __name__ == "__main__":
    if len(sys.argv) > 3:
        learn(*sys.argv[1:])
    else:
        main()
