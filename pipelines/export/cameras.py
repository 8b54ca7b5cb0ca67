"""The cameras of a memory, with points or without, for COLMAP's and nerfstudio's readers.

Pictures stay where they are; beside a ``transforms.json`` those from elsewhere get a link or a copy
in ``images``. Views that a completer made are named ``generated/NAME``, and stand in
``generated.txt`` beside a model's files, one a line and, where a run has it, the path of the
picture; in a ``transforms.json`` their frames have the key ``generated``. By the list, or by the
key ``exported_by``, an export is known, so that nothing else is ever written over.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.files import link_or_copy, write_text
from gvtools.memory.thinning import thin
from gvtools.runs.target_files import write_png
from gvtools.scenes.colmap_writer import write_colmap as write_model
from gvtools.scenes.images import IMAGE_SUFFIXES, read_image
from gvtools.scenes.matching import named
from gvtools.scenes.scene import View
from gvtools.scenes.transforms import FILE as TRANSFORMS
from gvtools.scenes.transforms import write_transforms as write_frames
from gvtools.scenes.transforms import written_here
from pipelines.export.formats import ExportOptions
from pipelines.export.source import DistinctCameras, ExportSource

GENERATED = "generated.txt"
HEADER = "# views that a completer made: name, and its picture where the run kept it"
MODEL = "sparse/0"
# COLMAP's own tools give up on more.
MAX_POINTS = 200_000


def write_colmap(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write a binary model to ``sparse/0`` below a folder; pictures belong into its ``images``.

    Each point is the most confident observation of its voxel. Its track are the other observations
    there, one a view, at the pixels where their views have them, so that reprojection errors are
    real.
    """
    memory, distinct = source.memory, source.cameras()
    limit = MAX_POINTS if options.max_points is None else options.max_points
    kept = thin(memory, limit)
    point, view, xy = _tracks(source, distinct, kept.group)
    lines = [
        name if picture is None else f"{name}\t{picture}"
        for name, picture in distinct.generated.items()
    ]
    # First, so that an export that was killed is known for one when it is made again.
    write_text(path / MODEL / GENERATED, "\n".join([HEADER, *lines]) + "\n")
    write_model(
        path / MODEL,
        distinct.cameras,
        points=memory.positions[kept.rows],
        colors=memory.columns.colors[kept.rows],
        point_index=point,
        view_index=view,
        xy=xy,
    )
    return (
        f"{len(distinct.cameras)} views ({len(distinct.generated)} generated), {len(kept.rows)} "
        f"points of {len(memory)} observations (voxels of {kept.edge:.4g}), {len(point)} track "
        f"elements in {path}/sparse/0; no pictures are copied"
    )


def write_transforms(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write ``transforms.json``: the file, or into the folder.

    ``images`` is the folder of the observed views' pictures, absolute or relative to the file;
    those that are not there are taken from the run's project, undistorted where it is not. Pictures
    of generated views are those of the run's rounds.
    """
    file, distinct = transforms_file(path), source.cameras()
    home = file.parent.resolve()
    paths, elsewhere, absent = [], dict[Path, Path | NDArray[np.uint8]](), list[str]()
    views = source.project
    for name in distinct.cameras.names:
        made = distinct.generated.get(name)
        given = (home / options.images / name if made is None else made).resolve()
        picture: Path | NDArray[np.uint8] = given
        if not given.is_file():
            picture = _pixels(views[name]) if made is None and name in views else given
        place = Path("images") / name
        if not isinstance(picture, Path):
            place = place.with_suffix(".png")
            elsewhere[home / place] = picture
        elif picture.is_relative_to(home):
            place = picture.relative_to(home)
        elif picture.is_file():
            elsewhere[home / place] = picture
        if isinstance(picture, Path) and not picture.is_file():
            absent.append(name)
        paths.append(place)
    theirs = [target for target in elsewhere if target.exists()]
    if theirs and not any(map(written_here, home.glob("*.json"))):
        raise OptionError(
            f"{theirs[0]}: is there already, was not written by gvtools export, and would be "
            "replaced; give another --out"
        )
    generated = distinct.generated.keys()
    write_frames(file, distinct.cameras, image_paths=paths, generated=generated, up=source.up)
    # Readers look nowhere else: pictures from elsewhere get a second name, by a link or a copy.
    for target, picture in elsewhere.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        if isinstance(picture, Path):
            link_or_copy(picture, target)
        else:
            write_png(target, picture)
    told = f"{len(distinct.cameras)} views ({len(distinct.generated)} generated) in {path}"
    if absent:
        told += f"; {len(absent)} pictures are not there ({named(absent)}): give --images"
    return told


def _pixels(view: View) -> Path | NDArray[np.uint8]:
    """A view's picture file, or its pixels where the file holds them distorted or larger."""
    rgb = view.load().rgb
    file = view.files[0] if view.files else None
    picture = file is not None and file.suffix.lower() in IMAGE_SUFFIXES
    if file is not None and picture and np.array_equal(read_image(file).rgb, rgb):
        return file.resolve()
    return rgb


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


def _tracks(
    source: ExportSource, distinct: DistinctCameras, group: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Point, view and pixel of each track element: one observation for each point and view."""
    memory, cameras = source.memory, distinct.cameras
    view = distinct.row_of_view[memory.columns.view[: len(memory)]]
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
