"""The machine that runs train on: its device, its processes and the precision of matrix multiplications."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
import threadpoolctl
import torch

from offbench.algorithm.mlp import matmul_backend
from offbench.common.errors import OffbenchError
from offbench.common.processes import default_workers
from offbench.common.provenance import has_bfloat16
from offbench.common.settings import short_repr, without_numpy

PRECISIONS = ("float32", "tf32", "bfloat16")


@dataclass(frozen=True)
class Machine:
    """Where runs train.

    Attributes:
        device: PyTorch's name: cpu, cuda or cuda:N.
        workers: processes.
        stack: the most runs that train as one program, or "auto" for what the device holds.
    """

    device: str
    workers: int
    stack: int | str = "auto"

    @property
    def processes(self) -> int:
        """Number of jobs that train at a time: one on a GPU, whose evaluations use the workers."""
        return self.workers if self.device == "cpu" else 1


def pick_machine(device: str, workers: int | None, stack: int | str, precision: str) -> Machine:
    """Return the machine that these options describe.

    Args:
        device: auto, cpu, cuda or cuda:N.
        workers: processes; None is one per core.

    Raises:
        OffbenchError: a device that this machine lacks, a precision that the device lacks, or a bad value.
    """
    stack = without_numpy(stack)
    if stack != "auto" and not (isinstance(stack, int) and stack >= 1):
        raise OffbenchError(f"stack must be auto or a whole number from 1, not {short_repr(stack)}")
    device = pick_device(str(device))  # a torch.device too
    check_precision(precision, device)
    return Machine(device, default_workers(workers), stack)


def pick_device(device: str) -> str:
    """Return the device to train on: `auto` takes a GPU if there is one.

    Raises:
        OffbenchError: not a device, or one that this machine lacks.
    """
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if not re.fullmatch(r"cpu|cuda(:[0-9]{1,4})?", device):
        raise OffbenchError(f"device must be auto, cpu, cuda or cuda:N, not {device!r}")
    index = device.partition(":")[2]
    if device != "cpu" and (not torch.cuda.is_available() or int(index or 0) >= torch.cuda.device_count()):
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        raise OffbenchError(f"no device {device}: PyTorch {torch.__version__} sees {count} GPUs; use --device cpu")
    return device


def check_precision(precision: str, device: str) -> None:
    """Raise OffbenchError if a device (cpu or cuda:N) does not support a precision of matrix multiplications."""
    if precision not in PRECISIONS:
        raise OffbenchError(f"precision must be {', '.join(PRECISIONS[:-1])} or {PRECISIONS[-1]}, not {precision!r}")
    if precision == "tf32" and device == "cpu":
        raise OffbenchError("precision tf32 needs a GPU; use float32 on a CPU")
    native = has_bfloat16() if device == "cpu" else torch.cuda.is_bf16_supported(including_emulation=False)
    if precision == "bfloat16" and not native:
        what = "this processor" if device == "cpu" else f"this GPU ({torch.cuda.get_device_name(device)})"
        raise OffbenchError(f"{what} cannot multiply bfloat16 numbers natively; use float32")


@contextmanager
def matmul_settings(device: str, precision: str = "float32") -> Iterator[None]:
    """Set the number of threads and the precision of matrix multiplications for training; restore them afterwards.

    On the CPU there is one thread, for NumPy too: two runs in two processes are faster than one run on two threads.

    Args:
        precision: float32, tf32 (float32 with 10 bits of mantissa in multiplications) or bfloat16 (`mlp_forward`).

    Raises:
        OffbenchError: the device does not support the precision.
    """
    check_precision(precision, device)
    threads, before = torch.get_num_threads(), torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if precision == "tf32" else "highest")
    with ExitStack() as undo:
        undo.callback(torch.set_float32_matmul_precision, before)
        if precision == "bfloat16":
            undo.enter_context(matmul_backend("bfloat16"))
        if device == "cpu":
            torch.set_num_threads(1)
            undo.callback(torch.set_num_threads, threads)
            undo.enter_context(threadpoolctl.threadpool_limits(1, user_api="blas"))
            undo.enter_context(np.errstate(all="ignore"))  # a run that diverges is reported once, by Stack.diverged
        yield
