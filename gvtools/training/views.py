"""Views that samples are made of: procedural scenes, and windows of recorded ones."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from gvtools.cameras import Cameras, concatenate
from gvtools.completers.geoverse.views import crop_to_aspect, resample, resample_nearest
from gvtools.errors import DegenerateError, GvError, ProjectError
from gvtools.procedural.layouts import scene
from gvtools.procedural.paths import camera_path
from gvtools.procedural.render import radiance, to_srgb
from gvtools.procedural.textures import PHOTOGRAPHS, photograph_names
from gvtools.scenes.collection import SceneCollection
from gvtools.scenes.scene import View
from gvtools.scenes.selection import select
from gvtools.training.corruption import GENTLE, CorruptionOptions, draw_strengths
from gvtools.training.samples import Clip, TrainingSample, make_sample

COUNTS = 101  # the stream of random numbers that counts are drawn from
EXTRAPOLATION = 0.5  # chance that the first views are given, and not views all along the path
ENDS = 0.4  # chance, of the other cases, that both ends are given and not every k-th view


@dataclass(frozen=True)
class ContextChoice:
    """How many views are given, and which."""

    most: int = 4  # context views; at least one is given
    # so many samples in a row have the same number, so that a batch of them is possible
    group: int = 8

    def count(self, seed: list[int], index: int) -> int:
        """The number of context views of a sample of the data set with this seed."""
        rng = np.random.default_rng([*seed, index // self.group, COUNTS])
        return int(rng.integers(1, self.most + 1))

    def choose(self, rng: np.random.Generator, views: int, count: int) -> tuple[int, ...]:
        """Which of a path's views are given, ascending."""
        rule: Literal["every", "ends", "first"] = "first"
        if rng.random() >= EXTRAPOLATION:
            rule = "ends" if rng.random() < ENDS else "every"
        return choose_context(rng, views, count, rule=rule)


def choose_context(
    rng: np.random.Generator,
    views: int,
    count: int,
    *,
    # every k-th view, placed by ``rng``; evenly spaced with both ends; or the first ones
    rule: Literal["every", "ends", "first"],
) -> tuple[int, ...]:
    """Which views of a path are given, ascending."""
    if rule == "first":
        return tuple(range(count))
    if rule == "ends":
        last = views - 1
        return tuple(round(i * last / max(count - 1, 1)) for i in range(count))
    step = views // count
    start = int(rng.integers(0, views - step * (count - 1)))
    return tuple(start + step * i for i in range(count))


# Streams of random numbers of one sample.
SCENE, PATH, FAULTS = range(3)
# The same streams of procedural and recorded samples do not meet.
PROCEDURAL, RECORDED, MIXED = range(3)


class InvalidSampleError(DegenerateError):
    """A sample that is not to be learnt from."""

    def __init__(
        self,
        # a scene cannot be opened, a view cannot be read, views hardly share anything, too little
        # depth
        reason: Literal["scene", "unreadable", "overlap", "depth"],
        message: str,
    ) -> None:
        super().__init__(message)
        self.reason = reason

    def __reduce__(self) -> tuple[type[InvalidSampleError], tuple[str, str]]:
        # Errors travel from workers to the training.
        return type(self), (self.reason, str(self))


class Samples(Protocol):
    """A data set of samples by number.

    A sample follows from seed, split and number alone: no state is kept and no global random
    number is drawn, so that workers, processes and a continued training see what one process would
    have seen.
    """

    def sample(self, index: int) -> TrainingSample:
        """The sample of a number, 0 or more."""
        ...

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        ...


@dataclass(frozen=True, eq=False)
class SampleInputs:
    """What a sample is made of."""

    clip: Clip  # its true views in order
    context: tuple[int, ...]  # which of them are given, ascending
    strength: CorruptionOptions  # of its faults
    rng: np.random.Generator  # draws the faults; used up by one sample


