"""d3rlpy's sides, for the interpreter of its own environment: `python -m tests.speed.d3rlpy_peer NAME`.

It imports no offbench. A module of the package, not a script, whose folder would come before the standard library.
"""

from __future__ import annotations

import sys
from typing import Any

from tests.speed.side import Work, serve

ROWS = 100_000


def update(algorithm: str) -> Work:
    """Updates with d3rlpy's own sampling; a unit is one update."""
    import d3rlpy
    import numpy as np
    import torch

    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    ends = np.zeros(ROWS, np.float32)
    ends[999::1000] = 1
    dataset = d3rlpy.dataset.MDPDataset(
        rng.standard_normal((ROWS, 11)).astype(np.float32),
        rng.uniform(-1, 1, (ROWS, 3)).astype(np.float32),
        rng.standard_normal(ROWS).astype(np.float32),
        ends,
    )
    scaler = d3rlpy.preprocessing.StandardObservationScaler()
    configs: dict[str, Any] = {
        "td3_bc": lambda: d3rlpy.algos.TD3PlusBCConfig(observation_scaler=scaler, batch_size=256),
        "cql": lambda: d3rlpy.algos.CQLConfig(batch_size=256, n_action_samples=10),
    }
    learner = configs[algorithm]().create(device="cpu:0")
    learner.build_with_dataset(dataset)
    scaler.fit_with_transition_picker(dataset.episodes, dataset.transition_picker)
    few = 2 if algorithm == "cql" else 20

    def work() -> int:
        for _ in range(few):
            learner.update(dataset.sample_transition_batch(256))
        return few

    return work


if __name__ == "__main__":
    serve({"update": update}[sys.argv[1]])
