"""The cameras of a memory, with points or without, for COLMAP's and nerfstudio's readers.

Pictures stay where they are; beside a ``transforms.json`` those from elsewhere get a link or a copy
in ``images``. Views that a completer made are named ``generated/NAME``, and stand in
``generated.txt`` beside a model's files, one a line and, where a run has it, the path of the
picture; in a
``transforms.json`` their frames have the key ``generated``. By the list, or by the key
``exported_by``, an export is known, so that nothing else is ever written over.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.files import link_or_copy, write_text
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.thinning import thinned
from gvtools.runs.target_files import completed_picture
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.transforms_json import FILE as TRANSFORMS
from gvtools.scenes.transforms_json import write_transforms, written_here

GENERATED = "generated.txt"
HEADER = "# views that a completer made: name, and its picture where the run kept it"
MODEL = "sparse/0"


@dataclass(frozen=True)
class Written:
    """What an export holds.

    Attributes:
        views: cameras.
        generated: how many of them a completer made.
        points: 3D points.
        elements: track elements: which view saw which point, and where.
        edge: voxel edge that the points were thinned to, scene units; 0 without points.
    """

    views: int
    generated: int
    points: int = 0
    elements: int = 0
    edge: float = 0.0


@dataclass(frozen=True, eq=False)
class DistinctCameras:
    """Each camera of a memory once, under a name of its own.

    Attributes:
        cameras: V cameras.
        row_of_view: (views of the memory,) int64, which of the cameras each view has; -1 for a
            scan's station, which has none.
        generated: names of those that a completer alone saw through, in order, with the pictures
            that the run kept.
    """

    cameras: Cameras
    row_of_view: NDArray[np.int64]
    generated: dict[str, Path | None]


def write_colmap_export(
    memory: SpatialMemory, folder: Path, *, max_points: int | None, run: Path
) -> Written:
    """A workspace with a binary model in ``sparse/0``; pictures belong into its ``images``.

    Each point is the most confident observation of its voxel. Its track are the other observations
    there, one a view, at the pixels where their views have them, so that reprojection errors are
    real.

    Args:
        memory: with at least one observation.
        folder: the workspace.
        max_points: thin to at most so many.
        run: where the memory came from, for the paths of generated pictures.
    """
    distinct = distinct_cameras(memory, run)
    kept = thinned(memory, max_points)
    point, view, xy = _tracks(
        memory, distinct.cameras, kept.group, row_of_view=distinct.row_of_view
    )
    lines = [
        name if picture is None else f"{name}\t{picture}"
        for name, picture in distinct.generated.items()
    ]
    # First, so that an export that was killed is known for one when it is made again.
    write_text(folder / MODEL / GENERATED, "\n".join([HEADER, *lines]) + "\n")
    write_colmap(
        folder / MODEL,
        distinct.cameras,
        points=memory.positions[kept.rows],
        colors=memory.columns.colors[kept.rows],
        point_index=point,
        view_index=view,
        xy=xy,
    )
    return Written(
        views=len(distinct.cameras),
        generated=len(distinct.generated),
        points=len(kept.rows),
        elements=len(point),
        edge=kept.edge,
    )


def write_transforms_export(
    memory: SpatialMemory, path: Path, *, images: str, run: Path
) -> Written:
    """The cameras as ``transforms.json``.

    Args:
        memory: with at least one view.
        path: the file, or the folder for it.
        images: folder of the observed views' pictures, absolute or relative to the file.
        run: where the memory came from; pictures of generated views are those of its rounds.
    """
    file = transforms_file(path)
    distinct = distinct_cameras(memory, run)
    home = file.parent.resolve()
    paths, elsewhere = [], {}
    for name in distinct.cameras.names:
        made = distinct.generated.get(name)
        picture = (home / images / name if made is None else made).resolve()
        inside = picture.is_relative_to(home)
        place = picture.relative_to(home) if inside else Path("images") / name
        paths.append(place)
        if not inside and picture.is_file():
            elsewhere[home / place] = picture
    write_transforms(file, distinct.cameras, image_paths=paths, generated=distinct.generated.keys())
    # Readers look nowhere else: pictures from elsewhere get a second name, by a link or a copy.
    for place, picture in elsewhere.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        place.unlink(missing_ok=True)
        link_or_copy(picture, place)
    return Written(len(distinct.cameras), len(distinct.generated))


def transforms_file(path: Path) -> Path:
    """The file that an export to ``path``, a folder or a ``.json`` file, writes."""
    return path if path.suffix.lower() == ".json" else path / TRANSFORMS


def foreign_model(folder: Path) -> Path | None:
    """What a model written to ``folder`` would replace or hide and no export wrote, if anything."""
    try:
        with (folder / MODEL / GENERATED).open(encoding="utf-8") as file:
            if file.readline().rstrip() == HEADER:
                return None
    except (OSError, ValueError):
        pass
    places = [folder / name for name in ("sparse", "cameras.bin", "cameras.txt")]
    return next((path for path in places if path.is_file() or _holds_files(path)), None)


def _holds_files(folder: Path) -> bool:
    """Whether there are files below a folder, but for those that a kill left half-written."""
    return any(
        path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
        for path in folder.rglob("*")
    )


def foreign_transforms(path: Path) -> Path | None:
    """What a ``transforms.json`` written to ``path`` would replace and no export wrote, if any."""
    file = transforms_file(path)
    return file if file.is_file() and not written_here(file) else None


def distinct_cameras(memory: SpatialMemory, run: Path) -> DistinctCameras:
    """Each camera once, as formats of other tools need it, each with a unique name.

    A view may be fused twice. Observed cameras keep their names; generated ones are named
    ``generated/NAME``, or ``generated_2/NAME`` and so on where another has that in any case.

    Args:
        memory: with at least one view.
        run: where the memory came from, for the paths of generated pictures.
    """
    cameras, made = memory.views.cameras, memory.views.generated
    taken = np.flatnonzero(~memory.views.scanned)
    if cameras is None or not len(taken):
        raise ProjectError("the memory has no views; nothing to export")
    first: list[int] = []  # for each camera kept the first view that has it
    names: list[str] = []
    rows_of_name: dict[str, list[int]] = {}
    row_of_view = np.full(len(cameras), -1, np.int64)
    used: set[str] = set()
    # Observed views come first and keep their names.
    for i in taken[np.argsort(made[taken], kind="stable")].tolist():
        name = cameras.names[i]
        alike = rows_of_name.setdefault(name, [])
        row = next((row for row in alike if _same_camera(memory, first[row], i)), len(first))
        row_of_view[i] = row
        if row < len(first):
            continue
        if alike and not made[i]:
            raise ProjectError(
                f"two different observed cameras of the memory are named {name!r}; formats of "
                "other tools need unique names; rename one in the project and run again"
            )
        if made[i]:
            name = next(new for new in _generated_names(name) if new.lower() not in used)
        alike.append(row)
        first.append(i)
        names.append(name)
        used.add(name.lower())
    kept = cameras[first]
    kept = Cameras(kept.K, kept.cam_from_world, kept.width, kept.height, tuple(names))
    pictures: dict[str, Path | None] = {}
    for i, row in enumerate(row_of_view.tolist()):
        if row >= 0 and made[first[row]]:
            # Of several rounds' pictures the last.
            pictures[names[row]] = _picture(memory, i, run) or pictures.get(names[row])
    return DistinctCameras(kept, row_of_view, pictures)


def _generated_names(name: str) -> Iterator[str]:
    yield f"generated/{name}"
    yield from (f"generated_{number}/{name}" for number in count(2))


def _same_camera(memory: SpatialMemory, i: int, j: int) -> bool:
    """Whether two views of the memory have one camera, up to rounding."""
    first, second = memory.views[i].camera, memory.views[j].camera
    # Relative to the memory's origin: in a far world frame a tolerance would swallow a step aside.
    pose = memory.views.cam_from_local
    return bool(
        (first.width == second.width).all()
        and (first.height == second.height).all()
        and np.allclose(pose[i], pose[j])
        and np.allclose(first.K, second.K)
    )


def _tracks(
    memory: SpatialMemory,
    cameras: Cameras,
    group: NDArray[np.int64],
    *,
    row_of_view: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Point, view and pixel of each track element: one observation for each point and view."""
    view = row_of_view[memory.columns.view[: len(memory)]]
    order = np.argsort(-memory.confidence, kind="stable")
    order = order[view[order] >= 0]
    pair = group[order] * np.int64(len(cameras)) + view[order]
    _, first = np.unique(pair, return_index=True)
    chosen = np.sort(order[first])
    positions = memory.positions
    xy = np.empty((len(chosen), 2))
    inside = np.zeros(len(chosen), np.bool_)
    for i in range(len(cameras)):
        rows = np.flatnonzero(view[chosen] == i)
        if len(rows):
            xy[rows], z = (values[0] for values in cameras[i].project(positions[chosen[rows]]))
            size = (cameras.width[i], cameras.height[i])
            inside[rows] = (z > 0) & ((xy[rows] >= 0) & (xy[rows] <= size)).all(axis=1)
    chosen, xy = chosen[inside], xy[inside]
    return group[chosen], view[chosen], xy


def _picture(memory: SpatialMemory, view: int, run: Path) -> Path | None:
    """The picture that a run kept of a generated view, absolute."""
    source = memory.views[view]
    return completed_picture(run, source.round, source.camera.names[0])
