"""The one path by which pictures are measured, whoever made them.

Pictures, consistency and poses of a set of targets; the targets' true pictures are measured once in
the same way, however many sets of pictures of them there are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from gvtools.errors import DegenerateError
from gvtools.evaluation.view_figures import FIGURES
from pipelines.evaluation.consistency_figures import consistency_figures, with_surfaces
from pipelines.evaluation.picture_figures import picture_figures
from pipelines.evaluation.probed_poses import probed_figures

if TYPE_CHECKING:
    from gvtools.evaluation.lpips_distance import Lpips
    from gvtools.evaluation.pose_probe.probe import PoseProbe
    from gvtools.evaluation.posed_picture import PosedPicture
    from gvtools.features import FeatureMatcher
    from pipelines.console import Console
    from pipelines.evaluation.measured_target import MeasuredTarget

PARTS = ("images", "consistency", "poses")
# Context views that the probe locates by the others, to tell its own error.
CONTROLS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurement:
    """What is measured, how, and against which context and truth.

    Attributes:
        parts: of PARTS.
        context: gives the context views with the memory's depth; called when they are needed.
        truths: the true pictures of all targets.
        lpips: the network, or None.
        no_lpips: why there is none.
        matcher: of the pose probe; None is SIFT.
        control: measure the true pictures as well, to read the figures by.
        names: of the figures of pictures.
        seed: of resampling, matching and robust estimates.
        console: for progress.
    """

    parts: Sequence[str]
    context: Callable[[], list[PosedPicture]]
    truths: Sequence[PosedPicture]
    lpips: Lpips | None
    no_lpips: str | None
    matcher: FeatureMatcher | None = None
    control: bool = True
    names: Sequence[str] = FIGURES
    seed: int = 0
    console: Console

    def of(self, targets: Sequence[MeasuredTarget]) -> dict[str, Any]:
        """The figures by part, JSON-ready; what could not be measured is None.

        Reasons stand under ``notes`` and ``status``.

        Args:
            targets: with the pictures to measure.
        """
        out: dict[str, Any] = {}
        if "images" in self.parts:
            out["images"] = picture_figures(
                targets,
                self.lpips,
                self.no_lpips,
                names=self.names,
                seed=self.seed,
                console=self.console,
            )
        if "consistency" in self.parts:
            out["consistency"] = self._consistency(targets)
        if "poses" in self.parts:
            out["poses"] = self._poses([target.picture for target in targets])
        return out

    def _consistency(self, targets: Sequence[MeasuredTarget]) -> dict[str, Any]:
        generated = consistency_figures(
            [target.picture for target in targets],
            surfaces=with_surfaces(targets),
            seed=self.seed,
            label="consistency",
            console=self.console,
        )
        if not self.control or len(self.truths) < 2:
            return {"generated": generated}
        return {"generated": generated, "true_pictures": self._true_consistency}

    @cached_property
    def _true_consistency(self) -> dict[str, Any]:
        label = "consistency of the true pictures"
        return consistency_figures(self.truths, seed=self.seed, label=label, console=self.console)

    def _poses(self, pictures: Sequence[PosedPicture]) -> dict[str, Any]:
        probe = self._probe
        if isinstance(probe, str):
            return {"status": f"degenerate: {probe}", "success_share": None}
        found = [probe.locate(picture) for picture in self.console.track(pictures, "pose probe")]
        return {
            "status": "measured",
            "matcher": type(self.matcher).__name__ if self.matcher else "SiftMatcher",
            **probed_figures(found, pictures),
            **self._true_poses,
        }

    @cached_property
    def _probe(self) -> PoseProbe | str:
        """The probe, or why there is none."""
        from gvtools.evaluation.pose_probe.probe import PoseProbe

        try:
            return PoseProbe(self._context, matcher=self.matcher, seed=self.seed)
        except DegenerateError as error:
            return str(error)

    @cached_property
    def _context(self) -> list[PosedPicture]:
        return self.context()

    @cached_property
    def _true_poses(self) -> dict[str, Any]:
        """The same of the true pictures, and of context views that the others locate."""
        probe, out = self._probe, {}
        if isinstance(probe, str) or not self.control:
            return {}
        if self.truths:
            tracked = self.console.track(self.truths, "pose probe, true pictures")
            out["true_pictures"] = probed_figures([probe.locate(p) for p in tracked], self.truths)
        if len(self._context) > 2:
            out["context_left_out"] = probed_figures(probe.leave_one_out(CONTROLS), None)
        return out
