"""Capture: an update is recorded once on the CPU and then replayed without Python's and autograd's overhead.

What a CUDA graph is on a GPU: every operation of an update, below autograd, is recorded with the tensors that it
reads and writes, and replayed with them. Views are made once, outputs stay in place, and nothing is allocated. The
same kernels run in the same order on the same numbers, so a replayed update has the bits of an eager one.

An update can be replayed if it always does the same operations: it may not read numbers into Python, draw random
numbers, or depend on anything but tensors that changes. `trace` detects the first two; comparing traces, and
`attributes`, detects the third.
"""

from __future__ import annotations

import collections
import random
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_map_only

Args: TypeAlias = tuple[Any, ...]
Kwargs: TypeAlias = dict[str, Any]
Call: TypeAlias = Callable[[], object]
Variant = tuple[Callable[..., object], list[str]]  # a function that writes into given outputs, and their names
Nested = object  # tensors and plain values in tuples, lists and dicts
_UNREPEATABLE = {
    torch.Tag.nondeterministic_seeded,  # random numbers
    torch.Tag.data_dependent_output,  # .item()
    torch.Tag.dynamic_output_shape,  # nonzero()
}
# methods of a tensor that read it without calling an operation
_READ_BY_PYTHON = {"tolist", "numpy", "__array__", "__dlpack__"}
_CONSTANTS = ("zeros", "ones", "full", "zeros_like", "ones_like", "full_like", "scalar_tensor")
_ACTIVE = threading.local()


class NotCapturableError(Exception):
    """An update does something that a replay would not repeat."""


class Trace:
    """The operations of one update, to be replayed in place.

    Attributes:
        calls: what a replay calls, in order.
        key: what was recorded, comparable between two traces of the same update.
        outside: tensors that were there before the trace, in order of their first use.
    """

    def __init__(self) -> None:
        self.calls: list[Call] = []
        self.key: list[tuple[object, Nested]] = []
        self.outside: list[Tensor] = []
        self._kept: list[Nested] = []  # no storage of the trace is freed and used again
        # by a storage's address: the call that allocated it or `outside`, and the call that fills it with constants
        self._origins: dict[int, tuple[str, int]] = {}
        self._constants: dict[int, int] = {}

    def replay(self) -> None:
        """Do the update once more. Call it within `torch.inference_mode()`."""
        for call in self.calls:
            call()

    def same_as(self, other: Trace) -> bool:
        """Return whether two traces do the same with the same numbers."""
        return (
            self.key == other.key
            and len(self.outside) == len(other.outside)
            and all(
                a.data_ptr() == b.data_ptr() or (a.shape == b.shape and torch.equal(a, b))
                for a, b in zip(self.outside, other.outside, strict=True)
            )
        )

    def add(self, name: object, reads: Nested, writes: Nested, call: Call, *, constant: bool = False) -> None:
        """Add one call; `reads` and `writes` are nested tensors and plain values.

        Args:
            constant: it writes the same numbers every time.
        """
        described = tree_map_only(float, repr, tree_map_only(Tensor, self._describe, reads))  # as text, NaN equals NaN
        origin = ("call", len(self.calls))
        for tensor in _tensors(writes):
            self._origins.setdefault(_address(tensor), origin)
            if constant:
                self._constants[_address(tensor)] = len(self.calls)
        self.key.append((name, described))
        self._kept.append((reads, writes))
        self.calls.append(call)

    def changed(self, tensors: Nested) -> None:
        """Note that a call changes tensors in place, so that they are not constants."""
        for tensor in _tensors(tensors):
            self._constants.pop(_address(tensor), None)

    def finish(self) -> None:
        """Remove the calls that only fill constants from the replay."""
        left_out = set(self._constants.values())
        self.calls = [call for index, call in enumerate(self.calls) if index not in left_out]

    def keep(self, tensors: Nested) -> None:
        """Keep tensors alive as long as this trace."""
        self._kept.append(tensors)

    def _describe(self, tensor: Tensor) -> tuple[object, ...]:
        address = _address(tensor)
        if address not in self._origins:
            self._origins[address] = ("outside", len(self.outside))
            self.outside.append(tensor)
        return (
            self._origins[address],
            tensor.storage_offset(),
            tuple(tensor.shape),
            tensor.stride(),
            str(tensor.dtype),
        )


