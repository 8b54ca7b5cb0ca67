"""COLMAP's PatchMatch stereo, where pycolmap was built with CUDA.

J. L. Schönberger et al., "Pixelwise view selection for unstructured multi-view stereo", ECCV 2016.
The context's pictures, already undistorted, go to a temporary dense workspace; nothing is written
to the project.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.depth.source import DepthMap, RecordedDepth
from gvtools.errors import DegenerateError, ProjectError
from gvtools.scenes.colmap import depth_map_path
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.images import read_depth
from gvtools.scenes.scene import Frame, Scene, View

# Source pictures of each, chosen by COLMAP from co-visibility.
SOURCES = 20


def has_patch_match() -> bool:
    """Whether this pycolmap can run PatchMatch."""
    from gvtools.colmap import pycolmap

    return bool(pycolmap.has_cuda)


class ColmapPatchMatch:
    """Depth of some views of a scene with points, computed together when the first is asked for."""

    name = "colmap-patch-match"

    def __init__(self, scene: Scene, views: Sequence[str]) -> None:
        if scene.points is None:
            raise ProjectError(
                f"{scene.root}: COLMAP's PatchMatch needs sparse points, and there are none; "
                "triangulate, or use plane-sweep"
            )
        self._scene, self.views = scene, tuple(views)
        self._depth: dict[str, NDArray[np.float32]] | None = None

    def covers(self, view: View) -> bool:
        """The given views."""
        return view.name in self.views

    def depth(self, scene: Scene, view: View, frame: Frame) -> DepthMap:
        """The view's geometric depth map, trusted as recorded ones are."""
        if self._depth is None:
            with tempfile.TemporaryDirectory() as folder:
                self._depth = self._run(Path(folder))
        if view.name not in self._depth:
            raise DegenerateError(f"{scene.root}: PatchMatch gave no depth of view {view.name}")
        found = Frame(frame.rgb, self._depth[view.name], frame.mask)
        trusted = RecordedDepth().depth(scene, view, found)
        return DepthMap(trusted.depth, trusted.confidence, self.name)

    def _run(self, folder: Path) -> dict[str, NDArray[np.float32]]:
        from PIL import Image

        from gvtools.colmap import pycolmap

        write_workspace(folder, self._scene, self.views)
        for name in self.views:
            path = folder / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            # Without loss, whatever the suffix says.
            Image.fromarray(self._scene[name].load().rgb).save(path, format="PNG")
        try:
            pycolmap.patch_match_stereo(folder)
        except (RuntimeError, ValueError) as error:
            raise ProjectError(
                f"{self._scene.root}: COLMAP's PatchMatch failed ({error}); use plane-sweep"
            ) from None
        out = {}
        for name in self.views:
            found = depth_map_path(folder / "stereo" / "depth_maps", name)
            if found is not None:
                out[name] = read_depth(found)
        return out


def write_workspace(folder: Path, scene: Scene, views: Sequence[str]) -> None:
    """Sparse model and configuration of a dense workspace with the named views alone."""
    points = scene.points
    assert points is not None
    row = {view.name: i for i, view in enumerate(scene.views)}
    kept = np.full(len(scene.views), -1)
    kept[[row[name] for name in views]] = np.arange(len(views))
    inside = kept[points.view_index] >= 0
    point, first = np.unique(points.point_index[inside], return_inverse=True)
    write_colmap(
        folder / "sparse",
        scene.subset(views).cameras,
        points=points.positions[point],
        colors=points.colors[point],
        point_index=first,
        view_index=kept[points.view_index[inside]],
        xy=points.xy[inside],
    )
    stereo = folder / "stereo"
    for name in ("depth_maps", "normal_maps", "consistency_graphs"):
        (stereo / name).mkdir(parents=True, exist_ok=True)
    lines = [line for name in views for line in (name, f"__auto__, {SOURCES}")]
    (stereo / "patch-match.cfg").write_text("\n".join(lines) + "\n", encoding="utf-8")
