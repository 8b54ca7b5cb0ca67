"""Number types, fused attention and activation checkpointing of networks.

Networks compute in bfloat16 on CUDA cards of compute capability 8.0 and later, float16 on older
ones, whose bfloat16 is emulated and has no fused attention, float32 on CPUs. Half precision is
torch's autocast: products and convolutions are rounded, while what has to be exact (statistics,
norms and softmax sums, time frequencies, camera matrices, the geometry head) stays in float32.

Training does not use float16, whose gradients vanish without a loss scale: older cards train in
float32. On a CPU it takes bfloat16 where the processor multiplies it faster, which is measured.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from gvtools.errors import OptionError

# From this compute capability on, CUDA cards multiply bfloat16 themselves.
BFLOAT16_CAPABILITY = (8, 0)
# The measured layer: tokens, inputs, outputs. It takes a millisecond in float32, and runs on one
# thread, because such times are least disturbed by other programs.
PROBE = (128, 256, 512)
PROBE_ROUNDS = 5
# bfloat16 has to take at most this share of float32's time. A training step gains less than the
# layer (0.73 of the time where the layer takes 0.40), and a narrow choice could fall differently at
# the next start.
WORTH = 0.8


def named_device(name: str, *, option: str) -> torch.device:
    """The device of an option that is "auto" (CUDA where there is one), "cpu" or "cuda"."""
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise OptionError(
            f"{option} = 'cuda', and torch sees no CUDA device here; choose 'auto' or 'cpu'"
        )
    return torch.device("cuda" if there and name != "cpu" else "cpu")


def has_bfloat16(device: torch.device) -> bool:
    """Whether a CUDA card multiplies bfloat16 itself."""
    return torch.cuda.get_device_capability(device) >= BFLOAT16_CAPABILITY


def inference_type(precision: str, device: torch.device) -> torch.dtype:
    """The type that networks compute in when nothing is trained, see ``Precision``."""
    if precision != "auto":
        return named_type(precision)
    if device.type != "cuda":
        return torch.float32
    return torch.bfloat16 if has_bfloat16(device) else torch.float16


def training_type(precision: str, device: torch.device) -> torch.dtype:
    """The type that networks are trained in; see the module."""
    if precision != "auto":
        return named_type(precision)
    faster = has_bfloat16(device) if device.type == "cuda" else bfloat16_is_faster()
    return torch.bfloat16 if faster else torch.float32


def named_type(precision: str) -> torch.dtype:
    """Torch's type of the name "float32", "bfloat16" or "float16"."""
    found: torch.dtype = getattr(torch, precision)
    return found


def half_type(precision: str, device: torch.device) -> torch.dtype:
    """``named_type``, with float16 for bfloat16 on a CUDA card that does not multiply that."""
    dtype = named_type(precision)
    emulated = dtype == torch.bfloat16 and device.type == "cuda" and not has_bfloat16(device)
    return torch.float16 if emulated else dtype


def name_of(dtype: torch.dtype) -> str:
    """The reverse of ``named_type``."""
    return str(dtype).removeprefix("torch.")


def autocast(device: torch.device, dtype: torch.dtype) -> AbstractContextManager[Any]:
    """Products of ``dtype`` within the block; nothing changes for float32."""
    if dtype == torch.float32:
        return nullcontext()
    return torch.autocast(device.type, dtype=dtype)


def hold_in(dtype: torch.dtype, *modules: nn.Module | None) -> None:
    """Keep the weights of products in the type that autocast would round them to, in place.

    The results under autocast are the same to the last bit, without a rounded copy beside every
    float32 weight. Everything else (norms, tokens, tables, frequencies, statistics) keeps its type.
    Of modules that are frozen, and run under autocast alone; float32 changes nothing.
    """
    if dtype == torch.float32:
        return
    for module in modules:
        for layer in () if module is None else module.modules():
            if isinstance(layer, (nn.Linear, nn.Conv2d)):
                for name, weight in list(layer.named_parameters(recurse=False)):
                    held = weight.detach().to(dtype)
                    setattr(layer, name, nn.Parameter(held, requires_grad=False))


def on_device(
    tensor: Tensor, device: torch.device | str | None, *, dtype: torch.dtype | None = None
) -> Tensor:
    """A CPU tensor on a device; to a CUDA card through pinned memory, so that nobody waits."""
    if device is None or torch.device(device).type != "cuda":
        return tensor.to(device=device, dtype=dtype)
    return tensor.to(dtype=dtype).pin_memory().to(device, non_blocking=True)


def constant(values: Sequence[float], like: Tensor) -> Tensor:
    """(N,) of the type of ``like``, where it lies."""
    return on_device(torch.tensor(values, dtype=like.dtype), like.device)


