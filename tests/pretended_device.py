"""A CUDA device that is pretended on a CPU build of torch, for tests: the CPU's numbers and bits under CUDA's rules.

Inside `pretended_cuda()` the name "cuda" works. A tensor moved there stays a CPU tensor; its storage is remembered, and
every tensor on that storage says that its device is cuda:0. What CUDA would refuse is refused in CUDA's words: operands
on two devices, results written to another device, .numpy(), a CPU generator, an index into a CPU tensor. What it would
pay for is counted by kind and by line of our source: kernels, waits of the host for the device, copies either way.

Two modes of torch do it: one sees the functions that Python calls (`device`, `to`, `torch.zeros`), the other the
operations that reach a kernel, those of autograd included. Not pretended: CUDA graphs, streams, CUDA generators (random
numbers of the device come from the CPU's global generator), several threads, memory, speed, CUDA's rounding.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest
import torch
from device_counts import DOWN, KERNELS, UP, WAITS, Counts
from torch import Tensor
from torch._C import DisableTorchFunction
from torch.autograd.graph import saved_tensors_hooks
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves

from wm_nodes.world_model.precision import cpu_has_fast_bfloat16

CUDA = torch.device("cuda", 0)

aten = torch.ops.aten
COPIES = {aten.copy_.default, aten._to_copy.default}
INDEXING = {
    aten.index.Tensor, aten._unsafe_index.Tensor, aten.index_put.default, aten.index_put_.default,
    aten._index_put_impl_.default,
}
READS = {aten._local_scalar_dense.default}
"""They wait, but start no kernel."""
READING_KERNELS = {
    aten.nonzero, aten.masked_select, aten.equal, aten._unique2, aten.unique_dim, aten.unique_consecutive,
    aten.bincount,
}
"""The size or the answer of their result is known on the device only: they wait."""
NO_KERNELS = {
    aten.empty, aten.empty_like, aten.empty_strided, aten.new_empty, aten.new_empty_strided, aten._unsafe_view,
    aten.set_, aten.resize_, aten.is_pinned, aten._has_compatible_shallow_copy_type,
}
"""Beside views."""
NO_CPU_SCALARS = {aten.cat, aten.stack, aten.index_select, aten.gather, aten.scatter, aten.embedding, aten.index_add}
"""They refuse even a number (a tensor of no dimensions) of the CPU, which other kernels take as an argument."""
MIXED = "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu!"
WRONG_GENERATOR = "Expected a 'cuda' device type for generator but found 'cpu'"


class _Memory:
    """The storages that are on the pretended device. A weak reference keeps a storage's address from being reused."""

    def __init__(self) -> None:
        self._known: dict[int, StorageWeakRef] = {}
        self._clean_at = 1000
        self.zeros_of_engine = False
        """Tensors made from nothing are a missing gradient's zeros, which autograd makes on the gradient's device."""

    def has(self, tensor: Tensor) -> bool:
        return tensor.layout == torch.strided and tensor.untyped_storage()._cdata in self._known

    def add(self, tensor: Tensor) -> Tensor:
        if len(self._known) > self._clean_at:
            self._known = {key: storage for key, storage in self._known.items() if not storage.expired()}
            self._clean_at = 2 * len(self._known) + 1000
        storage = tensor.untyped_storage()
        self._known[storage._cdata] = StorageWeakRef(storage)
        return tensor


