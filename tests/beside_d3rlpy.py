"""d3rlpy's TD3+BC, IQL, ReBRAC and BEAR on the data that ours have learned from: `python -m tests.beside_d3rlpy`,
after `make bench` (which installs d3rlpy), writes docs/results/beside-d3rlpy.md.

d3rlpy learns, in an environment of its own, from an .npz file of `offbench export`, with the settings of the grid
`baselines`, and hands its weights over as arrays; here they play as offbench policies, 10 episodes every 5,000 updates
as in the grid. Two processes of one thread take some three hours; runs whose CSV file is below docs/results are not
repeated.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
PEER = ROOT / ".venv-peers" / "bin" / "python"
KEPT = ROOT / "docs" / "results" / "beside-d3rlpy"  # a CSV file of each run of d3rlpy's
FILE = KEPT.with_suffix(".md")
RUNS = ROOT / "docs" / "results" / "baselines" / "runs"
DATASET, ENV_ID = "hopper-medium-v0", "Hopper-v5"
ALGORITHMS = ("td3_bc", "iql", "rebrac", "bear")
SEEDS, STEPS, EVERY, EPISODES = 2, 50_000, 5_000, 10


def settings(algorithm: str) -> Any:
    """Return d3rlpy's config with the settings that the grid `baselines` has for hopper-medium."""
    import d3rlpy

    def hidden(*sizes: int, norm: bool = False) -> Any:
        return d3rlpy.models.encoders.VectorEncoderFactory(list(sizes), use_layer_norm=norm)

    if algorithm == "td3_bc":
        scaler = d3rlpy.preprocessing.StandardObservationScaler()
        return d3rlpy.algos.TD3PlusBCConfig(observation_scaler=scaler)
    if algorithm == "iql":
        return d3rlpy.algos.IQLConfig(reward_scaler=d3rlpy.preprocessing.MultiplyRewardScaler(0.46))
    if algorithm == "rebrac":
        return d3rlpy.algos.ReBRACConfig(
            actor_beta=0.01,
            actor_encoder_factory=hidden(256, 256, 256),
            critic_encoder_factory=hidden(256, 256, 256, norm=True),
        )
    return d3rlpy.algos.BEARConfig(
        batch_size=100,
        actor_learning_rate=1e-3,
        critic_learning_rate=1e-3,
        imitator_learning_rate=1e-3,
        temp_learning_rate=0,  # d3rlpy adds SAC's entropy, the authors do not
        initial_temperature=1e-9,
        actor_encoder_factory=hidden(400, 300),
        critic_encoder_factory=hidden(400, 300),
        imitator_encoder_factory=hidden(750, 750),
        mmd_kernel="gaussian",
        n_mmd_action_samples=5,
        n_action_samples=10,
        warmup_steps=2_000,
    )


def learn(algorithm: str, data: str, seed: str, folder: str, steps: str = str(STEPS), every: str = str(EVERY)) -> None:
    """Train d3rlpy's algorithm; run by d3rlpy's interpreter. Leaves `folder`/<step>.npz."""
    import d3rlpy
    import torch

    torch.set_num_threads(1)
    d3rlpy.seed(int(seed))
    keys = ("observations", "actions", "rewards", "terminals", "timeouts")
    with np.load(data, allow_pickle=False) as file:
        found = {key: file[key] for key in keys}
    dataset = d3rlpy.dataset.MDPDataset(*found.values())
    config = settings(algorithm)
    learner = config.create(device="cpu:0")
    probe = found["observations"][:100]
    samples = getattr(config, "n_action_samples", 1)
    noise = np.random.default_rng(0).standard_normal((len(probe), samples, found["actions"].shape[1]), np.float32)

    def linear(name: str, module: torch.nn.Module) -> dict[str, Any]:
        layers = [m for m in module.modules() if isinstance(m, torch.nn.Linear)]
        weights, biases = [m.weight.detach().numpy().T for m in layers], [m.bias.detach().numpy() for m in layers]
        if name == "layers" and algorithm == "bear":  # the last two give mean and log std
            weights = [*weights[:-2], np.concatenate(weights[-2:], 1)]
            biases = [*biases[:-2], np.concatenate(biases[-2:])]
        pairs = enumerate(zip(weights, biases, strict=True))
        return {f"{name}.{i}.{kind}": array for i, pair in pairs for kind, array in zip("wb", pair, strict=True)}

    def best_by_q() -> Any:
        """Return what BEAR does, for known noise instead of its own."""
        observations = torch.as_tensor(probe)
        out = learner.impl.policy(observations)
        actions = torch.tanh(out.mu[:, None] + out.logstd.exp()[:, None] * torch.as_tensor(noise))
        repeated = observations[:, None].expand(-1, samples, -1)
        q = learner.impl.modules.q_funcs[0](repeated.flatten(0, 1), actions.flatten(0, 1)).q_value
        return actions[torch.arange(len(probe)), q.view(-1, samples).argmax(1)].detach().numpy()

    def hand_over(_: Any, __: int, step: int) -> None:
        arrays = linear("layers", learner.impl.policy)
        if algorithm == "bear":
            arrays |= linear("critic", learner.impl.modules.q_funcs[0])
            arrays |= {"noise": noise, "actions": best_by_q()}
        else:
            arrays |= {"actions": learner.predict(probe)}
        if scaler := config.observation_scaler:
            arrays |= {"mean": scaler.mean, "std": scaler.std + scaler.eps}
        np.savez(Path(folder) / f"{step}.npz", **arrays, probe=probe)

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

    with np.load(path, allow_pickle=False) as file:
        found = dict(file)

    def layers(name: str) -> tuple[tuple[Any, Any], ...]:
        count = sum(key.startswith(f"{name}.") and key.endswith(".w") for key in found)
        return tuple((found[f"{name}.{i}.w"], found[f"{name}.{i}.b"]) for i in range(count))

    probe, actions, noise = found["probe"], found["actions"], found.get("noise")
    mean, std = found.get("mean", np.zeros(probe.shape[1])), found.get("std", np.ones(probe.shape[1]))
    bound = np.ones(actions.shape[1])  # d3rlpy's actions lie in [-1, 1], as hopper's do
    policy = Policy("tanh", layers("layers"), mean.ravel(), std.ravel(), -bound, bound, env_id)
    if noise is not None:
        policy = replace(policy, kind="best_by_q", critic=layers("critic"), samples=noise.shape[1])
    np.testing.assert_allclose(policy.act(probe, noise), actions, atol=1e-4)
    file = path.with_suffix(".safetensors")
    file.write_bytes(policy.to_bytes())
    played = evaluate(file, episodes=EPISODES)
    return float(np.mean(played.returns)), float(np.mean(played.lengths))