class RememberedTable:
    """A table that is made of a learned one, made again when that or the key changes."""

    def __init__(self) -> None:
        self._made: tuple[Any, ...] | None = None

    def __call__(self, key: Any, learned: Tensor, make: Callable[[], Tensor]) -> Tensor:
        """What ``make`` gives of ``learned`` for this key; not remembered while it is trained."""
        if learned.requires_grad and torch.is_grad_enabled():
            return make()
        version = (key, learned.device, learned.dtype, learned._version)
        if self._made is None or self._made[0] is not learned or self._made[1] != version:
            self._made = (learned, version, make())
        table: Tensor = self._made[2]
        return table


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread of the CPU within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@cache
def bfloat16_is_faster() -> bool:
    """Whether this processor takes clearly less time for a layer in bfloat16, both ways."""
    with one_thread():
        return _least_seconds(torch.bfloat16) <= WORTH * _least_seconds(torch.float32)


def _least_seconds(dtype: torch.dtype) -> float:
    """Of a linear layer's forward and backward pass, after one that does not count."""
    tokens, inputs, outputs = PROBE
    # The caller's random numbers and gradient mode are left alone.
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs)
    x = torch.ones(tokens, inputs, requires_grad=True)
    seconds = []
    with torch.enable_grad():
        for parameter in layer.parameters():
            nn.init.constant_(parameter, 0.01)
        for _ in range(1 + PROBE_ROUNDS):
            start = time.perf_counter()
            with autocast(x.device, dtype):
                y = layer(x)
            y.float().sum().backward()
            seconds.append(time.perf_counter() - start)
    return min(seconds[1:])


class Recomputing(nn.Module):
    """A network whose repeated layers can run a second time in the backward pass."""

    # A layer keeps its inputs alone; everything within it is computed again when its gradient is
    # asked for. Results and gradients are the same.
    recompute: bool = False

    def layer(self, run: Callable[..., Any], *inputs: Any) -> Any:
        """``run(*inputs)``, whose activations are kept or not as ``recompute`` says."""
        if not (self.recompute and torch.is_grad_enabled()):
            return run(*inputs)
        return recompute(run, *inputs)


def recompute(run: Callable[..., Any], *inputs: Any) -> Any:
    """``run(*inputs)``, nothing random; only the inputs are kept for the backward pass."""
    return checkpoint(run, *inputs, use_reentrant=False, preserve_rng_state=False)


def set_recompute(module: nn.Module, recompute: bool) -> None:
    """Switch every network within ``module`` that knows how."""
    for part in module.modules():
        if isinstance(part, Recomputing):
            part.recompute = recompute


# CUDA's fused kernels ask for heads of a multiple of this size; others would get N x M scores.
FUSED_MULTIPLE = 8
# Scores that may exist at once where no fused kernel applies: 256 MB in float32.
MOST_SCORES = 2**26


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:  # (B, heads, N, d)
    """softmax(q kᵀ / sqrt(d)) v of (B, heads, N or M, d), with memory linear in N and M.

    On CUDA, torch takes flash attention in half precision (compute capability 8.0 and later, heads
    of up to 256 channels) and its memory-efficient kernel otherwise (float32; float16 on older
    cards), which asks for heads of a multiple of 8 channels, 4 in float32, adjacent in memory. No
    fused kernel takes float64, or bfloat16 on older cards: these go by chunks of queries, each
    computed again in the backward pass. On a CPU the fused kernel is also the faster one from about
    100 tokens on in float32; in bfloat16 the products may win, but round the scores.
    """
    if not _is_fused(q):
        # As many queries at a time as ``MOST_SCORES`` allows.
        rows = max(1, MOST_SCORES // (q.shape[0] * q.shape[1] * k.shape[2]))
        chunks = q.split(rows, dim=2)
        parts = [recompute(F.scaled_dot_product_attention, part, k, v) for part in chunks]
        return torch.cat(parts, dim=2)
    size = q.shape[-1]
    lacking = -size % FUSED_MULTIPLE
    if not lacking or q.device.type != "cuda":
        return F.scaled_dot_product_attention(q, k, v)
    # Zeros add nothing to the scores; the scale stays that of the true head.
    q, k, v = (F.pad(tensor, (0, lacking)) for tensor in (q, k, v))
    return F.scaled_dot_product_attention(q, k, v, scale=size**-0.5)[..., :size]


def _is_fused(q: Tensor) -> bool:
    """Whether torch has a fused kernel for queries of this type on their device."""
    if q.device.type == "cpu":
        return True
    # Autocast leaves float64 as it is.
    if q.device.type != "cuda" or q.dtype == torch.float64:
        return False
    dtype = q.dtype
    if torch.is_autocast_enabled(q.device.type):
        dtype = torch.get_autocast_dtype(q.device.type)
    return dtype != torch.bfloat16 or has_bfloat16(q.device)
