"""How views become the frames of clips for a causal video VAE, and which latent holds which view.

The VAE takes clips of 4k + 1 frames and gives 1 + k latents: the first frame alone, then four by
four. It drops the rest of other lengths without a word, so clips have such a length here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gvtools.errors import OptionError

GROUP = 4


@dataclass(frozen=True)
class ViewLayout:
    """Views in clips.

    Attributes:
        clips: the view shown by each frame of each clip; all clips have 4k + 1 frames.
    """

    clips: tuple[tuple[int, ...], ...]

    @property
    def views_of_latent(self) -> tuple[tuple[int, ...], ...]:
        """The views that each latent holds, clip after clip."""
        views = []
        for clip in self.clips:
            groups = [clip[:1]] + [clip[i : i + GROUP] for i in range(1, len(clip), GROUP)]
            views += [tuple(sorted(set(group))) for group in groups]
        return tuple(views)

    @property
    def latent_of_view(self) -> tuple[int, ...]:
        """The latent that each view is in."""
        where = {v: i for i, views in enumerate(self.views_of_latent) for v in views}
        return tuple(where[view] for view in sorted(where))


def _each_alone(views: int) -> tuple[tuple[int, ...], ...]:
    return tuple((view,) for view in range(views))


def _as_video(views: int) -> tuple[tuple[int, ...], ...]:
    repeats = (1 - views) % GROUP
    return ((*range(views), *[views - 1] * repeats),)


def _four_times(views: int) -> tuple[tuple[int, ...], ...]:
    return ((0, *(view for view in range(1, views) for _ in range(GROUP))),)


_LAYOUTS: dict[str, Callable[[int], tuple[tuple[int, ...], ...]]] = {
    "per_view": _each_alone,
    "video9": _as_video,
    "repeat4": _four_times,
}
LAYOUTS = tuple(_LAYOUTS)


def view_layout(name: str, views: int) -> ViewLayout:
    """One of the ways to show views to the VAE.

    Args:
        name: "per_view": each view is a clip of one frame, as Wan encodes reference images.
            "video9": one clip of all views, the last one repeated up to 4k + 1 frames (nine for
            eight views); after the first, four views share a latent. "repeat4": one clip, the
            first view once and every other one four times, so each has its latent.
        views: how many.
    """
    if name not in _LAYOUTS:
        raise OptionError(f"video layout {name!r}; expected one of {', '.join(LAYOUTS)}")
    return ViewLayout(_LAYOUTS[name](views))


def packed_mask(generate: Tensor, layout: ViewLayout, *, stride: int = 8) -> Tensor:
    """VACE's mask channels: the pixels of each latent's block side by side.

    A latent of several views is to be generated where any of them is: resampling the mask in time,
    as VACE does for true video, would give a latent the mask of a view that it does not hold.

    Args:
        generate: (B, V, 1, H, W), 1 = to be generated.
        layout: of the views.
        stride: pixels of a latent's edge.

    Returns:
        (B, stride^2, F, H / stride, W / stride); channel = row * stride + column.
    """
    latents = [generate[:, list(views), 0].amax(dim=1) for views in layout.views_of_latent]
    packed = [F.pixel_unshuffle(mask[:, None], stride) for mask in latents]
    return torch.stack(packed, dim=2)
