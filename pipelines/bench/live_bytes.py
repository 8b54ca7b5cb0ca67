"""Bytes that tensors hold while code runs: on a CPU, or predicted without the numbers.

``LiveBytes`` sees every tensor that torch creates and forgets it when its memory is given back.
Within ``predicted()`` tensors have shapes, types and lifetimes, but no memory (torch's fake ones),
so that the same code runs for a model of any size.
"""

from __future__ import annotations

import multiprocessing
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import (
    DataDependentOutputException,
    DynamicOutputShapeException,
    FakeTensorMode,
)
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

_ATEN = torch.ops.aten
# Of a peak, by which the next one is larger at least; 0 would look through everything at each step.
NOTICED = 0.002
_expired = torch.UntypedStorage._expired
_forget = torch.UntypedStorage._free_weak_ref


class LiveBytes(TorchDispatchMode):
    """Counts the bytes of tensors created within it; views of one memory count once.

    What a kernel takes for itself and gives back before it returns is not seen. A new peak is
    noticed from ``NOTICED`` above the last one on: whether memory is still held has to be asked for
    every piece of it.

    Args:
        known: modules whose weights are counted elsewhere.
    """

    def __init__(self, known: Iterable[nn.Module] = ()) -> None:
        super().__init__()
        # Bytes, and torch's own weak reference, of every memory by its address.
        self._held: dict[int, tuple[int, Any]] = {}
        self._known = {
            tensor.untyped_storage()._cdata
            for module in known
            for tensor in (*module.parameters(), *module.buffers())
        }
        # At most what is held: what was given back since the last look is still in it.
        self._most = self._peak = 0

    def __torch_dispatch__(  # noqa: PLR0917
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Run an operation and count what it created."""
        kwargs = kwargs or {}
        try:
            out = func(*args, **kwargs)
        except (DataDependentOutputException, DynamicOutputShapeException):
            out = _supposed(func, *args, **kwargs)
        for leaf in tree_leaves(out):
            if isinstance(leaf, Tensor):
                self._hold(leaf)
        if self._most > self._peak * (1 + NOTICED):
            self._peak = max(self._peak, self.live)
        return out

    @property
    def live(self) -> int:
        """Bytes held now."""
        gone = [key for key, (_, weak) in self._held.items() if _expired(weak)]
        for key in gone:
            _forget(self._held.pop(key)[1])
        self._most = sum(size for size, _ in self._held.values())
        return self._most

    @property
    def peak(self) -> int:
        """The most bytes that were held since ``forget_peak``."""
        return self._peak

    @peak.setter
    def peak(self, value: int) -> None:
        self._peak = value

    def forget_peak(self) -> None:
        """Begin a new peak at what is held now."""
        self._peak = self.live

    def __exit__(self, *error: Any) -> None:
        """Let go of what was counted; ``peak`` stays."""
        super().__exit__(*error)
        for _, weak in self._held.values():
            _forget(weak)
        self._held.clear()
        self._most = 0

    def _hold(self, tensor: Tensor) -> None:
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key in self._known:
            return
        if key in self._held:
            # The address may be that of memory which was given back: torch's reference tells.
            if not _expired(self._held[key][1]):
                return
            size, weak = self._held.pop(key)
            _forget(weak)
            self._most -= size
        self._held[key] = (storage.nbytes(), storage._weak_ref())
        self._most += storage.nbytes()


@contextmanager
def predicted() -> Iterator[None]:
    """Within the block tensors have no numbers; models and views have to be made in it.

    For a process that does nothing else (``alone``): torch 2.13 has crashed where a process went on
    after training steps without numbers.
    """
    with FakeTensorMode(allow_non_fake_inputs=True), warnings.catch_warnings():
        # torch copies such a tensor by a way that it warns of itself.
        warnings.filterwarnings("ignore", "Accessing the data pointer of FakeTensor")
        yield


def alone(run: Callable[..., Any], *given: Any, **named: Any) -> Any:
    """``run(*given, **named)`` in a process of its own; all of it has to be picklable."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(run, *given, **named).result()


def _supposed(func: Any, *args: Any, **kwargs: Any) -> Any:
    """What an operation that depends on numbers gives in the ordinary, full case.

    Checks pass and every view is informative: a truth is True, a number 0, all places are found.
    """
    if func is _ATEN._local_scalar_dense.default:
        return True if args[0].dtype == torch.bool else 0.0
    if func is _ATEN.nonzero.default:
        return args[0].new_empty((args[0].numel(), args[0].ndim), dtype=torch.long)
    if func is _ATEN.unique_dim.default:
        index = args[0].new_empty(args[0].shape[args[1]], dtype=torch.long)
        return args[0].narrow(args[1], 0, 1).clone(), index, index[:1].clone()
    if func is _ATEN.index.Tensor and [index.dtype for index in args[1]] == [torch.bool]:
        mask = args[1][0]
        return args[0].new_empty((mask.numel(), *args[0].shape[mask.ndim :]))
    raise NotImplementedError(f"{func} depends on numbers, and none are there")
