"""Plan of a run before its first round: what is given, what is asked, and all that was derived."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvtools.cameras import Cameras, concatenate
from gvtools.completers.base import Completer
from gvtools.errors import OptionError
from gvtools.memory.panoramas import WIDEST_FRAME, LensOptions, Rig, picture_cameras
from gvtools.runs.digests import array_digest, fingerprint
from gvtools.runs.poses import RunPoses, posed, with_poses
from gvtools.scenes.depth_contradictions import depth_findings
from gvtools.scenes.inspection import camera_findings, reprojection_errors
from gvtools.scenes.layout import is_address
from gvtools.scenes.matching import natural
from gvtools.scenes.pixel_contradictions import probed
from gvtools.scenes.pose_forms import pose_findings
from gvtools.scenes.resized import reduced
from gvtools.scenes.scene import Scene, View
from gvtools.scenes.selection import (
    check_disjoint,
    is_view_or_folder,
    path_and_selection,
    path_exists,
    select,
)
from gvtools.scenes.transforms import read_camera_path
from gvtools.settings import changes
from gvtools.trajectories import PATHS, named_path
from gvtools.view_selection import evenly_spread
from pipelines.console import Console

if TYPE_CHECKING:
    from gvtools.depth.source import DepthSource
    from gvtools.memory.spatial_memory import FuseReport, SpatialMemory
    from gvtools.scans.points import Scan
    from gvtools.scans.registration import Placement
    from pipelines.reconstruction.settings import RunSettings

# Two pictures are one shot when their centres are this near (a share of the context's extent) and
# their rotations differ by no more than this many degrees, whatever their sizes and lenses.
SAME_PLACE, SAME_DIRECTION = 1e-4, 0.05
# Processor seconds: of a view's plane sweep whole and as a fit needs it, of a view with recorded
# depth, of a megapixel that is lifted, of a target; and what a run takes whatever it does [s].
SWEPT, SWEPT_SMALL, RECORDED, LIFTED, COMPLETED, START = 2.2, 0.7, 0.5, 1.0, 2.0, 4.0
# What --targets takes.
FORMS = (
    "a selection of the project's views, interpolate:N, orbit:N, spiral:N, a trajectory file "
    "(TUM or KITTI), a transforms.json such as 'gvtools view' saves, or another project as PATH or "
    "spec:NAME:SCENE, all with or without @SELECTION"
)


@dataclass(frozen=True, eq=False)
class Targets:
    """The cameras to complete, in order."""

    cameras: Cameras  # V cameras
    # Per camera the view that shows the truth, None where there is none.
    truth: tuple[View | None, ...]
    kind: str  # "hold-out", the path's name, "trajectory", "project", or another lens's name
    files: tuple[Path, ...] = ()  # what was read beside the project
    # What opens the other project that ``truth`` is of; None when it is the run's own.
    project: str | None = None
    # Of another lens: the cameras are the faces of its pictures, those of each together.
    rig: Rig | None = None

    def through(self, options: LensOptions, *, captured: Cameras) -> Targets:
        """The same of another lens: all faces of each picture, of which no view shows the truth."""
        rig = Rig.of(options, self.cameras, widest=WIDEST_FRAME)
        if rig is None:
            return self
        pictures = picture_cameras(self.cameras, options, captured=captured)
        cameras = concatenate(rig.faces_of(pictures))
        return Targets(cameras, (None,) * len(cameras), options.kind, self.files, rig=rig)


@dataclass(frozen=True, eq=False)
class PlacedScan:
    """A scan and where it lies."""

    scan: Scan
    placement: Placement

    def fuse_into(self, memory: SpatialMemory) -> tuple[FuseReport, dict[str, Any]]:
        """Fuse it into round 0; returns what became of it, and its entry in the round's report."""
        from gvtools.scans.fuse import fuse_scan

        report = fuse_scan(memory, self.scan, self.placement)
        scan = self.scan
        return report, {
            "file": scan.name,
            "points": scan.count,
            "fused": report.points,
            "stations": len(scan.stations),
            "colored_by": scan.colored_by,
            "dropped": dict(Counter(scan.dropped) + Counter(report.dropped)),
            "placement": self.placement.to_json(),
            "crs": scan.crs,
        }