class _Kernels(TorchDispatchMode):
    """Sees every operation that reaches a kernel: checks where its tensors are, counts it, places its results."""

    def __init__(self, memory: _Memory, counts: Counts):
        super().__init__()
        self.memory, self.counts = memory, counts

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        with DisableTorchFunction():
            if torch.is_inference_mode_enabled() and _is_made_of_others(func):
                with self:
                    return func._op_dk(torch._C.DispatchKey.CompositeImplicitAutograd, *args, **kwargs)
            tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
            there = [self.memory.has(tensor) for tensor in tensors]
            if not any(there):
                out = func(*args, **kwargs)
                if self.memory.zeros_of_engine and not tensors:
                    self.counts.add(KERNELS, str(func))
                    self.memory.add(out)
                return out
            if func in COPIES:
                return self._copy(func, args, kwargs, tensors, there)
            self._check(func, args, kwargs, tensors, there)
            out = func(*args, **kwargs)
            self._count(func)
            for leaf in tree_leaves(out):
                if isinstance(leaf, Tensor):
                    self.memory.add(leaf)
            return out

    def _copy(self, func: Any, args: Any, kwargs: Any, tensors: list[Tensor], there: list[bool]) -> Any:
        out = func(*args, **kwargs)
        if all(there):
            self.counts.add(KERNELS, str(func))
            return self.memory.add(out)
        _count_copy(self.counts, str(func), tensors[-1].nbytes, up=there[0])
        return out

    def _count(self, func: Any) -> None:
        packet = func.overloadpacket
        if func in READS or packet in READING_KERNELS:
            self.counts.add(WAITS, str(func))
        if not (func in READS or func.is_view or packet in NO_KERNELS):
            self.counts.add(KERNELS, str(func))

    def _check(self, func: Any, args: Any, kwargs: Any, tensors: list[Tensor], there: list[bool]) -> None:
        if kwargs.get("generator") is not None:
            raise RuntimeError(WRONG_GENERATOR)
        packet = func.overloadpacket
        if packet is aten._has_compatible_shallow_copy_type:
            return
        if func in INDEXING:
            self._check_indices(func, args)
            return
        written = {id(tensor) for tensor in tree_leaves(_written(func, args, kwargs))}
        for tensor, known in zip(tensors, there):
            if not known and (tensor.dim() > 0 or packet in NO_CPU_SCALARS or id(tensor) in written):
                shapes = ", ".join(f"{tuple(t.shape)} {CUDA if on else 'cpu'}" for t, on in zip(tensors, there))
                raise RuntimeError(f"{MIXED} (in {func}: {shapes})")

    def _check_indices(self, func: Any, args: Any) -> None:
        indexed, indices, *values = args
        if not self.memory.has(indexed):
            if any(index is not None and self.memory.has(index) for index in indices):
                raise RuntimeError(
                    "indices should be either on cpu or on the same device as the indexed tensor (cpu)"
                )
            raise RuntimeError(f"{MIXED} (in {func}: the values)")
        value = values[0] if values else None
        if value is not None and not self.memory.has(value) and value.dim() > 0:
            raise RuntimeError(f"{MIXED} (in {func}: the values)")
        given = [index for index in indices if index is not None]
        number = value is not None and not self.memory.has(value)
        fills = number and len(given) == 1 and given[0].dtype == torch.bool  # CUDA makes it a masked_fill_
        for index in given:
            if not self.memory.has(index):
                _count_copy(self.counts, f"{func} index", index.nbytes, up=True)
            elif index.dtype in (torch.bool, torch.uint8) and not fills:
                self.counts.add(WAITS, f"{func} mask")


def _is_made_of_others(func: Any) -> bool:
    """Say whether autograd would take `func` apart before a kernel is reached; inference mode does not."""
    has_kernel = torch._C._dispatch_has_kernel_for_dispatch_key
    return has_kernel(func.name(), "CompositeImplicitAutograd") and not has_kernel(func.name(), "CPU")


def _written(func: Any, args: Any, kwargs: Any) -> list[Any]:
    """Return the arguments that `func` writes to: the first of an operation in place, `out` of others."""
    given = {**dict(zip((argument.name for argument in func._schema.arguments), args)), **kwargs}
    return [given.get(a.name) for a in func._schema.arguments if a.alias_info is not None and a.alias_info.is_write]


def _count_copy(counts: Counts, kind: str, size: int, *, up: bool) -> None:
    counts.add(UP if up else DOWN, kind, size)
    if not up:
        counts.add(WAITS, kind)


