"""Scenes with resampled pictures: reduced, of one size; and with some views' points alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.scenes.images import resize_nearest
from gvtools.scenes.scene import Finding, Frame, Scene, SparsePoints, View

# Left, top, width and height of a picture's window, pixels.
Window = tuple[int, int, int, int]
# Below this side, nothing of a picture is left to work with.
SMALLEST = 64


def reduced(scene: Scene, max_side: int | None) -> Scene:
    """The scene with no picture's longer side above ``max_side`` pixels; None keeps every size.

    Colours are averaged over what they stand for; depth and masks take the nearest pixel, so that
    no depth lies between two surfaces. Cameras and detections of sparse points follow.
    """
    check_max_side(max_side)
    sizes = np.array([(view.camera.width[0], view.camera.height[0]) for view in scene.views])
    if max_side is None or not len(sizes) or sizes.max() <= max_side:
        return scene
    factor = np.minimum(max_side / sizes.max(axis=1), 1.0)
    targets = np.maximum(np.rint(sizes * factor[:, None]), 1).astype(int)
    views = tuple(
        view
        if (size == target).all()
        else _resized_view(view, (0, 0, *size), width=int(target[0]), height=int(target[1]))
        for view, size, target in zip(scene.views, sizes.tolist(), targets, strict=True)
    )
    points = scene.points
    if points is not None:
        share = targets / sizes
        points = replace(points, xy=points.xy * share[points.view_index])
    count = int((sizes.max(axis=1) > max_side).sum())
    largest = sizes[sizes.max(axis=1).argmax()]
    message = (
        f"{count} pictures are reduced to {max_side} pixels on their longer side (the largest is "
        f"{largest[0]}x{largest[1]}); max_side says how far"
    )
    findings = (*scene.findings, Finding("info", message))
    return replace(scene, views=views, points=points, findings=findings)


def check_max_side(max_side: int | None) -> None:
    """Refuse a size at which nothing is left."""
    if max_side is not None and not max_side >= SMALLEST:
        raise OptionError(f"max_side {max_side}; expected at least {SMALLEST}")


def resized(scene: Scene, width: int, height: int) -> Scene:
    """The scene with every picture ``width`` x ``height`` pixels large.

    The largest central window of that shape is taken and resampled: colours are averaged where
    pictures become smaller and interpolated where they grow; depth and masks take the nearest
    pixel. Cameras and detections of sparse points follow.
    """
    windows = [_window(view, width, height) for view in scene.views]
    views = tuple(
        view
        if window == (0, 0, width, height)
        else _resized_view(view, window, width=width, height=height)
        for view, window in zip(scene.views, windows, strict=True)
    )
    points = scene.points
    if points is not None:
        left_top = np.array([window[:2] for window in windows], np.float64)[points.view_index]
        size = np.array([window[2:] for window in windows], np.float64)[points.view_index]
        xy = (points.xy - left_top) / size * (width, height)
        inside = np.all((xy >= 0) & (xy <= (width, height)), axis=1)
        points = _with_tracks(replace(points, xy=xy), inside, least=1)
    return replace(scene, views=views, points=points)


def seen_by(scene: Scene, names: Iterable[str]) -> Scene:
    """The scene with the sparse points alone that two of the named views detected."""
    points = scene.points
    if points is None:
        return scene
    rows = [scene.names.index(name) for name in names]
    return replace(scene, points=_with_tracks(points, np.isin(points.view_index, rows), least=2))


def _window(view: View, width: int, height: int) -> Window:
    """The largest central one of the target's shape."""
    whole = int(view.camera.width[0]), int(view.camera.height[0])
    scale = min(whole[0] / width, whole[1] / height)
    size = round(width * scale), round(height * scale)
    return (whole[0] - size[0]) // 2, (whole[1] - size[1]) // 2, *size


def _resized_view(view: View, window: Window, *, width: int, height: int) -> View:
    def load() -> Frame:
        return _resized_frame(view.load(), window, width=width, height=height)

    cropped = view.camera.cropped(window[0], window[1], width=window[2], height=window[3])
    return replace(view, camera=cropped.resized(width, height), load=load)


def _resized_frame(frame: Frame, window: Window, *, width: int, height: int) -> Frame:
    from PIL import Image

    left, top = window[:2]
    across, down = slice(left, left + window[2]), slice(top, top + window[3])
    method = Image.Resampling.BOX if window[2] >= width else Image.Resampling.BICUBIC
    picture = Image.fromarray(np.ascontiguousarray(frame.rgb[down, across]))
    arrays: list[NDArray[np.generic] | None] = [
        None if array is None else np.ascontiguousarray(
            resize_nearest(array[down, across], width, height)
        )
        for array in (frame.depth, frame.mask)
    ]  # fmt: skip
    return Frame(np.array(picture.resize((width, height), method)), *arrays)  # type: ignore[arg-type]


def _with_tracks(points: SparsePoints, keep: NDArray[np.bool_], *, least: int) -> SparsePoints:
    """The points with at least ``least`` detections among those to keep."""
    counts = np.bincount(points.point_index[keep], minlength=len(points.positions))
    known = counts >= least
    keep = keep & known[points.point_index]
    number = np.cumsum(known) - 1
    index = number[points.point_index[keep]].astype(np.int32)
    kept = points.positions[known], points.colors[known], points.errors[known]
    return SparsePoints(*kept, index, points.view_index[keep], points.xy[keep])