@dataclass(frozen=True, eq=False)
class Plan:
    """A run before its first round."""

    scene: Scene  # the project
    settings: RunSettings  # as the user gave them
    config: RunSettings  # with everything derived in its place; see ``derived``
    context: tuple[str, ...]  # names of the context views
    targets: Targets  # the cameras to complete
    schedule: tuple[tuple[int, ...], ...]  # per round (from 1) the rows of the targets
    source: DepthSource  # where depth comes from
    source_reason: str  # why from there, in words
    completer: Completer  # of the whole run, under its effort policy
    ignored: tuple[str, ...] = ()  # settings of stereo that this source does not look at
    weights: tuple[Path, ...] = ()  # files of networks that decide the result
    # The scene as it enters the memory of a fit; None for ``scene``.
    evidence: Scene | None = None
    poses: RunPoses | None = None  # refined ones, which ``posed`` takes instead of the project's
    scan: PlacedScan | None = None  # that the memory starts from, placed

    @property
    def derived(self) -> dict[str, Any]:
        """What the run's settings leave open, by dotted key: voxel edge, rounds, device, ..."""
        return changes(self.settings, self.config)

    def at(self, poses: RunPoses) -> Plan:
        """The plan with other poses of its context and targets."""
        cameras, rig = posed(self.targets.cameras, poses.targets), self.targets.rig
        if rig is not None:
            # Each face was moved by itself.
            cameras = concatenate(rig.faces_of(rig.pictures(cameras)))
        targets = replace(self.targets, cameras=cameras)
        scene = with_poses(self.scene, self.context, poses.context)
        return replace(self, scene=scene, targets=targets)

    @property
    def posed(self) -> Plan:
        """The plan with refined poses."""
        return self if self.poses is None else self.at(self.poses)


def resolve_targets(
    scene: Scene,
    context: tuple[str, ...],
    spec: str,
    *,
    allow_overlap: bool = False,
    max_side: int | None = None,
) -> Targets:
    """The target cameras that ``spec`` means; another project's are reduced to ``max_side`` px."""
    name, _, count = spec.partition(":")
    if name in PATHS and spec not in scene.names:
        if not count.isdecimal() or int(count) < 1:
            raise OptionError(f"targets {spec!r}; expected {name}:N with N >= 1")
        return _path(scene, context, name, count=int(count))
    path, selection = path_and_selection(spec)
    there = path and (is_address(path) or path_exists(path))
    if there and not is_view_or_folder(scene.names, spec):
        captured = scene.subset(context).cameras
        cameras = read_camera_path(Path(path), captured, selection=selection)
        if cameras is not None:
            return Targets(cameras, (None,) * len(cameras), "trajectory", (Path(path),))
        targets = _project(path, selection, scene, max_side=max_side)
        if not allow_overlap:
            _check_pictures(scene, context, targets)
        return targets
    try:
        # By name, as the context: what one target adds, the next ones are completed on.
        chosen = natural(select(scene.names, spec))
    except OptionError as error:
        raise OptionError(f"targets {spec!r}: {error}; or give {FORMS}") from None
    if not allow_overlap:
        check_disjoint(context, chosen)
    views = tuple(scene[name] for name in chosen)
    return Targets(scene.subset(chosen).cameras, views, "hold-out")


