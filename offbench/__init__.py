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

from offbench.common.errors import OffbenchError

if TYPE_CHECKING:
    from offbench.agents.behaviour import behaviour
    from offbench.analysis.compare import compare
    from offbench.analysis.normalize import normalize_runs_or_returns as normalize
    from offbench.benchmarks.benchmark import benchmark
    from offbench.data.card import card
    from offbench.data.collect import collect
    from offbench.data.export import export
    from offbench.data.huggingface_card import huggingface_card
    from offbench.data.import_d4rl import import_d4rl
    from offbench.data.recorded_env import make_env
    from offbench.data.show import show
    from offbench.data.transitions import load
    from offbench.evaluation.evaluate import evaluate
    from offbench.evaluation.export_policy import export_policy
    from offbench.evaluation.policies import load_policy
    from offbench.evaluation.video import video
    from offbench.reports.report import report
    from offbench.tools.doctor import doctor
    from offbench.tools.inventory import inventory
    from offbench.training.train import train
    from offbench.verification.verify import verify

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
    "huggingface_card",
    "import_d4rl",
    "inventory",
    "load",
    "load_policy",
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
    "behaviour": ("offbench.agents.behaviour", "behaviour"),
    "benchmark": ("offbench.benchmarks.benchmark", "benchmark"),
    "card": ("offbench.data.card", "card"),
    "collect": ("offbench.data.collect", "collect"),
    "compare": ("offbench.analysis.compare", "compare"),
    "doctor": ("offbench.tools.doctor", "doctor"),
    "evaluate": ("offbench.evaluation.evaluate", "evaluate"),
    "export": ("offbench.data.export", "export"),
    "export_policy": ("offbench.evaluation.export_policy", "export_policy"),
    "huggingface_card": ("offbench.data.huggingface_card", "huggingface_card"),
    "import_d4rl": ("offbench.data.import_d4rl", "import_d4rl"),
    "inventory": ("offbench.tools.inventory", "inventory"),
    "load": ("offbench.data.transitions", "load"),
    "load_policy": ("offbench.evaluation.policies", "load_policy"),
    "make_env": ("offbench.data.recorded_env", "make_env"),
    "normalize": ("offbench.analysis.normalize", "normalize_runs_or_returns"),
    "report": ("offbench.reports.report", "report"),
    "show": ("offbench.data.show", "show"),
    "train": ("offbench.training.train", "train"),
    "verify": ("offbench.verification.verify", "verify"),
    "video": ("offbench.evaluation.video", "video"),
}


def __getattr__(name: str) -> Any:
    if name not in _VERBS:
        raise AttributeError(f"module 'offbench' has no attribute {name!r}")
    module, attribute = _VERBS[name]
    return getattr(importlib.import_module(module), attribute)


def __dir__() -> list[str]:
    return __all__
