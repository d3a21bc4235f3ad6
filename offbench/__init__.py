"""offbench: offline-RL datasets on current Gymnasium MuJoCo tasks, and benchmarks of algorithms on them.

    import offbench

    dataset_id = offbench.collect("hopper", "medium")       # a Minari dataset
    data = offbench.load(dataset_id)                        # flat float32 arrays
    runs = offbench.train("bdb", dataset_id, seeds=range(5), beta=0.5)
    offbench.evaluate(runs[0]).scores
    offbench.normalize()                                    # every run below ./runs
    offbench.report()                                       # the same as a page, report/index.html

The command line (`offbench --help`) has a command for each of these functions.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from offbench.common.errors import OffbenchError

if TYPE_CHECKING:
    from offbench.agents.behaviour import behaviour as behaviour
    from offbench.analysis.compare import compare as compare
    from offbench.analysis.normalize import normalize as normalize
    from offbench.benchmarks.benchmark import benchmark as benchmark
    from offbench.data.card import card as card
    from offbench.data.collect import collect as collect
    from offbench.data.export import export as export
    from offbench.data.huggingface_card import huggingface_card as huggingface_card
    from offbench.data.import_d4rl import import_d4rl as import_d4rl
    from offbench.data.recorded_env import make_env as make_env
    from offbench.data.show import show as show
    from offbench.data.transitions import load as load
    from offbench.evaluation.evaluate import evaluate as evaluate
    from offbench.evaluation.export_policy import export_policy as export_policy
    from offbench.evaluation.policies import load_policy as load_policy
    from offbench.evaluation.video import video as video
    from offbench.reports.report import report as report
    from offbench.tools.doctor import doctor as doctor
    from offbench.tools.inventory import inventory as inventory
    from offbench.training.train import train as train
    from offbench.verification.verify import verify as verify

# The module of each function, loaded when first used: `offbench list` must not wait for PyTorch.
_MODULES = {
    "behaviour": "offbench.agents.behaviour",
    "benchmark": "offbench.benchmarks.benchmark",
    "card": "offbench.data.card",
    "collect": "offbench.data.collect",
    "compare": "offbench.analysis.compare",
    "doctor": "offbench.tools.doctor",
    "evaluate": "offbench.evaluation.evaluate",
    "export": "offbench.data.export",
    "export_policy": "offbench.evaluation.export_policy",
    "huggingface_card": "offbench.data.huggingface_card",
    "import_d4rl": "offbench.data.import_d4rl",
    "inventory": "offbench.tools.inventory",
    "load": "offbench.data.transitions",
    "load_policy": "offbench.evaluation.policies",
    "make_env": "offbench.data.recorded_env",
    "normalize": "offbench.analysis.normalize",
    "report": "offbench.reports.report",
    "show": "offbench.data.show",
    "train": "offbench.training.train",
    "verify": "offbench.verification.verify",
    "video": "offbench.evaluation.video",
}
__all__ = ["OffbenchError", *_MODULES]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'offbench' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
