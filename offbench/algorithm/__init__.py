"""Everything that an algorithm's file imports."""

from offbench.algorithm.interface import (
    Algorithm,
    Batch,
    Logs,
    Noise,
    NoiseSpec,
    PolicyParts,
    has_word,
    normal,
    per_sample,
    stack_configs,
    uniform,
)
from offbench.algorithm.networks import Network, Parameters, Target, cosine_decay, linear_decay, minimize
from offbench.common.settings import setting

__all__ = [
    "Algorithm",
    "Batch",
    "Logs",
    "Network",
    "Noise",
    "NoiseSpec",
    "Parameters",
    "PolicyParts",
    "Target",
    "cosine_decay",
    "has_word",
    "linear_decay",
    "minimize",
    "normal",
    "per_sample",
    "setting",
    "stack_configs",
    "uniform",
]
