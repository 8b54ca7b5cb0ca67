"""A method's pictures: read, matched with the targets, resized to them, and checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError, ProjectError
from gvtools.evaluation.picture_matching import Matching, match_pictures
from gvtools.evaluation.picture_sets.open_pictures import open_pictures
from gvtools.evaluation.picture_sets.pictures import Picture, PictureSet
from gvtools.evaluation.posed_picture import PosedPicture
from gvtools.runs.layout import RECORD
from gvtools.runs.run import RunTarget, load_run
from gvtools.scenes.scene import Frame

if TYPE_CHECKING:
    from gvtools.cameras import Cameras
    from pipelines.evaluation.measured_target import MeasuredTarget

OWN_LAYOUT = "gvtools run"
# A picture has its target's aspect when its height differs by at most this from the height that
# its width and the target's aspect give, pixels.
SHAPE_TOLERANCE = 1.0
# The ground truth that a tool wrote beside a render is compared with that of the views, as
# thumbnails (width, height). Where another view's is nearer by more than this factor than that of
# the matched view, the match is refused.
THUMBNAIL = (32, 24)
CLEARLY = 2.0


@dataclass(frozen=True, eq=False)
class Method:
    """One method's pictures.

    Attributes:
        name: of the method.
        pictures: as they were found.
        matching: which picture stands for which target.
        targets: those that the method has a picture of, each with this picture.
        resized: original sizes (width, height) of the pictures that were resized to their target's,
            with the number of pictures of each.
    """

    name: str
    pictures: PictureSet
    matching: Matching
    targets: list[MeasuredTarget]
    resized: dict[tuple[int, int], int]

    def described(self) -> dict[str, Any]:
        """What was read and how, JSON-ready."""
        sizes = {
            (int(t.picture.camera.width[0]), int(t.picture.camera.height[0])) for t in self.targets
        }
        return {
            "name": self.name,
            "pictures": str(self.pictures.path),
            "layout": self.pictures.layout,
            "matched_by": self.matching.rule,
            "found": len(self.pictures.pictures),
            "missing": list(self.matching.missing),
            "left_over": list(self.matching.left_over),
            "sizes": [list(size) for size in sorted(sizes)],
            "resized": [
                {"from": list(size), "pictures": count}
                for size, count in sorted(self.resized.items())
            ],
            "depth": "own" if any(t.picture.depth is not None for t in self.targets) else None,
            "reading": list(self.pictures.notes),
        }


def method_names(paths: Sequence[Path], names: Sequence[str]) -> list[str]:
    """A name for each method: those given, else the folders'."""
    if names and len(names) != len(paths):
        raise OptionError(
            f"{len(names)} names (--name) for {len(paths)} folders; give one for each"
        )
    found = list(names) or [path.resolve().name for path in paths]
    if not names and len(set(found)) < len(found):
        found = [f"{path.resolve().parent.name}/{path.resolve().name}" for path in paths]
    if len(set(found)) < len(found):
        raise OptionError(f"two methods are called {_twice(found)!r}; tell them apart with --name")
    return found


def _twice(names: Sequence[str]) -> str:
    return next(name for name in names if names.count(name) > 1)


def open_method(path: Path, name: str, targets: Sequence[MeasuredTarget], *, rule: str) -> Method:
    """The pictures at ``path``, matched with the targets and resized to them.

    Args:
        path: a run of gvtools, or what ``open_pictures`` reads.
        name: of the method.
        targets: all of them; the picture that each holds is replaced.
        rule: how to match, see ``match_pictures``.
    """
    pictures = _run_pictures(path) if (path / RECORD).is_file() else open_pictures(path)
    views = [target.picture.name for target in targets]
    matching = match_pictures(
        pictures.names, views, rule=rule, alphabetical=pictures.alphabetical, what=str(path)
    )
    placed, resized = [], dict[tuple[int, int], int]()
    for target, number in zip(targets, matching.picture_of, strict=True):
        if number is None:
            continue
        picture = pictures.pictures[number]
        frame, size = _sized(picture.load(), target.picture.camera, what=f"{path}: {picture.name}")
        if size is not None:
            resized[size] = resized.get(size, 0) + 1
        placed.append(replace(target, picture=_posed(frame, target.picture)))
    _check_truths(pictures, matching, targets)
    return Method(name, pictures, matching, placed, resized)


def _run_pictures(path: Path) -> PictureSet:
    """What a run of gvtools completed, with its depth."""
    run = load_run(path)

    def load(view: RunTarget) -> Frame:
        files = view.read()
        return Frame(files.picture, files.depth)

    pictures = tuple(Picture(view.name, partial(load, view)) for view in run.views)
    return PictureSet(path, OWN_LAYOUT, pictures)


def _posed(frame: Frame, target: PosedPicture) -> PosedPicture:
    return PosedPicture(target.name, target.camera, frame.rgb, frame.depth)


def _sized(frame: Frame, camera: Cameras, *, what: str) -> tuple[Frame, tuple[int, int] | None]:
    """The picture in its target's size, and the size (width, height) that it had if another."""
    import cv2

    width, height = int(camera.width[0]), int(camera.height[0])
    rows, columns = frame.rgb.shape[:2]
    if (columns, rows) == (width, height):
        return frame, None
    expected = height * columns / width
    if abs(rows - expected) > SHAPE_TOLERANCE:
        raise ProjectError(
            f"{what} has {columns}x{rows} pixels; expected {width}x{height} like its view, or the "
            "same shape in another size; render it from the view's camera"
        )
    way = cv2.INTER_AREA if columns > width else cv2.INTER_CUBIC
    rgb = np.asarray(cv2.resize(frame.rgb, (width, height), interpolation=way), np.uint8)
    depth = frame.depth
    if depth is not None:
        depth = np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST))
    return Frame(rgb, depth), (columns, rows)


def _check_truths(
    pictures: PictureSet, matching: Matching, targets: Sequence[MeasuredTarget]
) -> None:
    """Compare the ground truth that a tool wrote beside its renders with that of the targets.

    Nothing is checked where it is missing beside any render.
    """
    kept = [picture.load_truth for picture in pictures.pictures]
    rows = [row for row, target in enumerate(targets) if target.truth is not None]
    if not rows or any(load is None for load in kept):
        return
    truths = np.stack([_thumbnail(t.truth.rgb) for t in targets if t.truth is not None])
    for row in rows:
        number = matching.picture_of[row]
        load = None if number is None else kept[number]
        if number is None or load is None:
            continue
        distance = np.abs(truths - _thumbnail(load())).mean(axis=(1, 2, 3))
        best = int(distance.argmin())
        if distance[rows.index(row)] > CLEARLY * distance[best]:
            raise ProjectError(
                f"{pictures.path}: {pictures.names[number]} stands for {targets[row].picture.name} "
                f"by its {matching.rule}, but the truth beside it is "
                f"{targets[rows[best]].picture.name}; "
                "expected the same views in the same order; give the same --targets"
            )


def _thumbnail(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    import cv2

    small = cv2.resize(rgb, THUMBNAIL, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)
