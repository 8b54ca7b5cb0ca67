"""Denoising steps that look at some tokens alone; the others stay as the first step left them.

A completion changes what the memory does not know. Its tokens take every step; all others, of
photographs and of known parts of targets, take the first one, and what it computed of them (keys
and values of each block, and the prediction) is kept for the steps that follow. This is an
approximation: in a whole step they would be looked at again at the step's own time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from gvtools.completers.geoverse.projective import Projective

# Beyond this share of all tokens, a whole step costs hardly more.
MOST = 0.7


@dataclass(eq=False)
class NearTokens:
    """The tokens that take every step of one pass, and what the first step computed.

    Attributes:
        active: (A,) int64, their places among the V * N tokens.
        keys: encoded keys and values (1, heads, V * N, d) of each attention, in order.
        out: (1, V, C, h, w), the first step's prediction.
    """

    active: Tensor
    keys: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    out: Tensor | None = None

    @property
    def begun(self) -> bool:
        """Whether the first step was made."""
        return self.out is not None

    def chosen(self, x: Tensor) -> Tensor:
        """(1, 1, A, width) of tokens (1, V, N, width)."""
        return x.flatten(1, 2)[:, None, self.active]

    def attention(
        self, place: int, q: Tensor, k: Tensor, v: Tensor, positions: Projective
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Encoded queries of the active tokens (1, heads, A, d), keys and values of all.

        Args:
            place: of the attention among all of the network.
            q: (1, heads, A, d) of the active tokens.
            k: likewise.
            v: likewise.
            positions: of all tokens.
        """
        keys, values = (kept.clone() for kept in self.keys[place])
        keys[:, :, self.active] = self._encoded(k, positions.key, keys)
        values[:, :, self.active] = self._encoded(v, positions.value, values)
        return self._encoded(q, positions.query, keys), keys, values

    def output(self, o: Tensor, positions: Projective) -> Tensor:
        """(1, heads, A, d) results of attention, each in its token's own frame."""
        return self._encoded(o, positions.output, self.keys[0][0])

    def _encoded(self, x: Tensor, encode, like: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        whole = x.new_zeros((*x.shape[:2], like.shape[2], x.shape[3]))
        whole[:, :, self.active] = x
        return encode(whole)[:, :, self.active]

    def placed(self, tokens: Tensor, grid: tuple[int, int]) -> Tensor:
        """(1, V, C, h, w): the first step's prediction with the active tokens (1, 1, A, C) anew."""
        assert self.out is not None
        whole = self.out.flatten(3).transpose(2, 3).flatten(1, 2).clone()
        whole[:, self.active] = tokens[:, 0].to(whole.dtype)
        return whole.unflatten(1, (self.out.shape[1], -1)).transpose(2, 3).unflatten(3, grid)


def near_tokens(valid: Tensor, context: int, grid: tuple[int, int]) -> NearTokens | None:
    """The tokens of targets that hold an unknown pixel, and those around them.

    Args:
        valid: (B, V, 1, H, W) bool, what is known; context views come first.
        context: how many of them there are.
        grid: tokens a view (rows, columns).

    Returns:
        None where a whole step is as well: more than one batch, or most of the tokens.
    """
    if len(valid) != 1:
        return None
    unknown = 1 - valid[0].to(torch.float32)
    share = F.adaptive_max_pool2d(unknown, grid)
    around = F.max_pool2d(share, 3, stride=1, padding=1)
    around[:context] = 0
    active = around.flatten().nonzero()[:, 0]
    if not len(active) or len(active) > MOST * around.numel():
        return None
    return NearTokens(active)
