"""One training sample: a clip's context views, what memory tells of its targets, and the truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.views import view_batch
from gvtools.completers.surface_fill import surface_fill
from gvtools.errors import ShapeError
from gvtools.training.batch import TrainingBatch
from gvtools.training.corruption import NOTHING, CorruptionOptions
from gvtools.training.hints import Clip, observed, projected

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Sample:
    """V views, the context first, both parts in the order of the path.

    The world is the first view's frame; the unit is the mean depth of what the context knows.

    Attributes:
        images: (V, 3, H, W) true pictures in [0, 1].
        depth: (V, 1, H, W) true z-depth; 0 = unknown.
        hint: (V, 3, H, W): context pictures as given; projections on targets, holes at 0 or filled.
        hint_depth: (V, 1, H, W): likewise; 0 = none.
        valid: (V, 1, H, W) bool: True on context; True where the projection knows a target.
        evidence: (V, 2, H, W) of the fill, see ``ViewBatch``; zeros without one.
        cam_from_world: (V, 4, 4).
        K: (V, 3, 3), pixels, pixel centres at + 0.5.
        place: (V,) int64, where each view stands along the path.
        context: number of context views.
        notes: what happened when it was drawn, to be counted, see ``mixture``.
    """

    images: Tensor
    depth: Tensor
    hint: Tensor
    hint_depth: Tensor
    valid: Tensor
    evidence: Tensor
    cam_from_world: Tensor
    K: Tensor
    place: Tensor
    context: int
    notes: tuple[str, ...] = ()


# The parts of a sample that are tensors.
TENSORS = tuple(part.name for part in fields(Sample) if part.name not in ("context", "notes"))


def make_sample(
    clip: Clip,
    truth: Clip,
    context: Sequence[int],
    *,
    rng: np.random.Generator,
    strength: CorruptionOptions = NOTHING,
    fill: str = "none",
    more: Clip | None = None,
) -> Sample:
    """A sample from views in the order of their path, the same on any number of threads.

    Args:
        clip: what is observed and lifted, in any size.
        truth: the same views at the model's size.
        context: which of them are given, ascending.
        rng: draws the faults.
        strength: of this sample's faults.
        fill: of the model's configuration, ``hints.fill``.
        more: further views that memory is made of, and that the model is not shown; of any size.
    """
    targets = [index for index in range(len(clip)) if index not in context]
    observation = observed(clip, context, strength, rng=rng)
    known = observation
    if more is not None:
        known = observation.with_more(observed(more, range(len(more)), strength, rng=rng))
    guidance = projected(known, clip.cameras[targets])
    size = truth.depth.shape[1], truth.depth.shape[2]
    with _one_thread():
        over = surface_fill(known.views, guidance) if fill == "surfaces" else None
        views, cameras = view_batch(observation.views, guidance, size, fill=over)
    order = [*context, *targets]
    true_depth = torch.from_numpy(truth.depth[order])[:, None]
    unit = _mean_known([_at_size(view.depth, size) for view in observation.views])
    unit = unit or _mean_known([truth.depth[list(context)]]) or 1.0
    # The batch's own unit is one of its cameras; here lengths are in one of depth.
    factor = 1 / (_mean_known([views.depth[0, : len(context)].numpy()]) or 1.0)
    relative = cameras.cam_from_world @ cameras.world_from_cam[:1]
    relative[:, :3, 3] /= unit
    hint = views.images[0]
    if strength.projection > 0:
        noise = rng.standard_normal(hint.shape, np.float32)
        noise[: len(context)] = 0
        noisy = hint + strength.projection * torch.from_numpy(noise)
        hint = torch.where(views.valid[0], noisy, hint).clamp(0, 1)
    pictures = torch.from_numpy(truth.rgb[order]).permute(0, 3, 1, 2)
    return Sample(
        images=pictures.float() / 255,
        depth=true_depth / unit,
        hint=hint.contiguous(),
        hint_depth=views.depth[0] * factor,
        valid=views.valid[0],
        evidence=torch.zeros(len(order), 2, *size) if views.evidence is None else views.evidence[0],
        cam_from_world=torch.from_numpy(relative).float(),
        K=views.K[0],
        place=torch.tensor(order),
        context=len(context),
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Torch's averages differ in the last digit by how many threads share them."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _at_size(depth: Float32 | None, size: tuple[int, int]) -> Float32:
    """(1, 1, h, w) depth under the model's pixel centres; nothing where there is none."""
    if depth is None:
        return np.zeros((1, 1, 0, 0), np.float32)
    return F.interpolate(
        torch.from_numpy(depth)[None, None], size=size, mode="nearest-exact"
    ).numpy()


def _mean_known(depths: Sequence[Float32]) -> float:
    """Mean of all depth above 0; 0 where there is none.

    Not by torch, whose sums depend on the number of threads in their last digit.
    """
    known = np.concatenate([depth[depth > 0] for depth in depths]).astype(np.float64)
    return float(known.mean()) if known.size else 0.0


def collated(samples: Sequence[Sample]) -> TrainingBatch:
    """Samples of one size and one number of context views as a batch."""
    kinds = {(tuple(sample.images.shape), sample.context) for sample in samples}
    if len(kinds) != 1:
        raise ShapeError(
            f"a batch of samples with {sorted(kinds)} as shapes and context counts; expected one; "
            "take the samples of a batch from one group"
        )
    stacked = {name: torch.stack([getattr(sample, name) for sample in samples]) for name in TENSORS}
    notes = Counter(note for sample in samples for note in sample.notes)
    views = ViewBatch(
        images=stacked["hint"],
        depth=stacked["hint_depth"],
        valid=stacked["valid"],
        cam_from_world=stacked["cam_from_world"],
        K=stacked["K"],
        context=samples[0].context,
        evidence=stacked["evidence"],
    )
    return TrainingBatch(views, stacked["images"], stacked["depth"], notes)
