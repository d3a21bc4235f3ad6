"""A stack on a GPU: does a captured update equal a plain one, and what do many runs gain over one?

    python -m tests.speed.gpu --out docs/results/gpu.json --seconds 80

Every figure is written as soon as it is measured. The same command measures those that are missing, so it can be run
in slices. The table of all figures is written beside the file, with the suffix .md. On a CPU it measures small stacks.
"""

from __future__ import annotations

import argparse
import datetime
import gc
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from offbench.benchmarks.throughput import random_stack
from offbench.common.files import write_bytes, write_json
from offbench.common.provenance import versions
from offbench.common.settings import build
from offbench.common.tables import markdown
from offbench.envs.recipes import load_recipe
from offbench.training.devices import PRECISIONS, matmul_settings, pick_device
from offbench.training.registry import load_algorithm
from offbench.training.stack import Stack

MEASURE = 1.0  # seconds of a figure
STACKS = (1, 5, 25, 125)
ALGORITHMS = ("bdb", "td3_bc", "cql")


def stack_of(algorithm: str, runs: int, device: str, *, captured: bool = True, **settings: Any) -> Stack:
    """Return a stack on random transitions of hopper's shapes; runs differ in seed and, for BDB, in beta."""
    kind = load_algorithm(algorithm)
    settings = {"hidden": "256,256"} | ({"bc_steps": 0} if algorithm == "cql" else {}) | settings
    betas = [0.0, 0.25, 0.5, 0.75, "adaptive"] if algorithm == "bdb" else [None]
    spec = load_recipe("hopper").env_spec()
    configs = []
    for seed in range(runs):
        own = settings if betas[0] is None else settings | {"beta": betas[seed % len(betas)]}
        configs.append(build(kind.Config, own, algorithm))
    stack = random_stack(kind, configs, spec, device)
    if not captured:
        stack.captured_update.eager = True
    return stack


def rate(algorithm: str, runs: int, device: str, *, captured: bool, precision: str) -> dict[str, float]:
    """Return the sum of all runs' updates a second, and the peak memory in MB."""
    gpu = device != "cpu"
    if gpu:
        gc.collect()  # of the stack before, which has reference cycles
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    with matmul_settings(device, precision):
        stack = stack_of(algorithm, runs, device, captured=captured)
        advance(stack, 100)
        done, began = 0, time.perf_counter()
        while time.perf_counter() - began < MEASURE:
            done += advance(stack, 100)
        spent = time.perf_counter() - began
    memory = torch.cuda.max_memory_allocated() / 1e6 if gpu else 0.0
    return {"updates_per_second": runs * done / spent, "stack_updates_per_second": done / spent, "memory_mb": memory}


def advance(stack: Stack, updates: int) -> int:
    """Do so many updates and wait for them."""
    stack.train(stack.step + updates)
    stack.captured_update.logged()
    return updates


def equality(algorithm: str, device: str) -> dict[str, float]:
    """Return the largest difference of the weights after 50 updates: captured against plain, stack against alone."""
    with matmul_settings(device):
        stacks = [
            stack_of(algorithm, 5, device),
            stack_of(algorithm, 5, device, captured=False),
            stack_of(algorithm, 1, device),
        ]
        for stack in stacks:
            advance(stack, 50)
    together, plain, alone = (stack.run_tensors(0) for stack in stacks)
    return {
        "captured_against_plain": max(float((together[n] - plain[n]).abs().max()) for n in together),
        "stack_against_alone": max(float((together[n] - alone[n]).abs().max()) for n in together),
    }


def figures(device: str) -> dict[str, Callable[[], dict[str, float]]]:
    """Return what is measured, by name."""
    sizes = STACKS if device != "cpu" else STACKS[:2]
    found: dict[str, Callable[[], dict[str, float]]] = {}
    for algorithm in ALGORITHMS:
        found[f"equality {algorithm}"] = lambda a=algorithm: equality(a, device)  # type: ignore[misc]
        found[f"{algorithm}, 1 run, plain"] = lambda a=algorithm: rate(
            a, 1, device, captured=False, precision="float32"
        )  # type: ignore[misc]
        for runs in sizes[: 3 if algorithm == "cql" else None]:
            for precision in PRECISIONS:
                name = f"{algorithm}, {runs} runs, captured, {precision}"
                found[name] = lambda a=algorithm, r=runs, p=precision: rate(a, r, device, captured=True, precision=p)  # type: ignore[misc]
    return found


def table(results: dict[str, dict[str, float]]) -> str:
    """Return the updates a second of all runs of a stack, by precision, as a Markdown table."""
    rows = []
    for algorithm in ALGORITHMS:
        plain = results.get(f"{algorithm}, 1 run, plain", {}).get("updates_per_second")
        if plain is None:
            continue
        rows.append([algorithm, "1, not captured", f"{plain:,.0f}", "", "", "1"])
        for runs in STACKS:
            cells = [results.get(f"{algorithm}, {runs} runs, captured, {p}", {}) for p in PRECISIONS]
            rates = [f"{cell['updates_per_second']:,.0f}" if "updates_per_second" in cell else "" for cell in cells]
            if any(rates):
                gain = f"{cells[0]['updates_per_second'] / plain:.0f}" if rates[0] else ""
                rows.append([algorithm, str(runs), *rates, gain])
    header = ["algorithm", "runs in the stack", *PRECISIONS, "float32 against one run not captured"]
    return "\n".join(markdown(header, rows)) + "\n"


def main() -> None:
    """Measure what is missing, for as long as there is time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results/gpu.json"))
    parser.add_argument("--seconds", type=float, default=80.0, help="after which no new figure is begun")
    parser.add_argument("--device", default="auto")
    arguments = parser.parse_args()
    device, began = pick_device(arguments.device), time.monotonic()
    name = torch.cuda.get_device_name() if device != "cpu" else "cpu"
    known: dict[str, Any] = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    if known.get("device", name) != name:
        raise SystemExit(f"{arguments.out} has figures of {known['device']}, this is {name}; give another --out")
    known |= {"device": name, "date": datetime.date.today().isoformat(), "versions": versions()}
    results = known.setdefault("figures", {})
    for what, measure in figures(device).items():
        if what in results:
            continue
        if time.monotonic() - began > arguments.seconds:
            print("out of time; rerun the command to measure the rest")
            break
        try:
            results[what] = measure()
        except torch.cuda.OutOfMemoryError:
            results[what] = {"out_of_memory": 1.0}
        print(what, results[what], flush=True)
        write_json(arguments.out, known)
    write_bytes(arguments.out.with_suffix(".md"), table(results).encode())


if __name__ == "__main__":
    main()
