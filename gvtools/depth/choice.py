"""Choice of a depth source: the best that the scene and the machine allow, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gvtools.depth.colmap_patch_match import ColmapPatchMatch, has_patch_match
from gvtools.depth.options import FoundationOptions, StereoOptions
from gvtools.depth.source import DepthSource, MixedDepth, RecordedDepth
from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.scene import Scene, View
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
    now, ``plane-sweep`` photographs alone, ``da3`` a foundation model's weights, ``sensor-or-da3``
    these for what has no recorded depth, and without weights what "auto" takes. Nothing but
    ``views`` is looked at.
    """
    chosen = _chosen(
        scene, views, choice, stereo=stereo, foundation=foundation or FoundationOptions()
    )
    return replace(chosen, ignored=_ignored(chosen.source, stereo))


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
        return _asked_recorded(scene, views, choice, recorded=recorded)
    if choice == "plane-sweep":
        return ChosenSource(_stereo(scene, views, stereo), "asked for")
    if recorded == len(views):
        return ChosenSource(RecordedDepth(views), "every context view has recorded depth")
    if recorded and len(views) < 2 and foundation.weights is None:
        return ChosenSource(RecordedDepth(), "a single view leaves nothing to compute from")
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


def _asked_recorded(
    scene: Scene, views: Sequence[str], choice: str, *, recorded: int
) -> ChosenSource:
    """Depth of a sensor or of COLMAP, which a project of the other kind does not have."""
    if (choice == "colmap") != (scene.kind == "colmap"):
        raise OptionError(f"depth {choice!r}: {scene.root} is a {scene.kind} project; use auto")
    what = "stereo maps" if choice == "colmap" else "it"
    if recorded:
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
    raise ProjectError(f"{scene.root}: none of the {len(views)} context views has depth; {advice}")


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


def _ignored(source: DepthSource, options: StereoOptions | None) -> tuple[str, ...]:
    """The options that differ from their defaults, where no plane sweep takes them."""
    if options is None or options == StereoOptions():
        return ()
    from gvtools.depth.stereo.plane_sweep import PlaneSweepStereo

    computing = source.computed if isinstance(source, MixedDepth) else source
    if isinstance(computing, PlaneSweepStereo):
        return ()
    given = changes(StereoOptions(), options)
    return tuple(f"stereo.{name}={value}" for name, value in given.items())
