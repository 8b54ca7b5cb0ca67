"""Before everything else: the poses of RGB-D views, which come from a tracker, are refined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.fit_views import FitView
from gvtools.cameras import Cameras
from gvtools.errors import MemoryFileError
from gvtools.runs.layout import POSES
from pipelines.reconstruction.prefetch import prefetch

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene
    from pipelines.reconstruction.plan import Plan


@dataclass(frozen=True, eq=False)
class RunPoses:
    """Poses of a run other than those of its project.

    Attributes:
        context: (C, 4, 4) cam_from_world.
        targets: (V, 4, 4).
    """

    context: NDArray[np.float64]
    targets: NDArray[np.float64]

    def applied(self, plan: Plan) -> Plan:
        """The plan with these poses."""
        targets = replace(plan.targets, cameras=_posed(plan.targets.cameras, self.targets))
        return replace(plan, scene=self.scene(plan.scene, plan.context), targets=targets)

    def scene(self, scene: Scene, context: Sequence[str]) -> Scene:
        """The scene with these poses of the context."""
        moved = dict(zip(context, self.context, strict=True))
        views = tuple(
            replace(view, camera=_posed(view.camera, moved[view.name][None]))
            if view.name in moved
            else view
            for view in scene.views
        )
        return replace(scene, views=views)

    def save(self, path: Path) -> None:
        """Write them into one file."""
        with path.open("wb") as file:
            np.savez(file, context=self.context, targets=self.targets)

    @classmethod
    def load(cls, path: Path) -> RunPoses:
        """Read what ``save`` wrote.

        Raises:
            MemoryFileError: damaged.
        """
        try:
            with np.load(path) as data:
                return cls(data["context"], data["targets"])
        except (OSError, ValueError, KeyError, BadZipFile) as error:
            raise MemoryFileError(f"{path}: expected refined poses; found none: {error}") from error


def refined(
    scene: Scene,
    context: Sequence[str],
    targets: Cameras,
    *,
    say: Callable[[str], None] | None = None,
) -> RunPoses | None:
    """Poses on which the context agrees; None where the given ones stay.

    Args:
        scene: the project.
        context: names of its views; only where all have recorded depth are they refined.
        targets: move like the context near them, if that errs alike.
        say: is told what was found.
    """
    views = [scene[name] for name in context]
    if not all(view.has_depth for view in views):
        return None
    from gvtools.appearance.refined_poses import refined_poses

    frames = prefetch(lambda view: view.load(), views)
    found = refined_poses([
        FitView(frame.rgb, view.camera.K[0], view.camera.cam_from_world[0], frame.mask, frame.depth)
        for view, frame in zip(views, frames, strict=True)
    ])  # fmt: skip
    if say is not None:
        same = "as given; no others agree better with neighbouring views"
        say(f"poses: {same if found is None else found}")
    if found is None:
        return None
    moved = [found.corrected(pose) for pose in targets.cam_from_world]
    return RunPoses(found.poses, np.array(moved).reshape(-1, 4, 4))


def saved(round_0: Path) -> RunPoses | None:
    """The refined poses of a run whose round 0 is complete; None where the given ones stayed.

    Raises:
        MemoryFileError: damaged.
    """
    path = round_0 / POSES
    return RunPoses.load(path) if path.exists() else None


def _posed(cameras: Cameras, cam_from_world: NDArray[np.float64]) -> Cameras:
    return Cameras(cameras.K, cam_from_world, cameras.width, cameras.height, cameras.names)