@dataclass(frozen=True, kw_only=True, eq=False)
class ClipSamples(ABC):
    """Samples of clips: some views of each are given, with faults, the others are targets."""

    seed: int = 0  # 0 or more
    split: str = "train"  # "train" or "held-out": other photographs, layouts and numbers
    views: int = 8  # of a sample, context and targets
    size: tuple[int, int] = (96, 96)  # (H, W) of the pictures
    # how many views are given, and which
    context: ContextChoice = field(default_factory=ContextChoice)
    # see CorruptionOptions; None for clean observations
    faults: CorruptionOptions | None = field(default_factory=CorruptionOptions)
    fill: str = "none"  # of the model's configuration, ``hints.fill``

    @abstractmethod
    def clips(self, index: int, attempt: int = 0) -> tuple[Clip, Clip]:
        """The views of a sample: as they are observed, and at the model's size."""

    @abstractmethod
    def rng(self, index: int, stream: int, attempt: int = 0) -> np.random.Generator:
        """A stream of random numbers of a sample."""

    def sample(self, index: int, attempt: int = 0) -> TrainingSample:
        """The sample of a number, 0 or more."""
        inputs, truth = self.inputs(index, attempt)
        clip, context, draws = inputs.clip, inputs.context, inputs.rng
        return make_sample(
            clip, truth, context, rng=draws, strength=inputs.strength, fill=self.fill
        )

    def inputs(self, index: int, attempt: int = 0) -> tuple[SampleInputs, Clip]:
        """What the sample of a number is made of, and its true views at the model's size."""
        clip, truth = self.clips(index, attempt)
        rng = self.rng(index, FAULTS, attempt)
        strength = draw_strengths(rng, self.faults or CorruptionOptions(clean=1.0))
        count = self.context.count(context_seed(self.seed, self.split), index)
        context = self.context.choose(rng, self.views, count)
        return SampleInputs(clip, context, strength, rng), truth

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        plain = {name: getattr(self, name) for name in ("seed", "views", "size", "fill")}
        faults = None if self.faults is None else self.faults.to_dict()
        return {**plain, "context": asdict(self.context), "faults": faults}


@dataclass(frozen=True, kw_only=True, eq=False)
class ProceduralViews(ClipSamples):
    """Views of procedural scenes; every number has a scene of its own, the same at any attempt."""

    def rng(self, index: int, stream: int, attempt: int = 0) -> np.random.Generator:
        """A stream of random numbers of a sample."""
        return np.random.default_rng([*context_seed(self.seed, self.split), index, stream])

    def clips(self, index: int, attempt: int = 0) -> tuple[Clip, Clip]:
        """The views of a sample, observed at the model's size."""
        clip = self.clip(index)
        return clip, clip

    def clip(self, index: int) -> Clip:
        """The true views of a sample in order."""
        place = scene(self.rng(index, SCENE), self.split)
        cameras = camera_path(
            self.rng(index, PATH), place.geometry, views=self.views, size=self.size
        )
        light, depth = radiance(place.geometry, place.look, cameras)
        exposure = place.key / max(float(light.mean()), 1e-6)
        return Clip(to_srgb(light, exposure), depth, cameras)

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        photographs = photograph_names(self.split)
        return {"source": "procedural", **super().describe(), "photographs": photographs}


def context_seed(seed: int, split: str = "train") -> list[int]:
    """What numbers of context views are drawn with: one for all sources that batches mix."""
    return [seed, PROCEDURAL, list(PHOTOGRAPHS).index(split)]


ATTEMPTS = 40
MOST_STRIDE = 6  # steps between the views of a window
DETAIL = 2  # memory is made at so many times the model's size, where a view is large enough
KEPT_FRAMES = 512  # reduced frames that are kept, so that files are read once
# Depths that differ by no more than this share belong to one surface.
SAME_SURFACE = 0.1
PROBE = 24  # points along a side of a picture that overlap is measured with
# Depth is incomplete where a view has it in less than this share of its pixels. The paper states no
# threshold; a Kinect's registered depth covers 72 % of the sample of 7-Scenes.
LEAST_DEPTH = 0.1
KEPT_SCENES = 32  # scenes of large collections that a process keeps open


class TooFewViewsError(ProjectError):
    """A scene has fewer views with depth than a sample."""