def ours(algorithm: str) -> list[list[tuple[float, float]]]:
    """Return (mean return, mean length) of each evaluation of each of our kept runs."""
    from offbench.analysis.results import read_results

    entries = read_results(RUNS).entries.items()
    found = [entry for (task, method), entry in entries if (task.dataset, method.label) == (DATASET, algorithm)]
    if len(found) != 1:
        raise SystemExit(f"no runs of {algorithm} on {DATASET} below {RUNS}")
    curves = [[np.mean(run.evaluations[step], axis=0) for step in steps()] for run in found[0].runs]
    return [[(float(ret), float(length)) for ret, length in curve] for curve in curves]


def steps() -> range:
    """Return the steps of the evaluations."""
    return range(EVERY, STEPS + 1, EVERY)


def theirs(algorithm: str, seed: int) -> list[tuple[float, float]] | None:
    """Return (mean return, mean length) of each evaluation of a run of d3rlpy's, None if it is not kept."""
    path = KEPT / f"{algorithm}-{seed}.csv"
    if not path.exists():
        return None
    with open(path, newline="") as file:
        return [(float(row["return"]), float(row["length"])) for row in csv.DictReader(file)]


def learn_and_play(algorithm: str, seed: int, data: Path, folder: Path) -> None:
    """Train d3rlpy's algorithm into `folder`, unless an earlier call has, and keep what its policies do here."""
    from offbench.common.files import csv_bytes, write_bytes

    place = folder / algorithm / str(seed)
    if not (place / f"{STEPS}.npz").exists():
        place.mkdir(parents=True, exist_ok=True)
        subprocess.run([PEER, __file__, "learn", algorithm, data, str(seed), place], check=True)
    rows = [(step, *play(place / f"{step}.npz")) for step in steps()]
    write_bytes(KEPT / f"{algorithm}-{seed}.csv", csv_bytes(("step", "return", "length"), rows))


def table() -> str:
    """Return the table of our kept runs beside theirs."""
    from offbench.common.tables import markdown

    header = ["hopper-medium-v0", "", "seed", *(f"{step:,}" for step in steps()), "mean return"]
    rows = []
    for name in ALGORITHMS:
        peers = [curve for seed in range(SEEDS) if (curve := theirs(name, seed))]
        for library, curves in (("offbench", ours(name) if peers else []), ("d3rlpy 2.8.1", peers)):
            for seed, curve in enumerate(curves):
                cells = [f"{ret:,.0f} ({length:.0f})" for ret, length in curve]
                rows.append([name, library, str(seed), *cells, f"{np.mean([ret for ret, _ in curve]):,.0f}"])
    return "\n".join(markdown(header, rows)) + "\n"


def main() -> None:
    """Train what is not kept yet, two processes at once, and write the table."""
    from offbench import export

    parser = argparse.ArgumentParser(prog="python -m tests.beside_d3rlpy", description=__doc__)
    parser.add_argument("--folder", default=ROOT / "runs" / "d3rlpy", type=Path, help="of what d3rlpy has learned")
    parser.add_argument("algorithms", nargs="*", default=ALGORITHMS, help=f"default: {' '.join(ALGORITHMS)}")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    data = export(DATASET, args.folder / "data.npz")
    missing = [(name, seed) for name in args.algorithms for seed in range(SEEDS) if theirs(name, seed) is None]
    with ThreadPoolExecutor(2) as pool:
        for job in [pool.submit(learn_and_play, name, seed, data, args.folder) for name, seed in missing]:
            job.result()
    FILE.write_text(table())


if __name__ == "__main__":
    if sys.argv[1:2] == ["learn"]:
        learn(*sys.argv[2:])
    else:
        main()