def _path(scene: Scene, context: tuple[str, ...], name: str, *, count: int) -> Targets:
    def depth() -> tuple[Cameras, float] | None:
        view = scene[context[len(context) // 2]]
        seen = view.load().depth if view.has_depth else None
        if seen is None or not (seen > 0).any():
            return None
        return view.camera, float(np.median(seen[seen > 0]))

    cameras = named_path(name, scene.subset(context).cameras, count=count, depth=depth)
    names = tuple(f"{name}_{i:04d}" for i in range(count))
    return Targets(replace(cameras, names=names), (None,) * count, name)


def _project(path: str, selection: str, scene: Scene, *, max_side: int | None) -> Targets:
    """Views of another project; one of a data set lies in the same download as the run's own."""
    from gvtools.scenes.project import open_project

    if not is_address(path):
        other, address = open_project(path), str(Path(path).resolve())
    elif scene.origin is None:
        raise OptionError(
            f"targets {path}: the run's project is none of a data set, so that no --root says "
            "where this one lies; give the folder of the scene instead"
        )
    else:
        other = open_project(path, root=scene.origin.root)
        address = other.address
    other = reduced(other, max_side)
    chosen = natural(select(other.names, selection))
    views = tuple(other[name] for name in chosen)
    files = tuple(file for view in views for file in view.files)
    return Targets(other.subset(chosen).cameras, views, "project", files, address)


def _check_pictures(scene: Scene, context: tuple[str, ...], targets: Targets) -> None:
    """Refuse another project's views that are the context's: same file, or same place."""
    given = [scene[name] for name in context]
    files = {view.files[0].resolve() for view in given if view.files}
    context_cameras = scene.subset(context).cameras
    near = SAME_PLACE * max(float(np.ptp(context_cameras.centers, axis=0).max()), 1e-9)
    both = []
    for view in targets.truth:
        if view is None:
            continue
        same = bool(view.files) and view.files[0].resolve() in files
        apart = np.linalg.norm(context_cameras.centers - view.camera.centers[0], axis=1)
        turned = context_cameras.cam_from_world[:, :3, :3] @ view.camera.cam_from_world[0, :3, :3].T
        cosine = (np.trace(turned, axis1=1, axis2=2) - 1) / 2
        alike = (apart <= near) & (cosine >= np.cos(np.radians(SAME_DIRECTION)))
        if same or alike.any():
            both.append(view.name)
    if both:
        raise OptionError(
            f"targets of another project overlap with the context in {len(both)} pictures (first "
            f"{both[0]!r}: same file, or same place and direction); expected none; change one, or "
            "pass --allow-overlap"
        )


def make_schedule(
    targets: int, views_per_round: int, rounds: int | None, *, faces: int = 1
) -> tuple[tuple[int, ...], ...]:
    """Rows of the targets for each round, in order; always so many ``faces`` together.

    Without ``rounds``, as many as it takes. With more rounds than full rounds need, the targets
    are spread evenly over them; what does not fit into them stays out, and is reported.
    """
    if faces > 1:
        whole = make_schedule(targets // faces, max(1, views_per_round // faces), rounds)
        return tuple(
            tuple(row * faces + face for row in rows for face in range(faces)) for rows in whole
        )
    if rounds is None:
        rounds = -(-targets // views_per_round)
    rounds = min(rounds, targets)
    if not rounds:
        return ()
    used = min(targets, rounds * views_per_round)
    cuts = [i * used // rounds for i in range(rounds + 1)]
    return tuple(tuple(range(a, b)) for a, b in pairwise(cuts))


def run_identity(plan: Plan, reading: Mapping[str, Any]) -> dict[str, Any]:
    """What decides a run's result, JSON-ready; a resumed run must have the same."""
    scene, targets = plan.scene, plan.targets
    files = [file for name in plan.context for file in scene[name].files]
    files += [file for view in targets.truth if view for file in view.files]
    cameras = (scene.subset(plan.context).cameras, targets.cameras)
    points = scene.points
    init = [] if plan.config.refine.init is None else [Path(plan.config.refine.init)]
    return {
        "project": scene.address,
        "reading": dict(reading),
        "fingerprint": fingerprint([*files, *targets.files, *plan.config.scan.files(), *init]),
        "cameras": array_digest(
            array for c in cameras for array in (c.K, c.cam_from_world, c.width, c.height)
        ),
        # Depth is sought and checked by the sparse points and their tracks.
        "points": None
        if points is None
        else array_digest((points.positions, points.point_index, points.view_index, points.xy)),
        # As they are read: units, registration and masks show in them.
        "pixels": array_digest(
            pixels
            for frame in (scene[name].load() for name in evenly_spread(plan.context))
            for pixels in (frame.rgb, frame.depth, frame.mask)
        ),
        "weights": fingerprint(plan.weights),
        "settings": plan.settings.to_dict(),
        "derived": plan.derived,
        "context": list(plan.context),
        "targets": list(targets.cameras.names),
        "targets_kind": targets.kind,
        "targets_project": targets.project,
        "schedule": [list(rows) for rows in plan.schedule],
    }


def expected_seconds(plan: Plan) -> float:
    """About how long a run takes, to a factor of two, without a network's time."""
    from numba import get_num_threads

    from gvtools.depth.source import is_recorded

    config = plan.config
    sizes = plan.scene.subset(plan.context).cameras
    megapixels = float((sizes.width * sizes.height).sum()) / 1e6
    recorded = sum(is_recorded(plan.source, plan.scene[name]) for name in plan.context)
    swept = len(plan.context) - recorded if "plane-sweep" in plan.source.name else 0
    # A fit that is not used was swept for at a small size before.
    fit = config.refine.wanted and config.depth == "auto" and not recorded
    each = SWEPT + SWEPT_SMALL if fit else SWEPT
    work = each * swept + RECORDED * (len(plan.context) - swept) + LIFTED * megapixels
    work += COMPLETED * sum(len(rows) for rows in plan.schedule)
    limit = config.refine.limit if config.refine.wanted else 0.0
    return (
        START
        + work / get_num_threads()
        + (0.05 * (config.refine.steps or 0) if limit is None else limit)
    )


def describe(plan: Plan, console: Console) -> None:
    """Say what the run reads and will do."""
    config, targets = plan.config, plan.targets
    sizes = sorted(set(zip(targets.cameras.width.tolist(), targets.cameras.height.tolist(),
                           strict=True)))  # fmt: skip
    scheduled = sum(len(rows) for rows in plan.schedule)
    console.line(
        f"{plan.scene.root} ({plan.scene.kind}): {len(plan.scene)} views; context "
        f"{len(plan.context)}, targets {len(targets.cameras)} ({targets.kind}, "
        f"{', '.join(f'{w}x{h}' for w, h in sizes)})"
    )
    tuning = f" (tuned for {config.tune.length})" if config.tune.wanted else ""
    console.line(
        f"depth {plan.source.name} ({plan.source_reason}), voxel {config.voxel:g}, completer "
        f"{config.completer}{tuning}, "
        f"{len(plan.schedule)} rounds of at most {config.views_per_round} targets, seed "
        f"{config.seed}"
    )
    seconds = expected_seconds(plan)
    rough = f"{seconds / 60:.0f} min" if seconds >= 100 else f"{max(round(seconds, -1), 10):.0f} s"
    console.line(f"it takes at most about {rough}")
    if scheduled < len(targets.cameras):
        console.warn(
            f"{len(targets.cameras) - scheduled} of {len(targets.cameras)} targets are in no "
            "round; raise --rounds or --views-per-round"
        )
    for note in plan.completer.notes:
        console.warn(note)
    if plan.ignored:
        console.warn(
            f"{', '.join(plan.ignored)} changes nothing: no plane sweep computes depth here, but "
            f"{plan.source.name}"
        )
    scene, context = plan.scene, plan.context
    met = (
        *camera_findings(scene, reprojection_errors(scene)),
        *probed(scene, context),
        *pose_findings(scene, context, most_pairs=2),
        *depth_findings(scene),
    )
    for finding in (*scene.findings, *met):
        if finding.level == "warning":
            console.warn(finding.message)


def scan_line(entry: Mapping[str, Any]) -> str:
    """What a report says of a run's scan, for the user."""
    placed = entry["placement"]
    text = (
        f"{entry['file']}: {entry['fused']:,} of {entry['points']:,} points scanned from "
        f"{entry['stations']} station(s), placement {placed['how']}, scale {placed['scale']:.6g}"
    )
    return text if placed["fitness"] is None else f"{text}, fitness {placed['fitness']:.2f}"
