"""Recorded scenes as cases: five views are the context, others between them are the targets.

Depth of the context is what the project holds, or, of photographs, what a plane sweep finds in all
of the project's photographs: it makes the memory that every method is given alike. Photographs have
no true depth, so only their colours are judged.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.experiments.cases import Case
from gvtools.cameras import concatenate
from gvtools.completers.base import ContextView
from gvtools.depth.choice import choose_source
from gvtools.errors import OptionError
from gvtools.scenes.scene import Frame, Scene
from gvtools.training.samples import Observation, project_observation

CONTEXT, TARGETS = 5, 25


@dataclass(frozen=True)
class Split:
    """Numbers of the views that are given, and of those that are judged."""

    context: tuple[int, ...]
    targets: tuple[int, ...]


def splits(views: int, *, context: int = CONTEXT, targets: int = TARGETS) -> list[Split]:
    """Context spread evenly over a scene's views; targets spread evenly over the others.

    Where the others are fewer than the targets asked for, further splits follow whose context is
    shifted, until there are enough targets.

    Args:
        views: of the scene, in the order of its path.
        context: views that are given.
        targets: least number of targets, over all splits.

    Raises:
        OptionError: too few views for one target.
    """
    if views <= context:
        raise OptionError(f"a scene of {views} views; expected more than {context}")
    step, found = views / context, list[Split]()
    rounds = -(-targets // (views - context))
    # Shifted contexts are distinct up to a whole step.
    for shift in range(min(rounds, int(step))):
        given = tuple(int(step * (number + shift / rounds)) for number in range(context))
        others = [view for view in range(views) if view not in given]
        wanted = min(targets, len(others))
        chosen = tuple(others[int((i + 0.5) * len(others) / wanted)] for i in range(wanted))
        found.append(Split(given, chosen))
    return found


def scan_cases(scene: Scene, *, context: int = CONTEXT, targets: int = TARGETS) -> Iterator[Case]:
    """One case a target, each with all of its split's context.

    Args:
        scene: with recorded depth, or photographs that a plane sweep can find depth in.
        context: views that are given.
        targets: at least so many, where the scene has enough views.

    Raises:
        OptionError: too few views.
        ProjectError: no depth is recorded and none can be found.
    """
    names = scene.names
    source = choose_source(scene, names, "auto").source
    for number, split in enumerate(splits(len(names), context=context, targets=targets)):
        given = []
        for index in split.context:
            view = scene[names[index]]
            frame = view.load()
            depth = source.depth(scene, view, frame).depth
            given.append(ContextView(view.name, view.camera, _picture(frame), _known(depth)))
        memory = Observation(tuple(given), tuple(view.camera for view in given))
        views = [scene[names[index]] for index in split.targets]
        guidance = project_observation(memory, concatenate([view.camera for view in views]))
        for index, view in enumerate(views):
            frame = view.load()
            holes = ~guidance.valid[index]
            depth = np.zeros(holes.shape, np.float32) if frame.depth is None else frame.depth
            yield Case(
                f"{scene.root.name}, split {number + 1}, {view.name}",
                tuple(given),
                guidance[index],
                _picture(frame)[None],
                _known(depth)[None],
                (holes if frame.mask is None else holes & frame.mask)[None],
            )


def _picture(frame: Frame) -> np.ndarray:
    return (frame.rgb / np.float32(255)).astype(np.float32)


def _known(depth: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
