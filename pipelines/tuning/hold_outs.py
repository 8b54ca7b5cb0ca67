"""Context views that predict each other: what a model is tuned to a scene by, and judged by."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from gvtools.completers.base import ContextView
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.views import model_size
from gvtools.errors import ProjectError
from gvtools.guidance import Guidance
from gvtools.scenes.scene import Scene
from gvtools.training.corruption import GENTLE, draw_strengths
from gvtools.training.samples import (
    Clip,
    Observation,
    TrainingSample,
    make_sample,
    project_observation,
)
from gvtools.training.views import (
    FAULTS,
    PATH,
    ContextChoice,
    SampleView,
    concatenate_clips,
    covisibility,
    reduced_view,
)
from gvtools.view_selection import evenly_spread
from pipelines.tuning.options import FEWEST_VIEWS

# Beside PATH and FAULTS, the stream that a sample's further views are drawn from.
LIFTED = 10
# Of more views, so many are taken.
MOST = 64
# One view in so many judges, at most MOST_JUDGES of them.
JUDGE_SHARE, MOST_JUDGES = 5, 12
# Views that the memory of a sample is made of, beside those that the model is shown.
MOST_LIFTED = 12
# Least share of a judging view that is to be generated.
LEAST_HOLES = 0.01
# Least share of a view's depth that another has to show to predict it.
LEAST_SHOWN = 0.15


@dataclass(frozen=True, eq=False)
class HeldOutView:
    """A view that judges, and what it is predicted from."""

    # views that do not judge, all or some; a completer is given them
    context: tuple[ContextView, ...]
    guidance: Guidance  # the memory of them, projected into the view
    rgb: np.ndarray  # (1, H, W, 3) its photograph in [0, 1]


@dataclass(frozen=True, kw_only=True, eq=False)
class HoldOuts:
    """Samples in which one view is held out and predicted from others that see the same."""

    views: tuple[SampleView, ...]  # reduced, of one size
    targets: tuple[int, ...]  # which of them are held out
    given: tuple[int, ...]  # which of them may be given; a target is never given to itself
    context: ContextChoice  # how many are given
    seed: int = 0  # 0 or more
    fill: str = "none"  # of the model's configuration, ``hints.fill``
    _partners: dict[int, tuple[int, ...]] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        clip = concatenate_clips([view.truth for view in self.views])
        for target in self.targets:
            others = [index for index in self.given if index != target]
            shares = covisibility(clip, target, others)
            chosen = [n for n, share in zip(others, shares, strict=True) if share >= LEAST_SHOWN]
            if chosen:
                self._partners[target] = tuple(chosen)

    @property
    def usable(self) -> tuple[int, ...]:
        """The targets that some given view shows in part."""
        return tuple(self._partners)

    def sample(self, index: int) -> TrainingSample:
        """The sample of a number, 0 or more; the target is its last view."""
        chosen, lifted = self.chosen(index), self.lifted(index)
        rng = np.random.default_rng([self.seed, index, FAULTS])
        frames = [self.views[number] for number in chosen]
        more = (
            concatenate_clips([self.views[number].observed for number in lifted])
            if lifted
            else None
        )
        return make_sample(
            concatenate_clips([frame.observed for frame in frames]),
            concatenate_clips([frame.truth for frame in frames]),
            tuple(range(len(chosen) - 1)),
            rng=rng,
            strength=draw_strengths(rng, GENTLE),
            fill=self.fill,
            more=more,
        )

    def prediction(self, target: int) -> HeldOutView:
        """One target as a run is asked for it: with the memory of all given views.

        Where that leaves less than ``LEAST_HOLES`` to generate, of every second of them, every
        fourth, and so on.
        """
        truth = self.views[target].observed
        given = [number for number in self.given if number != target]
        while True:
            context = tuple(_context_view(self.views[number].observed) for number in given)
            observation = Observation(context, tuple(view.camera for view in context))
            guidance = project_observation(observation, truth.cameras)
            if len(given) == 1 or (~guidance.valid).mean() >= LEAST_HOLES:
                break
            given = given[::2]
        return HeldOutView(context, guidance, (truth.rgb / np.float32(255)).astype(np.float32))

    def chosen(self, index: int) -> tuple[int, ...]:
        """The views of a sample: those that are given, ascending, then the target."""
        rng = np.random.default_rng([self.seed, index, PATH])
        # In turn, so that no view is left out of few predictions.
        target = self.usable[index % len(self.usable)]
        partners = self._partners[target]
        count = self.context.count([self.seed], index)
        first = int(rng.choice(partners))
        # Samples of a batch have as many views each, so that others fill up where partners are few.
        others = [n for n in partners if n != first]
        others = [int(n) for n in rng.permutation(others)]
        rest = [n for n in self.given if n not in (target, *partners)]
        others += [int(n) for n in rng.permutation(rest)]
        return (*sorted([first, *others[: count - 1]]), target)

    def lifted(self, index: int) -> tuple[int, ...]:
        """Further views that a sample's memory is made of: none, a few, or all that see the target.

        Memory of few views has large holes, as at a scene's edge, memory of many has small ones.
        """
        *given, target = self.chosen(index)
        rng = np.random.default_rng([self.seed, index, LIFTED])
        others = [n for n in self._partners[target] if n not in given]
        most = min(MOST_LIFTED, len(others))
        count = int((most + 1) ** rng.random()) - 1
        return tuple(sorted(int(n) for n in rng.permutation(others)[:count]))

    def describe(self) -> dict[str, Any]:
        """Everything that decides the samples, as plain data."""
        names = [view.truth.cameras.names[0] for view in self.views]
        return {
            "source": "hold-outs",
            "views": names,
            "targets": [names[n] for n in self.targets],
            "given": [names[n] for n in self.given],
            "context": asdict(self.context),
            "seed": self.seed,
            "fill": self.fill,
        }


@dataclass(frozen=True, eq=False)
class SplitContext:
    """A scene's context, split into views to learn from and views that judge."""

    views: tuple[SampleView, ...]  # all of them, reduced to the model's size
    learnt: HoldOuts  # samples that the model learns from
    judged: HoldOuts  # predictions of the judging views from the others
    dropped: int  # context views without depth, and those beyond ``MOST``

    @property
    def judges(self) -> list[str]:
        """Names of the judging views."""
        return [self.views[n].truth.cameras.names[0] for n in self.judged.usable]

    def predictions(self) -> list[HeldOutView]:
        """What the judging views are predicted from."""
        return [self.judged.prediction(target) for target in self.judged.usable]


