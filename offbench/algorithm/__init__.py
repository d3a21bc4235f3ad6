"""Everything that an algorithm's file imports."""

from offbench.algorithm.interface import Algorithm, Batch, Draw, PolicyParts
from offbench.algorithm.networks import Learned, Network, Target
from offbench.common.settings import setting

__all__ = ["Algorithm", "Batch", "Draw", "Learned", "Network", "PolicyParts", "Target", "setting"]
