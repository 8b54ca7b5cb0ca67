"""Training samples: context views with faults, their memory projected into targets, the truth.

Views are lifted to the project's memory and splatted to the targets as inference does it, by the
same code: back-projection, fusion, projection, reduction to the model's size. A memory of four
views at 96 x 96 costs milliseconds, so nothing faster stands in.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gvtools.cameras import Cameras
from gvtools.completers.base import ContextView
from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.flow import seeded_noise, view_seed
from gvtools.completers.geoverse.views import resample_nearest, view_batch
from gvtools.completers.surface_fill import surface_fill
from gvtools.guidance import Guidance
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.networks.compute import one_thread
from gvtools.training.corruption import (
    NOTHING,
    CorruptionOptions,
    corrupted_camera,
    corrupted_color,
    corrupted_depth,
)

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Clip:
    """Ordered views of one size with pictures and depth."""

    rgb: NDArray[np.uint8]  # (V, H, W, 3) uint8
    depth: Float32  # (V, H, W) float32 z-depth, scene units, 0 = none
    cameras: Cameras  # V of them

    def __len__(self) -> int:
        return len(self.rgb)


@dataclass(frozen=True, eq=False)
class Observation:
    """Context views as a user has them, and where they are believed to stand."""

    # pictures and depth in the true cameras, which the model is told
    views: tuple[ContextView, ...]
    lifted: tuple[Cameras, ...]  # the cameras that their depth is lifted by


def observe_context(
    clip: Clip, context: Sequence[int], strength: CorruptionOptions, *, rng: np.random.Generator
) -> Observation:
    """Context views of a clip with faults of this strength."""
    known = clip.depth[list(context)]
    unit = float(known[known > 0].mean()) if (known > 0).any() else 1.0
    views, lifted = [], []
    for number, index in enumerate(context):
        camera = clip.cameras[index]
        rgb = clip.rgb[index]
        depth = corrupted_depth(rng, clip.depth[index], strength)
        own = strength if number else strength.replaced(exposure=0.0, color=0.0, dropped=0.0)
        rgb = corrupted_color(rng, rgb, own)
        dropped = rng.random() < own.dropped
        lifted.append(corrupted_camera(rng, camera, unit, strength=strength))
        picture = (rgb / np.float32(255)).astype(np.float32)
        views.append(ContextView(camera.names[0], camera, picture, None if dropped else depth))
    return Observation(tuple(views), tuple(lifted))


def project_observation(observation: Observation, targets: Cameras) -> Guidance:
    """The memory of some observed views, with a run's defaults, projected into target cameras."""
    lifted = [
        (np.rint(view.rgb * 255).astype(np.uint8), view.depth, camera)
        for view, camera in zip(observation.views, observation.lifted, strict=True)
        if view.depth is not None and (view.depth > 0).any()
    ]
    footprints = [
        np.median(depth[depth > 0]) / np.sqrt(camera.K[0, 0, 0] * camera.K[0, 1, 1])
        for _, depth, camera in lifted
    ]
    voxel = float(np.median(footprints)) if lifted else 1.0
    memory = SpatialMemory(voxel, origin=targets.centers[0])
    for rgb, depth, camera in lifted:
        memory.observe(rgb, depth, camera, round=0)
    return memory.project(targets)


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """V views, the context first, both parts in the order of the path.

    The world is the first view's frame; the unit is the mean depth of what the context knows.
    """

    images: Tensor  # (V, 3, H, W) true pictures in [0, 1]
    depth: Tensor  # (V, 1, H, W) true z-depth; 0 = unknown
    # (V, 3, H, W): context pictures as given; projections on targets, holes at 0 or filled
    hint: Tensor
    hint_depth: Tensor  # (V, 1, H, W): likewise; 0 = none
    valid: Tensor  # (V, 1, H, W) bool: True on context; True where the projection knows a target
    evidence: Tensor  # (V, 2, H, W) of the fill, see ``ViewBatch``; zeros without one
    cam_from_world: Tensor  # (V, 4, 4)
    K: Tensor  # (V, 3, 3), pixels, pixel centres at + 0.5
    place: Tensor  # (V,) int64, where each view stands along the path
    context: int  # number of context views
    notes: tuple[str, ...] = ()  # what happened when it was drawn, to be counted, see ``data``


# The parts of a sample that are tensors.
TENSORS = tuple(
    part.name for part in fields(TrainingSample) if part.name not in ("context", "notes")
)


