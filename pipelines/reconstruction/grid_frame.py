"""Where a run's voxel grid lies: in a context camera's frame, so that it goes with the scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from gvtools.memory.store.local_frame import LocalFrame

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene


def grid_frame(scene: Scene, names: Sequence[str]) -> LocalFrame:
    """The frame of the first of the views, by name: not by the order that a project lists them in.

    A world that is scaled, turned, shifted or listed otherwise gives the same memory in it.
    """
    return LocalFrame.of_camera(scene[min(names)].camera)
