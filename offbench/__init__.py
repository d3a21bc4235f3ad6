"""offbench: offline-RL datasets from today's Gymnasium MuJoCo tasks, and algorithms benchmarked on them.

    import offbench

    dataset_id = offbench.collect("hopper", "medium")       # a Minari dataset
    data = offbench.load(dataset_id)                        # flat float32 arrays
    runs = offbench.train("bdb", dataset_id, seeds=range(5), beta=0.5)
    offbench.evaluate(runs[0]).scores
    offbench.normalize()                                    # every run below ./runs
    offbench.report()                                       # the same as a page, report/index.html

The command line (`offbench --help`) calls these same functions.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from offbench.errors import OffbenchError

if TYPE_CHECKING:
    from offbench.agents import behaviour
    from offbench.assess import evaluate
    from offbench.benchmarking import benchmark
    from offbench.cards import card
    from offbench.comparison import compare
    from offbench.d4rl import import_d4rl
    from offbench.deploy import export_policy
    from offbench.describe import inventory, show
    from offbench.diagnosis import doctor
    from offbench.exports import export
    from offbench.filming import video
    from offbench.launch import train
    from offbench.record import collect
    from offbench.recorded_env import make_env
    from offbench.reports import report
    from offbench.tables import normalize_runs_or_returns as normalize
    from offbench.transitions import load
    from offbench.verification import verify

__all__ = [
    "OffbenchError",
    "behaviour",
    "benchmark",
    "card",
    "collect",
    "compare",
    "doctor",
    "evaluate",
    "export",
    "export_policy",
    "import_d4rl",
    "inventory",
    "load",
    "make_env",
    "normalize",
    "report",
    "show",
    "train",
    "verify",
    "video",
]

# Loaded when first used: `offbench list` must not wait for PyTorch.
_VERBS = {
    "behaviour": ("offbench.agents", "behaviour"),
    "benchmark": ("offbench.benchmarking", "benchmark"),
    "card": ("offbench.cards", "card"),
    "collect": ("offbench.record", "collect"),
    "compare": ("offbench.comparison", "compare"),
    "doctor": ("offbench.diagnosis", "doctor"),
    "evaluate": ("offbench.assess", "evaluate"),
    "export": ("offbench.exports", "export"),
    "export_policy": ("offbench.deploy", "export_policy"),
    "import_d4rl": ("offbench.d4rl", "import_d4rl"),
    "inventory": ("offbench.describe", "inventory"),
    "load": ("offbench.transitions", "load"),
    "make_env": ("offbench.recorded_env", "make_env"),
    "normalize": ("offbench.tables", "normalize_runs_or_returns"),
    "report": ("offbench.reports", "report"),
    "show": ("offbench.describe", "show"),
    "train": ("offbench.launch", "train"),
    "verify": ("offbench.verification", "verify"),
    "video": ("offbench.filming", "video"),
}


def __getattr__(name: str) -> Any:
    if name not in _VERBS:
        raise AttributeError(f"module 'offbench' has no attribute {name!r}")
    module, attribute = _VERBS[name]
    return getattr(importlib.import_module(module), attribute)


def __dir__() -> list[str]:
    return __all__
