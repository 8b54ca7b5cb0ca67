from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from PIL import Image
from reference_rays import first_surface, is_free
from scipy.ndimage import map_coordinates

from gvtools.cameras import Cameras
from gvtools.procedural.furnished_room import furnished_room
from gvtools.procedural.ray_cast import clearance
from gvtools.procedural.room_sample import write_room
from gvtools.procedural.sample_workspace import WrittenSample
from gvtools.scenes.colmap import read_colmap
from gvtools.scenes.scene import Frame, Scene

SIZE = {"views": 6, "width": 160, "height": 120}


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> WrittenSample:
    return write_room(tmp_path_factory.mktemp("room") / "seed0", seed=0, **SIZE)


@pytest.fixture(scope="module")
def scene(sample: WrittenSample) -> Scene:
    return read_colmap(sample.folder)


@pytest.fixture(scope="module")
def frames(scene: Scene) -> list[Frame]:
    return [view.load() for view in scene]


def _warp(
    source: Frame, target: Frame, source_camera: Cameras, target_camera: Cameras, scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """The source's colours seen at the target's pixels, and where both see the same surface."""
    assert source.depth is not None and target.depth is not None
    local = target_camera.rays() * target.depth[..., None] * scale
    world_from_cam = target_camera.world_from_cam[0]
    points = local @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    xy, z = source_camera.project(points.reshape(-1, 3))
    xy = np.nan_to_num(xy[0], nan=-9)
    at = [xy[:, 1] - 0.5, xy[:, 0] - 0.5]
    height, width = source.depth.shape
    inside = (at[0] >= 0) & (at[0] <= height - 1) & (at[1] >= 0) & (at[1] <= width - 1)
    seen = map_coordinates(source.depth.astype(float), at, order=1, mode="nearest")
    same = inside & (np.abs(seen / z[0] - 1) < 0.005)
    channels = np.moveaxis(source.rgb.astype(float), -1, 0)
    colors = [map_coordinates(each, at, order=1, mode="nearest") for each in channels]
    shape = target.depth.shape
    return np.transpose(colors).reshape(*shape, 3), same.reshape(shape)


def test_depth_is_where_rays_leave_free_space(scene: Scene, frames: list[Frame]) -> None:
    geometry = furnished_room(0).geometry
    rng = np.random.default_rng(2)
    for view, frame in enumerate(frames):
        assert frame.depth is not None
        y, x = (rng.integers(0, side, 16) for side in frame.depth.shape)
        pose = scene.cameras.cam_from_world[view, :3, :3]
        rays = scene.cameras.rays(view)[y, x] @ pose
        expected = first_surface(geometry, scene.cameras.centers[view], rays)
        np.testing.assert_allclose(frame.depth[y, x], expected, rtol=1e-5)


def test_depth_carries_one_views_colours_into_another(scene: Scene, frames: list[Frame]) -> None:
    source, target = frames[0], frames[1]
    cameras = scene.cameras
    colors, same = _warp(source, target, cameras[0], cameras[1])
    assert same.mean() > 0.3
    error = np.abs(colors - target.rgb)[same].mean()
    shifted, _ = _warp(source, target, cameras[0], cameras[1], scale=1.03)
    assert error < 6
    assert np.abs(shifted - target.rgb)[same].mean() > 2 * error


def test_workspace_reads_back_with_nothing_to_complain(sample, scene, frames):
    model = pycolmap.Reconstruction(sample.folder / "sparse" / "0")
    assert {image.name for image in model.images.values()} == {*sample.context, *sample.targets}
    assert model.num_points3D() > 200
    # Two independent coordinates of 0.3 px noise: mean length 0.3 sqrt(pi / 2).
    assert model.compute_mean_reprojection_error() == pytest.approx(0.376, abs=0.03)
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    for name in (*sample.context, *sample.targets):
        with Image.open(sample.folder / "images" / name) as image:
            assert image.size == (SIZE["width"], SIZE["height"])
    assert scene.names == tuple(sorted((*sample.context, *sample.targets)))
    assert [f.message for f in scene.findings if f.level != "info"] == []
    assert all(((frame.depth > 0.1) & (frame.depth < 9)).all() for frame in frames)


def test_targets_lead_away_from_what_the_context_sees(scene, frames, sample):
    index = {name: i for i, name in enumerate(scene.names)}
    seen = []
    for target in sample.targets:
        i = index[target]
        covered = np.zeros(frames[i].rgb.shape[:2], bool)
        for name in sample.context:
            j = index[name]
            covered |= _warp(frames[j], frames[i], scene.cameras[j], scene.cameras[i])[1]
        seen.append(covered.mean())
    assert seen[0] > 0.5
    assert seen[-1] < 0.4 * seen[0]


@pytest.mark.parametrize("seed", range(6))
def test_cameras_and_lamps_stand_clear_of_furniture(seed: int) -> None:
    room = furnished_room(seed)
    geometry = room.geometry
    half = geometry.rooms[0, 1, :2] / 2
    angle = np.linspace(0, 2 * np.pi, 90)
    ring = half + (half - 1.2) * np.stack([np.cos(angle), np.sin(angle)], -1)
    eyes = np.concatenate([np.c_[ring, np.full(len(ring), up)] for up in (1.34, 1.56)])
    assert clearance(geometry, eyes).min() > 0.15
    assert (geometry.centre > -1e-9).all() and (geometry.centre < geometry.rooms[0, 1] + 1e-9).all()
    assert is_free(geometry, room.look.lamps[:, 0]).all()
