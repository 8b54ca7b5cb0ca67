"""Choice of a depth source: the best that the scene and the machine allow, and why."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.depth.options import FoundationOptions, StereoOptions
from gvtools.depth.source import DepthMap, DepthSource, MixedDepth, RecordedDepth
from gvtools.errors import DegenerateError, OptionError, ProjectError
from gvtools.scenes.colmap import depth_map_path
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.images import read_depth
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.settings import changes

CHOICES = ("auto", "sensor", "colmap", "plane-sweep", "da3", "sensor-or-da3")
# Of a rough estimate: longer side of the pictures that are compared, pixels, and their levels.
# The voxel edge from eight views is then within 10 % of that from sparse points or from full depth,
# measured on four scenes.
ROUGH_SIDE, ROUGH_LEVELS = 160, 2


@dataclass(frozen=True, eq=False)
class ChosenSource:
    """A source and why it was taken."""

    source: DepthSource  # gives the depth
    reason: str  # in words, for the user
    # Options of the plane sweep, ``stereo.NAME=VALUE``, that were given and that the source does
    # not look at.
    ignored: tuple[str, ...] = ()


def choose_source(
    scene: Scene,
    views: Sequence[str],
    choice: str,
    *,
    stereo: StereoOptions | None = None,
    foundation: FoundationOptions | None = None,
) -> ChosenSource:
    """The source for the views that a run lifts.

    "auto" takes recorded depth where there is some and computes the rest: by Depth Anything 3 where
    its weights are given, by COLMAP's PatchMatch where pycolmap has CUDA, otherwise by plane-sweep
    stereo. Of CHOICES, ``sensor`` wants RGB-D, ``colmap`` COLMAP's stereo maps, on disk or computed
    now, ``plane-sweep`` photographs alone, ``da3`` a foundation model's weights;
    ``sensor-or-da3`` is "auto" whose depth no fit replaces. Nothing but ``views`` is looked at.
    """
    chosen = _chosen(
        scene, views, choice, stereo=stereo, foundation=foundation or FoundationOptions()
    )
    given = {} if stereo is None else changes(StereoOptions(), stereo)
    if not given:
        return chosen
    from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo

    source = chosen.source.computed if isinstance(chosen.source, MixedDepth) else chosen.source
    if isinstance(source, PlaneSweepStereo):
        return chosen
    return replace(chosen, ignored=tuple(f"stereo.{name}={value}" for name, value in given.items()))


def rough_source(scene: Scene, source: DepthSource) -> DepthSource:
    """A cheap source of depth for what needs no more than typical distances.

    Where the run's own takes its time, it is a plane sweep of small pictures with the poses as they
    are.
    """
    if isinstance(source, MixedDepth):
        return rough_source(scene, source.computed)
    from gvtools.depth.foundation import FoundationDepth
    from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo

    if not isinstance(source, (PlaneSweepStereo, ColmapPatchMatch, FoundationDepth)):
        return source
    if len(source.views) < 2:
        return source
    options = source.options if isinstance(source, PlaneSweepStereo) else StereoOptions()
    side, levels = min(options.max_side, ROUGH_SIDE), min(options.levels, ROUGH_LEVELS)
    options = options.replaced(max_side=side, levels=levels, align=False)
    return PlaneSweepStereo(scene, options=options, views=source.views)


def is_estimated(source: DepthSource, view: View) -> bool:
    """Whether a network that has learnt depth gives that of ``view``."""
    from gvtools.depth.foundation import FoundationDepth

    if isinstance(source, MixedDepth):
        return not source.recorded.covers(view) and is_estimated(source.computed, view)
    return isinstance(source, FoundationDepth) and source.covers(view)


def _chosen(
    scene: Scene,
    views: Sequence[str],
    choice: str,
    *,
    stereo: StereoOptions | None,
    foundation: FoundationOptions,
) -> ChosenSource:
    if choice not in CHOICES:
        raise OptionError(f"depth {choice!r}; expected one of {', '.join(CHOICES)}")
    recorded = sum(scene[name].has_depth for name in views)
    if choice == "da3":
        source = _foundation(scene, views, foundation)
        return ChosenSource(source, f"asked for; weights of {foundation.weights}")
    if choice in ("sensor", "colmap"):
        if (choice == "colmap") != (scene.kind == "colmap"):
            raise OptionError(f"depth {choice!r}: {scene.root} is a {scene.kind} project; use auto")
        if recorded:
            what = "stereo maps" if choice == "colmap" else "it"
            reason = f"asked for; {recorded} of {len(views)} views have {what}"
            return ChosenSource(RecordedDepth(views), reason)
        if choice == "colmap" and has_patch_match():
            return ChosenSource(ColmapPatchMatch(scene, views), "asked for; computed now with CUDA")
        advice = "add depth maps, or use auto"
        if choice == "colmap":
            advice = (
                "pycolmap has no CUDA here; run COLMAP's patch_match_stereo on an undistorted "
                "workspace (stereo/depth_maps is then read), or use plane-sweep"
            )
        raise ProjectError(
            f"{scene.root}: none of the {len(views)} context views has depth; {advice}"
        )
    if choice == "plane-sweep":
        return ChosenSource(_stereo(scene, views, stereo), "asked for")
    if recorded == len(views):
        return ChosenSource(RecordedDepth(views), "every context view has recorded depth")
    if foundation.weights is not None:
        source = _foundation(scene, views, foundation)
        how = f"Depth Anything 3, as weights are given: {foundation.weights}"
    elif has_patch_match() and scene.points is not None and len(views) > 1:
        source, how = ColmapPatchMatch(scene, views), "COLMAP's PatchMatch, as there is CUDA"
    else:
        source = _stereo(scene, views, stereo)
        how = "plane-sweep stereo of the photographs"
    if choice == "sensor-or-da3" and foundation.weights is None:
        how += ", as no weights of a foundation model are given (da3.weights)"
    if not recorded:
        return ChosenSource(source, f"no context view has recorded depth; {how}")
    return ChosenSource(
        MixedDepth(RecordedDepth(views), source),
        f"{recorded} of {len(views)} views have recorded depth; the others {how}",
    )


def _stereo(scene: Scene, views: Sequence[str], options: StereoOptions | None) -> DepthSource:
    if len(views) < 2:
        raise ProjectError(
            f"{scene.root}: {len(views)} context view(s) without depth; expected depth, or at "
            "least 2 views to compute it from"
        )
    from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo

    return PlaneSweepStereo(scene, options=options or StereoOptions(), views=tuple(views))


def _foundation(scene: Scene, views: Sequence[str], options: FoundationOptions) -> DepthSource:
    from gvtools.depth.foundation import FoundationDepth

    return FoundationDepth(scene, views=views, options=options)


# Source pictures of each, chosen by COLMAP from co-visibility.
SOURCES = 20


def has_patch_match() -> bool:
    """Whether this pycolmap can run PatchMatch."""
    from gvtools.colmap import pycolmap

    return bool(pycolmap.has_cuda)


class ColmapPatchMatch:
    """COLMAP's PatchMatch stereo, where pycolmap was built with CUDA.

    J. L. Schönberger et al., "Pixelwise view selection for unstructured multi-view stereo", ECCV
    2016. The views' pictures, already undistorted, go to a temporary dense workspace; depth is
    computed together when the first is asked for.
    """

    name = "colmap-patch-match"

    def __init__(self, scene: Scene, views: Sequence[str]) -> None:
        if scene.points is None:
            raise ProjectError(
                f"{scene.root}: COLMAP's PatchMatch needs sparse points, and there are none; "
                "triangulate, or use plane-sweep"
            )
        self._scene, self.views = scene, tuple(views)
        self._depth: dict[str, NDArray[np.float32]] | None = None

    def covers(self, view: View) -> bool:
        """The given views."""
        return view.name in self.views

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The view's geometric depth map, trusted as recorded ones are."""
        if self._depth is None:
            with tempfile.TemporaryDirectory() as folder:
                self._depth = self._run(Path(folder))
        if view.name not in self._depth:
            raise DegenerateError(f"{scene.root}: PatchMatch gave no depth of view {view.name}")
        found = Frame(frame.rgb, self._depth[view.name], frame.mask)
        trusted = RecordedDepth().depth(scene, view, found)
        return DepthMap(trusted.depth, trusted.confidence, self.name)

    def _run(self, folder: Path) -> dict[str, NDArray[np.float32]]:
        from PIL import Image

        from gvtools.colmap import pycolmap

        self._write_workspace(folder)
        for name in self.views:
            path = folder / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            # Without loss, whatever the suffix says.
            Image.fromarray(self._scene[name].load().rgb).save(path, format="PNG")
        try:
            pycolmap.patch_match_stereo(folder)
        except (RuntimeError, ValueError) as error:
            raise ProjectError(
                f"{self._scene.root}: COLMAP's PatchMatch failed ({error}); use plane-sweep"
            ) from None
        maps = folder / "stereo" / "depth_maps"
        found = {name: depth_map_path(maps, name) for name in self.views}
        return {name: read_depth(path) for name, path in found.items() if path is not None}

    def _write_workspace(self, folder: Path) -> None:
        """Sparse model and configuration of a dense workspace with the views alone."""
        scene, views, points = self._scene, self.views, self._scene.points
        assert points is not None
        kept = np.full(len(scene), -1)
        kept[[scene.names.index(name) for name in views]] = np.arange(len(views))
        inside = kept[points.view_index] >= 0
        point, first = np.unique(points.point_index[inside], return_inverse=True)
        write_colmap(
            folder / "sparse", scene.subset(views).cameras, points=points.positions[point],
            colors=points.colors[point], point_index=first,
            view_index=kept[points.view_index[inside]], xy=points.xy[inside],
        )  # fmt: skip
        stereo = folder / "stereo"
        for name in ("depth_maps", "normal_maps", "consistency_graphs"):
            (stereo / name).mkdir(parents=True, exist_ok=True)
        lines = [line for name in views for line in (name, f"__auto__, {SOURCES}")]
        (stereo / "patch-match.cfg").write_text("\n".join(lines) + "\n", encoding="utf-8")