def make_sample(
    clip: Clip,
    truth: Clip,
    context: Sequence[int],  # which of them are given, ascending
    *,
    rng: np.random.Generator,
    strength: CorruptionOptions = NOTHING,
    fill: str = "none",  # of the model's configuration, ``hints.fill``
    more: Clip | None = None,
) -> TrainingSample:
    """A sample from views in the order of their path, the same on any number of threads."""
    targets = [index for index in range(len(clip)) if index not in context]
    observation = observe_context(clip, context, strength, rng=rng)
    known = observation
    if more is not None:
        further = observe_context(more, range(len(more)), strength, rng=rng)
        known = Observation(known.views + further.views, known.lifted + further.lifted)
    guidance = project_observation(known, clip.cameras[targets])
    size = truth.depth.shape[1], truth.depth.shape[2]
    # Torch's averages differ in the last digit by how many threads share them.
    with one_thread():
        over = surface_fill(known.views, guidance) if fill == "surfaces" else None
        views, cameras = view_batch(observation.views, guidance, size, fill=over)
    order = [*context, *targets]
    true_depth = torch.from_numpy(truth.depth[order])[:, None]
    observed = [view.depth for view in observation.views if view.depth is not None]
    unit = _mean_known([resample_nearest(depth, size).numpy() for depth in observed])
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
    return TrainingSample(
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


def _mean_known(depths: Sequence[Float32]) -> float:
    """Mean of all depth above 0; 0 where there is none.

    Not by torch, whose sums depend on the number of threads in their last digit.
    """
    known = np.concatenate([np.zeros(0), *(depth[depth > 0] for depth in depths)])
    return float(known.mean()) if known.size else 0.0


def collate(samples: Sequence[TrainingSample]) -> TrainingBatch:
    """Samples of one size and one number of context views as a batch."""
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


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """Views with their hints, and the truth of all of them."""

    # as the model gets them: context pictures and depth, then the targets' projections
    views: ViewBatch
    images: Tensor  # (B, V, 3, H, W) true pictures in [0, 1]
    depth: Tensor  # (B, V, 1, H, W) true z-depth; 0 = unknown
    # how often what happened when its samples were drawn
    notes: Mapping[str, int] = field(default_factory=dict)

    @property
    def true_views(self) -> ViewBatch:
        """The same views with true pictures and depth everywhere."""
        return replace(
            self.views,
            images=self.images,
            depth=self.depth,
            valid=torch.ones_like(self.views.valid),
        )

    @property
    def unprojected(self) -> TrainingBatch:
        """The same views with nothing projected into the targets."""
        context = self.views.context
        known = torch.zeros_like(self.views.valid)
        known[:, :context] = True
        views = replace(
            self.views,
            images=self.views.images * known,
            depth=self.views.depth * known,
            valid=self.views.valid & known,
        )
        return replace(self, views=views)

    @property
    def relative(self) -> Tensor:
        """(B, V, 4, 4) float64 cameras from the frame of the first view."""
        pose = self.views.cam_from_world.double()
        return pose @ torch.linalg.inv(pose[:, :1])

    @property
    def centers(self) -> Tensor:
        """(B, V, 3) true camera centres in the frame of the first view."""
        rotation, translation = self.relative[..., :3, :3], self.relative[..., :3, 3:]
        return -(rotation.mT @ translation)[..., 0].to(self.images.dtype)

    def to(self, device: torch.device | str) -> TrainingBatch:
        """On another device."""
        images, depth = self.images.to(device), self.depth.to(device)
        return TrainingBatch(self.views.to(device), images, depth, self.notes)


@dataclass(frozen=True)
class Draws:
    """Draws for one mini-batch."""

    seed: int  # of the training
    stage: str  # its name
    step: int  # number of the optimiser step
    # the numbers of the step's samples, B of them; none occurs twice in a training
    samples: tuple[int, ...]

    def chance(self, name: str, share: float) -> bool:
        """Whether something happens in this step; the same for all samples and processes."""
        return float(self.numbers(name, 1)) < share

    def numbers(self, name: str, count: int) -> Tensor:
        """(count,) in [0, 1); the same for all samples and processes."""
        seed = view_seed(self.seed, self.stage, name, "step", self.step)
        return torch.rand(count, generator=torch.Generator().manual_seed(seed))

    def uniform(self, name: str, *shape: int) -> Tensor:
        """(B, *shape) in [0, 1), float32 on the CPU."""
        return torch.stack([torch.rand(shape, generator=g) for g in self._generators(name)])

    def normal(self, name: str, shape: Sequence[int], device: torch.device | str) -> Tensor:
        """(B, V, ...) standard normal, every view by itself."""
        return seeded_noise(shape, self.seeds(name, int(shape[1])), device=device)

    def seeds(self, name: str, views: int) -> list[list[int]]:
        """B rows of a seed for every view."""
        return [
            [view_seed(self.seed, self.stage, name, sample, view) for view in range(views)]
            for sample in self.samples
        ]

    def _generators(self, name: str) -> list[torch.Generator]:
        return [
            torch.Generator().manual_seed(view_seed(self.seed, self.stage, name, sample))
            for sample in self.samples
        ]