class _Move(torch.autograd.Function):
    """A copy to the other side; its gradient is copied back."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, functions: "_Functions", up: bool) -> Tensor:
        ctx.functions, ctx.up = functions, up
        return functions.moved(tensor, up)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return ctx.functions.moved(gradient, not ctx.up), None, None


class _Functions(TorchFunctionMode):
    """Sees what Python calls: answers where a tensor is, moves tensors, makes them on the device."""

    def __init__(self, memory: _Memory, counts: Counts):
        super().__init__()
        self.memory, self.counts = memory, counts

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        first = args[0] if args and isinstance(args[0], Tensor) else None
        known = first is not None and self.memory.has(first)
        if known and func in PROPERTIES:
            return PROPERTIES[func]
        if known and name in SPECIAL:
            return SPECIAL[name](self, func, args, kwargs)
        if name == "to" and first is not None:
            return self._to(first, args[1:], kwargs)
        if name == "cuda" and first is not None:
            return self._to(first, (CUDA,), {})
        if name == "pin_memory":
            return first
        if kwargs.get("device") is not None:
            return self._make(func, name, first, args, kwargs)
        return self._call(func, args, kwargs)

    def run_backward(self, engine: Any, tensors: Any, *args: Any, **kwargs: Any) -> Any:
        """Run autograd's engine with this mode on: Python runs inside, in checkpoints and in functions of our own."""
        before = self.memory.zeros_of_engine
        self.memory.zeros_of_engine = any(self.memory.has(tensor) for tensor in tensors)
        try:
            with self:
                return engine(tensors, *args, **kwargs)
        finally:
            self.memory.zeros_of_engine = before

    def hooks(self, begin: Any) -> Any:
        """Return saved_tensors_hooks.__init__ whose pack hook, called from inside functions, runs with this mode on."""

        def init(hooks: Any, pack: Any, unpack: Any) -> None:
            def pack_with_mode(tensor: Tensor) -> Any:
                with self:
                    return pack(tensor)

            begin(hooks, pack_with_mode, unpack)

        return init

    def _call(self, func: Any, args: Any, kwargs: Any) -> Any:
        before, self.memory.zeros_of_engine = self.memory.zeros_of_engine, False
        try:
            return func(*args, **kwargs)
        finally:
            self.memory.zeros_of_engine = before

    def moved(self, tensor: Tensor, up: bool) -> Tensor:
        """Return a copy on the other side, and count it."""
        with _disable_current_modes(), DisableTorchFunction():
            _count_copy(self.counts, "to", tensor.nbytes, up=up)
            out = tensor.clone()
            return self.memory.add(out) if up else out

    def _to(self, tensor: Tensor, args: Any, kwargs: Any) -> Tensor:
        device, rest, flags = kwargs.pop("device", None), [], []
        other = kwargs.pop("other", None)
        for value in args if other is None else (other, *args):
            if isinstance(value, Tensor):
                device = CUDA if self.memory.has(value) else "cpu"
                rest.append(value.dtype)
            elif isinstance(value, bool):
                flags.append(value)
            elif isinstance(value, (str, int, torch.device)):
                device = value
            elif value is not None:
                rest.append(value)
        kwargs.pop("non_blocking", None)
        copy = kwargs.pop("copy", flags[1:] == [True])
        up = self.memory.has(tensor) if device is None else _is_cuda(device)
        moves = up != self.memory.has(tensor)
        changed = tensor.to(*rest, copy=copy and not moves, **kwargs) if rest or kwargs or copy else tensor
        return _Move.apply(changed, self, up) if moves else changed

    def _make(self, func: Any, name: str, first: Tensor | None, args: Any, kwargs: Any) -> Tensor:
        """Call a function that was given a device: torch.zeros, torch.tensor, new_zeros, zeros_like and the like."""
        up, known = _is_cuda(kwargs["device"]), first is not None and self.memory.has(first)
        from_tensor = first is not None and name in ("tensor", "as_tensor", "asarray")
        if not up and not known:
            return self._call(func, args, kwargs)
        if up and kwargs.get("generator") is not None:
            raise RuntimeError(WRONG_GENERATOR)
        device = kwargs.pop("device")
        if from_tensor:
            dtype = kwargs.get("dtype") or first.dtype
            return self._to(first.detach() if name == "tensor" else first, (device, dtype, False, name == "tensor"), {})
        with _disable_current_modes() if known else nullcontext():
            out = self._call(func, args, kwargs)
        if not up:
            return out
        if name in ("tensor", "as_tensor", "asarray", "new_tensor"):
            if name.startswith("as"):
                out = out.clone()  # it may share numpy's memory
            _count_copy(self.counts, name, out.nbytes, up=True)
        elif "empty" not in name:
            self.counts.add(KERNELS, name)
        return self.memory.add(out)

    def _refuse_numpy(self, func: Any, args: Any, kwargs: Any) -> Any:
        raise TypeError(
            "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host memory "
            "first."
        )

    def _read_all(self, func: Any, args: Any, kwargs: Any) -> Any:
        _count_copy(self.counts, func.__name__, args[0].nbytes, up=False)
        with _disable_current_modes():
            return func(*args, **kwargs)

    def _deepcopy(self, func: Any, args: Any, kwargs: Any) -> Tensor:
        self.counts.add(KERNELS, "deepcopy")
        with _disable_current_modes():
            return self.memory.add(func(*args, **kwargs))

    def _new_tensor(self, func: Any, args: Any, kwargs: Any) -> Tensor:
        return self._make(func, "new_tensor", args[0], args, {"device": CUDA, **kwargs})

    def _down(self, func: Any, args: Any, kwargs: Any) -> Tensor:
        return self._to(args[0], ("cpu",), {})


