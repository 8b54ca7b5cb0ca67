"""The voxel grid of a run: its frame, and its edge by what a pixel of the context sees."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from gvtools.errors import DegenerateError, ProjectError
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.view_selection import evenly_spread

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gvtools.depth.source import DepthSource
    from gvtools.scenes.scene import Scene, View


def grid_frame(scene: Scene, names: Sequence[str]) -> LocalFrame:
    """The frame of the first of the context cameras, by name, not by the project's order.

    A world that is scaled, turned, shifted or listed otherwise gives the same memory in it.
    """
    return LocalFrame.of_camera(scene[min(names)].camera)


def automatic_voxel(
    scene: Scene,
    context: Sequence[str],
    source: DepthSource,
    *,
    percentile: float,
    say: Callable[[str], None] | None = None,
) -> float:
    """The median over some views of a percentile of their pixel footprints z / f, scene units.

    Recorded depth and sparse points tell z. Only where no view has either is depth computed, by a
    rough version of the source.

    Args:
        scene: the project.
        context: names of the views that may be looked at.
        source: the run's source of depth.
        percentile: of each view's footprints, 0 to 100.
        say: receives a line before depth is computed.
    """
    import numpy as np

    from gvtools.depth.source import is_recorded

    rows = {name: row for row, name in enumerate(scene.names)}
    tracked = set() if scene.points is None else set(scene.points.view_index.tolist())
    with_depth = [
        name for name in context if is_recorded(source, scene[name]) or rows[name] in tracked
    ]
    footprints: list[float] = []
    for name in evenly_spread(with_depth):
        view = scene[name]
        depths = _recorded(view) if is_recorded(source, view) else _of_points(scene, rows[name])
        footprints += _footprint(view, depths, percentile)
    if not footprints:
        footprints = _computed(scene, context, source, percentile=percentile, say=say)
    return float(np.median(footprints))


def _computed(
    scene: Scene,
    context: Sequence[str],
    source: DepthSource,
    *,
    percentile: float,
    say: Callable[[str], None] | None,
) -> list[float]:
    """Footprints by a rough source."""
    from gvtools.depth.choice import rough_source
    from gvtools.depth.source import is_recorded

    rough = rough_source(scene, source)
    views = [n for n in context if rough.covers(scene[n]) and not is_recorded(source, scene[n])]
    if not views:
        raise ProjectError(f"{scene.root}: the context's depth maps are empty; see 'gvtools check'")
    names = evenly_spread(views)
    if say is not None:
        kind, then = "depth", "and kept for the run"
        if rough is not source:
            kind, then = "rough depth", "which --voxel EDGE saves"
        say(
            f"no sparse points or recorded depth to go by: the voxel edge comes from {kind} "
            f"({rough.name}) of {len(names)} of {len(context)} context views, computed now, {then}"
        )
    footprints: list[float] = []
    reason = "it is empty"
    for name in names:
        view = scene[name]
        try:
            depth = rough.depth(scene, view, view.load()).depth
        except DegenerateError as error:
            reason = str(error)
            continue
        footprints += _footprint(view, depth[depth > 0], percentile)
    if not footprints:
        raise ProjectError(
            f"{scene.root}: no depth was found to derive a voxel edge from ({reason}); give "
            "--voxel EDGE, in scene units"
        )
    return footprints


def _recorded(view: View) -> NDArray[np.float32]:
    import numpy as np

    depth = view.load().depth
    return np.zeros(0, np.float32) if depth is None else depth[depth > 0]


def _of_points(scene: Scene, row: int) -> NDArray[np.float32]:
    """Depths of the sparse points in a view's tracks."""
    import numpy as np

    points = scene.points
    assert points is not None
    mine = points.point_index[points.view_index == row]
    _, z = scene.views[row].camera.project(points.positions[mine])
    return z[0][z[0] > 0].astype(np.float32)


def _footprint(view: View, depths: NDArray[np.float32], percentile: float) -> list[float]:
    """One footprint, or none without depth."""
    import numpy as np

    if not depths.size:
        return []
    focal = float(np.sqrt(view.camera.K[0, 0, 0] * view.camera.K[0, 1, 1]))
    return [float(np.percentile(depths, percentile)) / focal]
