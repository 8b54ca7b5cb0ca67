"""A scene with its pictures reduced to a size that a run can hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gvtools.errors import OptionError
from gvtools.scenes.images import resize_nearest
from gvtools.scenes.scene import Finding, Frame, Scene, View

# Below this, nothing of a picture is left to work with.
SMALLEST = 64


def reduced(scene: Scene, max_side: int | None) -> Scene:
    """The scene with no picture's longer side above ``max_side``.

    Colours are averaged over what they stand for; depth and masks take the nearest pixel, so that
    no depth lies between two surfaces. Cameras and detections of sparse points follow.

    Args:
        scene: left as it is.
        max_side: pixels; None keeps every size.
    """
    check_max_side(max_side)
    sizes = np.array([(view.camera.width[0], view.camera.height[0]) for view in scene.views])
    if max_side is None or not len(sizes) or sizes.max() <= max_side:
        return scene
    factor = np.minimum(max_side / sizes.max(axis=1), 1.0)
    targets = np.maximum(np.rint(sizes * factor[:, None]), 1).astype(int)
    views = tuple(
        view if (size == target).all() else _reduced_view(view, int(target[0]), int(target[1]))
        for view, size, target in zip(scene.views, sizes, targets, strict=True)
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


def _reduced_view(view: View, width: int, height: int) -> View:
    def load() -> Frame:
        return _reduced_frame(view.load(), width, height)

    return replace(view, camera=view.camera.resized(width, height), load=load)


def _reduced_frame(frame: Frame, width: int, height: int) -> Frame:
    from PIL import Image

    picture = Image.fromarray(frame.rgb).resize((width, height), Image.Resampling.BOX)
    resized = [
        None if array is None else np.ascontiguousarray(resize_nearest(array, width, height))
        for array in (frame.depth, frame.mask)
    ]
    return Frame(np.array(picture), *resized)