PROPERTIES = {
    Tensor.device.__get__: CUDA, Tensor.is_cuda.__get__: True, Tensor.is_cpu.__get__: False, Tensor.get_device: 0,
}
SPECIAL = {
    "numpy": _Functions._refuse_numpy, "__array__": _Functions._refuse_numpy, "tolist": _Functions._read_all,
    "__repr__": _Functions._read_all, "cpu": _Functions._down, "__deepcopy__": _Functions._deepcopy,
    "new_tensor": _Functions._new_tensor,
}


def _is_cuda(device: Any) -> bool:
    return isinstance(device, int) or torch.device(device).type == "cuda"


@contextmanager
def pretended_cuda() -> Iterator[Counts]:
    """Let "cuda" work inside, and yield what it would cost. Tensors of the device are of no use afterwards."""
    memory, counts = _Memory(), Counts()
    group, autocast = torch._C._group_tensors_by_device_and_dtype, torch.autocast.__init__

    def group_by_device(lists: Any, with_indices: bool = False) -> Any:
        groups = group(lists, with_indices).items()
        return {
            (CUDA if any(t is not None and memory.has(t) for t in found[0][0]) else device, dtype): found
            for (device, dtype), found in groups
        }

    def autocast_to_cpu(self: Any, device_type: str, *args: Any, **kwargs: Any) -> None:
        autocast(self, "cpu" if device_type == "cuda" else device_type, *args, **kwargs)

    def synchronize(*device: Any) -> None:
        counts.add(WAITS, "synchronize")

    stream = SimpleNamespace(synchronize=synchronize, wait_stream=lambda other: None)
    answers = {
        "is_available": True, "device_count": 1, "current_device": 0, "get_device_name": "pretended",
        "get_device_capability": (9, 0), "is_bf16_supported": cpu_has_fast_bfloat16(), "current_stream": stream,
        "memory_allocated": 0, "max_memory_allocated": 0, "memory_reserved": 0, "max_memory_reserved": 0,
        "mem_get_info": (2**36, 2**36), "reset_peak_memory_stats": None, "empty_cache": None, "set_device": None,
    }
    with ExitStack() as stack:
        for name, answer in answers.items():
            stack.enter_context(patch.object(torch.cuda, name, lambda *args, answer=answer, **kwargs: answer))
        stack.enter_context(patch.object(torch.cuda, "synchronize", synchronize))
        # a torch that is built for CUDA would look for a driver
        stack.enter_context(patch.object(torch.accelerator, "current_accelerator", lambda *args, **kwargs: None))
        stack.enter_context(patch.object(torch._C, "_group_tensors_by_device_and_dtype", group_by_device))
        stack.enter_context(patch.object(torch.autocast, "__init__", autocast_to_cpu))
        stack.enter_context(_Kernels(memory, counts))
        functions = stack.enter_context(_Functions(memory, counts))
        run_backward = partial(functions.run_backward, torch.autograd._engine_run_backward)
        stack.enter_context(patch.object(torch.autograd, "_engine_run_backward", run_backward))
        hooks = functions.hooks(saved_tensors_hooks.__init__)
        stack.enter_context(patch.object(saved_tensors_hooks, "__init__", hooks))
        yield counts


@dataclass(frozen=True)
class Device:
    """What the fixture `device` yields: the device's name, and what the work on it cost (None of a real one)."""

    name: str
    counts: Counts | None


@contextmanager
def on_device(kind: str) -> Iterator[Device]:
    """Yield a pretended device ("pretended") or the real one ("cuda"); skip the test where torch sees none."""
    if kind == "cuda":
        if not torch.cuda.is_available():
            pytest.skip(f"no GPU: torch {torch.__version__} sees none, and --device {kind} asks for a real one")
        yield Device("cuda", None)
        return
    with pretended_cuda() as counts:
        yield Device("cuda", counts)
