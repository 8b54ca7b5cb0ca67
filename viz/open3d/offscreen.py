"""Renders points with Open3D, unseen: ``python -m viz.open3d.offscreen GIVEN.npz MADE.npy``.

A program of its own, as Open3D may end the process where there is neither EGL nor an X display.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def main(given: Path, made: Path) -> None:
    """Render what ``viz.open3d.screenshot`` wrote; leaves (H, W, 3) uint8 at ``made``.

    Raises:
        RuntimeError: Open3D renders neither off screen nor in a hidden window.
    """
    import open3d as o3d

    with np.load(given, allow_pickle=False) as stored:
        arrays = dict(stored)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(arrays["positions"]))
    cloud.colors = o3d.utility.Vector3dVector(arrays["rgb"] / 255.0)
    try:
        picture = _off_screen(o3d, cloud, arrays)
    except RuntimeError as error:
        found = _in_hidden_window(o3d, cloud, arrays)
        if found is None:
            raise RuntimeError(f"{error}; and no X display") from None
        picture = found
    np.save(made, picture)


def _off_screen(o3d: Any, cloud: Any, arrays: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
    width, height = arrays["size"].tolist()
    renderer = o3d.visualization.rendering.OffscreenRenderer(width, height)
    renderer.scene.set_background([1.0, 1.0, 1.0, 1.0])
    # Colours are to come out as they went in.
    renderer.scene.view.set_post_processing(False)
    material = o3d.visualization.rendering.MaterialRecord()
    material.shader = "defaultUnlit"
    material.point_size = float(arrays["pixels"])
    renderer.scene.add_geometry("points", cloud, material)
    renderer.setup_camera(arrays["K"], arrays["cam_from_local"], width, height)
    return np.asarray(renderer.render_to_image())


def _in_hidden_window(
    o3d: Any, cloud: Any, arrays: dict[str, NDArray[Any]]
) -> NDArray[np.uint8] | None:
    """None where there is no window. The principal point is taken as the picture's middle."""
    width, height = arrays["size"].tolist()
    window = o3d.visualization.Visualizer()
    if not window.create_window("gvtools", width, height, visible=False):
        return None
    window.get_render_option().point_size = float(arrays["pixels"])
    window.add_geometry(cloud)
    view = window.get_view_control()
    camera = view.convert_to_pinhole_camera_parameters()
    focal = float(arrays["K"][1, 1])
    camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(
        width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5
    )
    camera.extrinsic = arrays["cam_from_local"]
    view.convert_from_pinhole_camera_parameters(camera, allow_arbitrary=True)
    window.poll_events()
    window.update_renderer()
    rgb = np.asarray(window.capture_screen_float_buffer(do_render=True))
    window.destroy_window()
    return np.rint(rgb * 255).astype(np.uint8)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