def trace(update: Callable[[], object]) -> Trace:
    """Do an update, and return what it did.

    Raises:
        NotCapturableError: it was done, but cannot be replayed.
    """
    trace = Trace()
    tracer, reads = _Tracer(trace), _Reads()
    _ACTIVE.trace = trace
    try:
        with tracer, reads:
            update()
    finally:
        _ACTIVE.trace = None
    if problem := tracer.problem or reads.problem:
        raise NotCapturableError(problem)
    trace.finish()
    return trace


@contextmanager
def one_call() -> Iterator[Trace | None]:
    """Record what is done within as one call, which the caller adds to the trace; yield None if there is none."""
    trace: Trace | None = getattr(_ACTIVE, "trace", None)
    if trace is None:
        yield None
    else:
        with _disable_current_modes(), torch._C.DisableTorchFunction():
            yield trace


class _Tracer(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Does each operation and adds it to a trace."""

    def __init__(self, trace: Trace) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.trace, self.problem = trace, ""

    def __torch_dispatch__(
        self, func: OpOverload, types: object, args: Args = (), kwargs: Kwargs | None = None
    ) -> Nested:
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        if _UNREPEATABLE & set(func.tags):
            what = f"calls {func}"
            if torch.Tag.nondeterministic_seeded in func.tags:
                what = f"draws random numbers by {func}"
            self.problem = self.problem or f"it {what}"
        elif func._schema.is_mutable:
            self.trace.changed((args, kwargs))
            self.trace.add(func, (args, kwargs), (), _single(func, args, kwargs))
        elif _is_view(result, (args, kwargs)) or func.overloadpacket.__name__.startswith("empty"):
            self.trace.keep(result)
        else:
            call = _in_place(func, args, kwargs, result)
            constant = func.overloadpacket.__name__ in _CONSTANTS
            self.trace.add(func, (args, kwargs), result, call, constant=constant)
        return result


class _Reads(TorchFunctionMode):
    """Notices that numbers are read into Python without an operation."""

    problem = ""

    def __torch_function__(
        self, func: Callable[..., object], types: object, args: Args = (), kwargs: Kwargs | None = None
    ) -> object:
        if (name := getattr(func, "__name__", "")) in _READ_BY_PYTHON:
            self.problem = self.problem or f"it calls Tensor.{name}"
        return func(*args, **(kwargs or {}))


def attributes(owner: object, *, in_place: bool = False) -> dict[str, object]:
    """Return the attributes of an object, to be compared with a later state by `changed_attribute`.

    Numbers, texts, generators of random numbers and the contents of lists, dicts, sets and plain objects count by
    value, anything else by identity. What a checkpoint keeps does not count.

    Args:
        in_place: whether changes in place of other tensors count, which a replay repeats.
    """
    learned: dict[str, Any] = getattr(owner, "learned", {})
    kept = {_memory(tensor) for part in learned.values() for tensor in part.tensors().values()} if in_place else None
    by_identity = frozenset(map(id, learned.values()))
    return {name: _state(value, by_identity, kept) for name, value in vars(owner).items()}


def changed_attribute(before: dict[str, object], after: dict[str, object], *, first: bool) -> str | None:
    """Return the name of an attribute that has changed, None if none has.

    Args:
        first: whether the update between was a phase's first, which may set attributes that were absent or None.
    """
    for name, value in after.items():
        old = before.get(name)
        if old != value and not (first and old in (None, _state(None, frozenset(), None))):
            return name
    return next((name for name in before if name not in after), None)


def _memory(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


def _state(value: object, by_identity: frozenset[int], kept: set[int] | None) -> object:
    """Return the parts of a value that can change, in a form that can be compared.

    Args:
        by_identity: ids of objects that count by identity: what a checkpoint keeps, and what the value is part of.
        kept: addresses of tensors that a checkpoint keeps, if changes of others in place count.
    """
    if isinstance(value, Tensor):
        ignored = kept is None or value.is_inference() or _memory(value) in kept
        return id(value), 0 if ignored else value._version
    if value is None or isinstance(value, bool | int | float | complex | str | bytes):
        return type(value).__name__, repr(value)  # repr, so that NaN compares equal
    if id(value) in by_identity or isinstance(value, type):
        return id(value)
    inner = by_identity | {id(value)}
    if isinstance(value, dict):
        return [(repr(key), _state(item, inner, kept)) for key, item in value.items()]
    if isinstance(value, list | tuple | collections.deque):
        return [_state(item, inner, kept) for item in value]
    if isinstance(value, set | frozenset):
        return sorted(map(repr, value))
    if isinstance(value, np.ndarray):
        return value.shape, str(value.dtype), value.tobytes()
    if isinstance(value, torch.Generator):
        return id(value), value.get_state().numpy().tobytes()
    if isinstance(value, np.random.Generator):
        return id(value), repr(value.bit_generator.state)
    if isinstance(value, random.Random):
        return id(value), value.getstate()
    if hasattr(value, "__dict__"):
        return id(value), [(name, _state(item, inner, kept)) for name, item in vars(value).items()]
    return id(value), repr(value)


def _single(func: OpOverload, args: Args, kwargs: Kwargs) -> Call:
    """Return the call of an operation in place; that of a list of one tensor (Adam's step count) as the tensor's."""
    if func is torch.ops.aten._foreach_add_.Scalar and len(args[0]) == 1:
        return partial(args[0][0].add_, args[1], **kwargs)
    return partial(func, *args, **kwargs)


def _tensors(nested: Nested) -> list[Tensor]:
    tensors: list[Tensor] = []
    tree_map_only(Tensor, tensors.append, nested)
    return tensors


def _address(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr() or id(tensor.untyped_storage())


def _is_view(result: Nested, inputs: Nested) -> bool:
    """Return whether an operation only returned its inputs' memory."""
    if not isinstance(result, Tensor):
        outputs = _tensors(result)
        return not outputs or all(_is_view(output, inputs) for output in outputs)
    address = _address(result)
    return any(address == _address(tensor) for tensor in _tensors(inputs))


_OUT: dict[OpOverload, Variant | None] = {}  # the variant that writes in place, by operation


def _in_place(func: OpOverload, args: Args, kwargs: Kwargs, result: Tensor | Sequence[Tensor | None]) -> Call:
    """Return the call that does the same and writes into `result`."""
    outputs = [result] if isinstance(result, Tensor) else list(result)
    tensors = [output for output in outputs if isinstance(output, Tensor)]
    whole = len(tensors) == len(outputs)  # a backward pass has None for gradients that are not needed
    if whole and func not in _OUT:
        _OUT[func] = next((v for v in _variants(func, len(tensors)) if _agrees(v, args, kwargs, tensors)), None)
    variant = _OUT[func] if whole else None
    if variant is not None:
        function, names = variant
        return partial(function, *args, **kwargs, **dict(zip(names, outputs, strict=True)))

    def copy() -> None:
        again = func(*args, **kwargs)
        for output, new in zip(outputs, [again] if isinstance(again, Tensor) else again, strict=True):
            if output is not None:
                output.copy_(new)

    return copy


def _variants(func: OpOverload, count: int) -> Iterator[Variant]:
    """Yield the ways to call an operation with outputs given: PyTorch's own function first, it costs least."""
    native = getattr(torch, func.overloadpacket.__name__, None)
    if native is not None and count == 1:
        yield native, ["out"]
    for name in func.overloadpacket.overloads():
        overload = getattr(func.overloadpacket, name)
        names = [a.name for a in overload._schema.arguments if a.alias_info is not None and a.alias_info.is_write]
        inputs = [a.name for a in overload._schema.arguments if a.name not in names]
        if len(names) == count and inputs == [a.name for a in func._schema.arguments]:
            yield overload, names


def _agrees(variant: Variant, args: Args, kwargs: Kwargs, outputs: Sequence[Tensor]) -> bool:
    """Return whether a variant writes the same bits as the operation gave."""
    function, names = variant
    trial = [torch.empty_like(output) for output in outputs]
    # some operations also change an input, for example the running means of batch normalization
    args, kwargs = tree_map_only(Tensor, torch.clone, (args, kwargs))
    try:
        function(*args, **kwargs, **dict(zip(names, trial, strict=True)))
    except (TypeError, RuntimeError, NotImplementedError):
        return False
    return all(
        new.shape == old.shape and new.stride() == old.stride() and torch.equal(_bits(new), _bits(old))
        for new, old in zip(trial, outputs, strict=True)
    )


def _bits(tensor: Tensor) -> Tensor:
    """Return a tensor whose equality is that of the bits, NaN included."""
    return tensor.contiguous().view(torch.uint8) if tensor.dim() else tensor.reshape(1).view(torch.uint8)