@dataclass(frozen=True, eq=False)
class SampleView:
    """One view, cropped and reduced."""

    observed: Clip  # as memory is made of it, at up to ``DETAIL`` times the model's size
    truth: Clip  # at the model's size


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneViews(ClipSamples):
    """Windows of recorded scenes, cropped about their centre; of each attempt another one.

    A scene is drawn in proportion to the root of its number of views with depth; where that is not
    known before a scene is opened, all are equally likely. What depth a view has counts as true.
    Faults are added on top of what real depth has anyway, so the default is gentle.
    """

    # with depth; views without any are left out. Those that are open are checked at once, others
    # when they are drawn.
    scenes: SceneCollection
    select: str = "all"  # which of a scene's views are used, see ``selection.select``
    # least share of a view's depth that the next view of the window shows, too
    overlap: float = 0.4
    faults: CorruptionOptions | None = GENTLE
    _shares: NDArray[np.float64] = field(init=False, repr=False, default_factory=lambda: np.ones(0))

    def __post_init__(self) -> None:
        counts = self.scenes.counts
        if self.scenes.opened:
            counts = tuple(len(_usable(self, number)) for number in range(len(self.scenes)))
        shares = np.ones(len(self.scenes)) if counts is None else np.sqrt(counts)
        if counts is not None:
            # Known to be too short.
            shares[np.array(counts) < self.views] = 0
        if not shares.any():
            raise ProjectError(
                f"{self.scenes.title}: no scene has {self.views} views with depth; give scenes "
                "with recorded depth, or fewer views a sample"
            )
        object.__setattr__(self, "_shares", shares / shares.sum())

    def rng(self, index: int, stream: int, attempt: int = 0) -> np.random.Generator:
        """A stream of random numbers of a sample."""
        return np.random.default_rng([self.seed, RECORDED, index, stream, attempt])

    def clips(self, index: int, attempt: int = 0) -> tuple[Clip, Clip]:
        """The window of a sample: as it is observed, and at the model's size."""
        rng = self.rng(index, PATH, attempt)
        number = int(rng.choice(len(self._shares), p=self._shares))
        try:
            views = _usable(self, number)
        except GvError as error:
            too_few = isinstance(error, TooFewViewsError)
            raise InvalidSampleError("depth" if too_few else "scene", str(error)) from None
        best = 0.0
        for trial in range(ATTEMPTS):
            rows = self._rows(rng, len(views), trial)
            try:
                frames = [_cached_view(views[row], self.size) for row in rows]
            except GvError as error:
                raise InvalidSampleError("unreadable", str(error)) from None
            truth = concatenate_clips([frame.truth for frame in frames])
            covered = float((truth.depth > 0).mean((1, 2)).min())
            if covered < LEAST_DEPTH:
                raise InvalidSampleError(
                    "depth",
                    f"{self.scenes.title}: a view has depth in {covered:.0%} of its pixels; "
                    f"expected {LEAST_DEPTH:.0%}",
                )
            found = min(overlaps(truth))
            best = max(best, found)
            if found >= self.overlap:
                return concatenate_clips([frame.observed for frame in frames]), truth
        raise InvalidSampleError(
            "overlap",
            f"{self.scenes.title}: no window of {self.views} views in {ATTEMPTS} trials of which "
            f"neighbours share {self.overlap:.0%} of their depth (best {best:.0%}); lower the "
            "overlap",
        )

    def _rows(self, rng: np.random.Generator, total: int, trial: int) -> list[int]:
        """Numbers of a window's views; later trials take smaller steps."""
        most = max(1, round(MOST_STRIDE * (1 - trial / ATTEMPTS)))
        step = int(rng.integers(1, most + 1))
        step = max(1, min(step, (total - 1) // (self.views - 1)))
        start = int(rng.integers(0, total - step * (self.views - 1)))
        rows = [start + step * i for i in range(self.views)]
        return rows[::-1] if rng.random() < 0.5 else rows

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        scenes = {"title": self.scenes.title, "digest": self.scenes.digest}
        own = {"scenes": scenes, "select": self.select, "overlap": self.overlap}
        return {"source": "recorded", **own, **super().describe()}


@lru_cache(KEPT_SCENES)
def _usable(data: SceneViews, number: int) -> tuple[View, ...]:
    """The views of a scene that samples are made of."""
    name = data.scenes.names[number]
    scene = data.scenes.read(name)
    chosen = [scene[view] for view in select(scene.names, data.select)]
    views = tuple(view for view in chosen if view.has_depth)
    if len(views) < data.views:
        raise TooFewViewsError(
            f"{scene.root}: {len(views)} of {len(scene)} views have depth and are among "
            f"{data.select!r}; samples need {data.views}; give a scene with recorded depth, or "
            "fewer views a sample"
        )
    return views


def overlaps(clip: Clip) -> list[float]:
    """Share of each view's known depth that the next view shows likewise; 0 without any."""
    return [float(covisibility(clip, i, [i + 1])[0]) for i in range(len(clip.rgb) - 1)]


def covisibility(clip: Clip, index: int, others: Sequence[int]) -> NDArray[np.float64]:
    """(len(others),) share of a view's known depth that each of others shows likewise."""
    height, width = clip.depth.shape[1:]
    rows = np.linspace(0, height - 1, PROBE).astype(int)[:, None]
    columns = np.linspace(0, width - 1, PROBE).astype(int)[None]
    depth = clip.depth[index][rows, columns]
    known = depth > 0
    if not known.any() or not len(others):
        return np.zeros(len(others))
    camera = clip.cameras[index]
    local = (camera.rays()[rows, columns] * depth[..., None])[known]
    world = camera.world_from_cam[0]
    points, z = clip.cameras[list(others)].project(local @ world[:3, :3].T + world[:3, 3])
    shares = np.empty(len(others))
    for place, other in enumerate(others):
        with np.errstate(invalid="ignore"):
            x, y = np.floor(points[place]).T
            inside = (z[place] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        there = clip.depth[other][y[inside].astype(int), x[inside].astype(int)]
        # Where the other view has no depth it cannot disagree.
        agree = (there == 0) | (np.abs(there / z[place][inside] - 1) < SAME_SURFACE)
        shares[place] = agree.sum() / known.sum()
    return shares


def reduced_view(view: View, size: tuple[int, int]) -> SampleView:
    """A view cropped about its centre to the aspect of ``size`` (H, W), and reduced.

    It is observed at ``DETAIL`` times that size, or less, if it is smaller. What its mask leaves
    out has no depth.
    """
    frame = view.load()
    window, camera = crop_to_aspect(view.camera, size[0] / size[1])
    depth = np.zeros(frame.rgb.shape[:2], np.float32) if frame.depth is None else frame.depth
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
    if frame.mask is not None:
        depth = np.where(frame.mask, depth, np.float32(0))
    rows, columns = int(camera.height[0]), int(camera.width[0])
    factor = max(1, min(DETAIL, rows // size[0], columns // size[1]))
    parts = [
        _resized(frame.rgb[window], depth[window], camera, size=(size[0] * times, size[1] * times))
        for times in (factor, 1)
    ]
    return SampleView(*parts)


_cached_view = lru_cache(KEPT_FRAMES)(reduced_view)


def _resized(
    rgb: NDArray[np.uint8], depth: NDArray[np.float32], camera: Cameras, *, size: tuple[int, int]
) -> Clip:
    """A clip of one view: filtered colours, and the depth of the pixel under each centre."""
    picture = torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1)[None].float()
    picture = resample(picture, size)[0].permute(1, 2, 0).round().clamp(0, 255)
    lengths = resample_nearest(depth, size).numpy()
    return Clip(picture.to(torch.uint8).numpy()[None], lengths, camera.resized(size[1], size[0]))


def concatenate_clips(clips: Sequence[Clip]) -> Clip:
    """Views of one size as one clip."""
    return Clip(
        np.concatenate([clip.rgb for clip in clips]),
        np.concatenate([clip.depth for clip in clips]),
        concatenate([clip.cameras for clip in clips]),
    )
