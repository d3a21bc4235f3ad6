"""Where a result comes from: software versions and hardware."""

from __future__ import annotations

import functools
import importlib.metadata
import os
import platform
import re
from pathlib import Path
from typing import TypedDict

PACKAGES = ("offbench", "mujoco", "gymnasium", "stable-baselines3", "torch", "numpy", "minari")
PHYSICS = ("mujoco", "gymnasium", "numpy")  # packages whose version can change recorded data
Hardware = dict[str, str | int | None]


class TrainingPlatform(TypedDict):
    """What a run's results depend on in addition to settings and seed; recorded in its config.json."""

    device: str
    precision: str
    versions: dict[str, str]
    hardware: Hardware


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    installed = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            installed[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            installed[package] = "not installed"
    return installed


def hardware() -> Hardware:
    """Return processor and cores; `vectors` are the vector instructions of PyTorch, which affect the last bits."""
    import torch  # slow to import; `versions` does not need it

    vectors = torch.backends.cpu.get_cpu_capability()
    return {"processor": _processor(), "vectors": vectors, "cores": os.cpu_count(), "machine": platform.machine()}


def training_platform(device: str, precision: str) -> TrainingPlatform:
    """Return the versions and hardware of training on `device` (cpu, cuda or cuda:N) with `precision`."""
    machine = hardware()
    if device != "cpu":
        import torch

        machine["gpu"] = torch.cuda.get_device_name(device)
    return {"device": device, "precision": precision, "versions": versions(), "hardware": machine}


def has_bfloat16() -> bool:
    """Return whether this processor multiplies bfloat16 numbers natively: AVX512_BF16, AMX, or ARM's BF16 (Linux)."""
    return bool({"avx512_bf16", "amx_bf16", "bf16"} & set(_cpuinfo().split()))


def _processor() -> str:
    name = re.search(r"^model name.*?: *(.*)", _cpuinfo(), re.MULTILINE)
    return name[1].strip() if name else platform.processor() or "unknown"


def _cpuinfo() -> str:
    """Return the content of /proc/cpuinfo; "" on systems without it."""
    try:
        return Path("/proc/cpuinfo").read_text()
    except OSError:
        return ""
