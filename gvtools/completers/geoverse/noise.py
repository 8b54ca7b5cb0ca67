"""Starting noise that depends on the run's seed and the view alone.

Not on which views go together, in which order, on the device, or on the dtype asked for.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence

import torch
from torch import Tensor


def view_seed(seed: int, *names: int | str) -> int:
    """A seed in [0, 2^63) of a run's seed and the draw's names, such as ("level1", "frame_7")."""
    text = json.dumps([int(seed), *names]).encode("utf-8")
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "big") >> 1


def seeded_noise(
    shape: Sequence[int],
    seeds: Sequence[Sequence[int]],
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Standard normal noise, drawn view by view in float32 on the CPU.

    Args:
        shape: (B, V, C, h, w); anything after B, V.
        seeds: B rows of V seeds, see ``view_seed``.
        device: of the result.
        dtype: of the result.
    """
    views = [
        torch.randn(tuple(shape[2:]), generator=torch.Generator().manual_seed(value))
        for row in seeds
        for value in row
    ]
    if not views:
        return torch.empty(tuple(shape), device=device, dtype=dtype)
    return torch.stack(views).reshape(tuple(shape)).to(device=device, dtype=dtype)
