"""Which cameras a run completes: hold-outs, paths between or around cameras, files, projects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import OptionError
from gvtools.scenes.data_sets.address import is_address
from gvtools.scenes.reduced import reduced
from gvtools.scenes.scene import Scene, View
from gvtools.scenes.selection import check_disjoint, select
from gvtools.trajectories import PATHS, named_path

# Two pictures are one shot when their centres are this near (a share of the context's extent) and
# their rotations differ by no more than this many degrees, whatever their sizes and lenses.
SAME_PLACE = 1e-4
SAME_DIRECTION = 0.05
FORMS = (
    "a selection of the project's views, interpolate:N, orbit:N, spiral:N, a trajectory file "
    "(TUM or KITTI), or another project as PATH, spec:NAME:SCENE or either with @SELECTION"
)


@dataclass(frozen=True, eq=False)
class Targets:
    """The cameras to complete, in order.

    Attributes:
        cameras: V cameras.
        truth: per camera the view that shows the truth, None where there is none.
        kind: "hold-out", the path's name, "trajectory" or "project".
        files: what was read beside the project.
        project: what opens the other project that ``truth`` is of; None when it is the run's own.
    """

    cameras: Cameras
    truth: tuple[View | None, ...]
    kind: str
    files: tuple[Path, ...] = ()
    project: str | None = None


def resolve_targets(
    scene: Scene,
    context: tuple[str, ...],
    spec: str,
    *,
    allow_overlap: bool = False,
    max_side: int | None = None,
) -> Targets:
    """The target cameras that ``spec`` means.

    Args:
        scene: the project, already of the size that the run works in.
        context: names of the given views.
        spec: one of FORMS.
        allow_overlap: let views be context and target.
        max_side: another project's pictures are reduced to it, pixels.
    """
    context_cameras = scene.subset(context).cameras
    name, _, count = spec.partition(":")
    if name in PATHS and spec not in scene.names:
        if not count.isdecimal() or int(count) < 1:
            raise OptionError(f"targets {spec!r}; expected {name}:N with N >= 1")
        return _path(scene, context, name, count=int(count))
    path, at, selection = spec.partition("@")
    if path and (is_address(path) or _exists(path)) and spec not in scene.names:
        if is_address(path) or Path(path).is_dir() or Path(path).suffix == ".json":
            targets = _project(path, selection if at else "all", scene, max_side=max_side)
            if not allow_overlap:
                _check_pictures(scene, context, targets)
            return targets
        return _file(Path(path), context_cameras)
    try:
        # By name, as the context: what one target adds, the next ones are completed on.
        chosen = tuple(sorted(select(scene.names, spec)))
    except OptionError as error:
        raise OptionError(f"targets {spec!r}: {error}; or give {FORMS}") from None
    if not allow_overlap:
        check_disjoint(context, chosen)
    views = tuple(scene[name] for name in chosen)
    return Targets(scene.subset(chosen).cameras, views, "hold-out")


def _exists(text: str) -> bool:
    try:
        return Path(text).exists()
    except OSError:
        return False  # A long list of names is longer than any file's.


def _path(scene: Scene, context: tuple[str, ...], name: str, *, count: int) -> Targets:
    def depth() -> tuple[Cameras, float] | None:
        view = scene[context[len(context) // 2]]
        seen = view.load().depth if view.has_depth else None
        if seen is None or not (seen > 0).any():
            return None
        return view.camera, float(np.median(seen[seen > 0]))

    cameras = named_path(name, scene.subset(context).cameras, count=count, depth=depth)
    named = Cameras(
        cameras.K,
        cameras.cam_from_world,
        cameras.width,
        cameras.height,
        tuple(f"{name}_{i:04d}" for i in range(count)),
    )
    return Targets(named, (None,) * count, name)


def _file(path: Path, context_cameras: Cameras) -> Targets:
    from gvtools.trajectory_files import read_trajectory

    cameras = read_trajectory(path, context_cameras[0])
    return Targets(cameras, (None,) * len(cameras), "trajectory", (path,))


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
    chosen = tuple(sorted(select(other.names, selection)))
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
        if same or _at_one_place(view.camera, context_cameras, near).any():
            both.append(view.name)
    if both:
        raise OptionError(
            f"targets of another project overlap with the context in {len(both)} pictures (first "
            f"{both[0]!r}: same file, or same place and direction); expected none; change one, or "
            "pass --allow-overlap"
        )


def _at_one_place(camera: Cameras, context_cameras: Cameras, near: float) -> NDArray[np.bool_]:
    """Which of the context cameras stand where ``camera`` does and look where it looks."""
    apart = np.linalg.norm(context_cameras.centers - camera.centers[0], axis=1)
    rotations = context_cameras.cam_from_world[:, :3, :3] @ camera.cam_from_world[0, :3, :3].T
    cosine = (np.trace(rotations, axis1=1, axis2=2) - 1) / 2
    return (apart <= near) & (cosine >= np.cos(np.radians(SAME_DIRECTION)))