def split_context(scene: Scene, config: GeoVerseConfig, *, seed: int = 0) -> SplitContext:
    """Read a scene's views, and keep some of them as judges."""
    usable = [view for view in scene if view.has_depth]
    chosen = list(evenly_spread(usable, MOST))
    views: tuple[SampleView, ...] = ()
    if chosen:
        height, width = int(chosen[0].camera.height[0]), int(chosen[0].camera.width[0])
        size = model_size(height, width, longest=config.image_size, patch=config.patch)
        found = [reduced_view(view, size) for view in chosen]
        views = tuple(view for view in found if (view.truth.depth > 0).any())
    if len(views) < FEWEST_VIEWS:
        raise ProjectError(
            f"{scene.root}: {len(views)} of {len(scene)} context views have depth; expected "
            f"at least {FEWEST_VIEWS} to tune a model by, of which one judges; give more "
            "--context, or leave tuning out"
        )
    views = _of_one_size(views)
    numbers = range(len(views))
    count = min(MOST_JUDGES, max(1, len(views) // JUDGE_SHARE))
    # Not the ends of a path, which hardly anything else shows.
    judges = tuple(int((k + 0.5) * len(views) / count) for k in range(count))
    given = tuple(n for n in numbers if n not in judges)
    learnt, judged = (
        HoldOuts(
            views=views,
            targets=targets,
            given=given,
            context=ContextChoice(most=min(config.context, config.views - 1, len(given) - 1)),
            seed=seed,
            fill=config.hints.fill,
        )
        for targets in (given, judges)
    )
    if not (learnt.usable and judged.usable):
        raise ProjectError(
            f"{scene.root}: no two of {len(views)} context views share {LEAST_SHOWN:.0%} of their "
            "depth; expected views that see the same; give more --context, or leave tuning out"
        )
    return SplitContext(views, learnt, judged, len(scene) - len(views))


def _of_one_size(views: tuple[SampleView, ...]) -> tuple[SampleView, ...]:
    """Small pictures are observed at less than ``DETAIL`` times the size; all then are."""
    sizes = {view.observed.depth.shape for view in views}
    if len(sizes) == 1:
        return views
    return tuple(SampleView(view.truth, view.truth) for view in views)


def _context_view(clip: Clip) -> ContextView:
    picture = (clip.rgb[0] / np.float32(255)).astype(np.float32)
    return ContextView(clip.cameras.names[0], clip.cameras, picture, clip.depth[0])
