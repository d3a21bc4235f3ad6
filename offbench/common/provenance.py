"""Where a result came from: versions, hardware, and whether the physics are the ones it was made on."""

from __future__ import annotations

import functools
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

PACKAGES = ("offbench", "mujoco", "gymnasium", "stable-baselines3", "torch", "numpy", "minari")


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def hardware() -> dict[str, Any]:
    """Return processor and cores, for provenance. `vectors`: the instructions PyTorch uses; a run's bits follow."""
    import torch  # not by those who ask for versions alone

    processor = {"processor": _processor(), "vectors": torch.backends.cpu.get_cpu_capability()}
    return {"hardware": processor | {"cores": os.cpu_count(), "machine": platform.machine()}}


def made_with(device: str, precision: str) -> dict[str, Any]:
    """Return what a training's numbers depend on beside its settings and seed."""
    return {"device": device, "precision": precision, "versions": versions(), **hardware()}


def has_bfloat16() -> bool:
    """Return whether this processor multiplies bfloat16 numbers natively: AVX512_BF16, AMX, or ARM's BF16 (Linux)."""
    try:
        known = Path("/proc/cpuinfo").read_text()
    except OSError:
        return False
    return bool({"avx512_bf16", "amx_bf16", "bf16"} & set(known.split()))


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"
