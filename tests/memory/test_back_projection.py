"""Pixels lifted to points; panoramas and fisheyes: directions as of COLMAP's lenses, up."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import camera
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, concatenate, invert_rigid
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance
from gvtools.memory.back_projection import FREE_CELL, BackProjectionOptions, back_project
from gvtools.memory.panoramas import LensOptions, Rig, picture_cameras
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.views import PointSet
from gvtools.memory.store.voxel_index import VoxelLevels
from gvtools.trajectories import level_up, look_at

KEEP_ALL = BackProjectionOptions(edge=1e9, grazing=0)
FOCAL, NEAR, FAR = 50.0, 1.0, 4.0
# Keeps everything, steps too.
STEEP = BackProjectionOptions(edge=10.0, grazing=0.0)


def _numbered(shape) -> np.ndarray:
    """Colours that name the pixel: row, column, 0."""
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return np.stack([rows, cols, 0 * rows], -1).astype(np.uint8)


def _kept(lifted: PointSet, shape: tuple[int, ...]) -> np.ndarray:
    """Which of numbered pixels became points."""
    kept = np.zeros(shape, bool)
    kept[lifted.colors[:, 0], lifted.colors[:, 1]] = True
    return kept


def _plane_depth(source, normal, distance) -> np.ndarray:
    """Depth of the plane normal · X = distance of the camera's frame."""
    return (distance / (source.rays() @ np.asarray(normal))).astype(np.float32)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), far=st.sampled_from([0.0, 5e6]))
def test_projection_undoes_back_projection(seed, far):
    """Also for turned, skewed and georeferenced cameras: to a thousandth of a pixel."""
    rng = np.random.default_rng(seed)
    origin = far * rng.normal(0, 1, 3)
    source = camera(
        width=40, height=30, focal=35, skew=rng.uniform(-2, 2),
        rotation=rng.normal(0, 1, 3), center=origin + rng.normal(0, 2, 3),
    )  # fmt: skip
    depth = rng.uniform(1, 9, (30, 40)).astype(np.float32)
    depth[rng.random((30, 40)) < 0.2] = 0
    lifted = back_project(
        _numbered((30, 40)), depth, source, frame=LocalFrame.at(origin), options=KEEP_ALL
    )
    # The oracle's own rounding is that of coordinates of millions: look from near the origin.
    xy, z = source.project(lifted.positions.astype(float) + origin)
    rows, cols = lifted.colors[:, 0].astype(int), lifted.colors[:, 1].astype(int)
    np.testing.assert_allclose(xy[0, :, 0], cols + 0.5, atol=1e-3)
    np.testing.assert_allclose(xy[0, :, 1], rows + 0.5, atol=1e-3)
    np.testing.assert_allclose(z[0], depth[rows, cols], rtol=1e-5)
    assert len(lifted) + sum(lifted.dropped.values()) == 1200
    assert lifted.dropped["no depth"] == (depth == 0).sum()
    assert lifted.camera is source


def test_generated_depth_keeps_its_edges_with_little_confidence():
    source = camera(width=40, height=30, focal=35)
    depth = np.full((30, 40), 4, np.float32)
    depth[10:20, 10:30] = 2
    rgb = _numbered(depth.shape)
    measured = back_project(rgb, depth, source)
    made = back_project(rgb, depth, source, generated=True)
    assert measured.dropped["depth edge"] > 0
    assert (len(made), made.dropped["depth edge"]) == (depth.size, 0)
    at_edge = ~_kept(measured, depth.shape)[made.colors[:, 0], made.colors[:, 1]]
    assert made.confidence[at_edge].max() < made.confidence[~at_edge].min() / 5
    np.testing.assert_array_equal(made.confidence[~at_edge], measured.confidence)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.5, 0, 1), (0.3, -0.6, 1), (0.9, 0.4, 1)])
def test_a_slanted_plane_is_kept_whole_with_its_cosine_and_spacing(normal):
    source = camera(width=120, height=90, focal=100)
    n = np.asarray(normal) / np.linalg.norm(normal)
    depth = _plane_depth(source, n, 3.0)
    assert depth.min() > 0
    lifted = back_project(_numbered(depth.shape), depth, source)
    assert len(lifted) == depth.size
    assert sum(lifted.dropped.values()) == 0
    rays = source.rays().reshape(-1, 3)
    cosine = rays @ n / np.linalg.norm(rays, axis=1)
    np.testing.assert_allclose(lifted.confidence, cosine, rtol=2e-3)
    np.testing.assert_allclose(lifted.spacing, depth.ravel() / 100, rtol=1e-6)
    np.testing.assert_allclose(lifted.positions.astype(float) @ n, 3.0, rtol=1e-6)


def test_a_step_loses_the_pixels_beside_it_and_no_others():
    source = camera(width=60, height=40, focal=50)
    depth = np.full((40, 60), 2, np.float32)
    depth[:, 30:] = 2.4
    lifted = back_project(_numbered(depth.shape), depth, source)
    kept = _kept(lifted, depth.shape)
    np.testing.assert_array_equal(kept[:, [29, 30]], False)
    kept[:, [29, 30]] = True
    assert kept.all()
    assert lifted.dropped["depth edge"] == 80
    # A step below the tolerance is surface.
    depth[:, 30:] = 2.08
    assert len(back_project(_numbered(depth.shape), depth, source)) == depth.size


def test_grazing_surfaces_are_dropped():
    source = camera(width=60, height=40, focal=50)
    depth = _plane_depth(source, np.array((0, 0.8, 0.6)), 1.0)
    rays = source.rays()
    cosine = (rays @ (0, 0.8, 0.6)) / np.linalg.norm(rays, axis=-1)
    for grazing in (0.3, 0.5):
        options = BackProjectionOptions(edge=1, grazing=grazing)
        lifted = back_project(_numbered(depth.shape), depth, source, options=options)
        expected = (cosine >= grazing).sum()
        assert 0 < expected < depth.size
        assert abs(len(lifted) - expected) <= 2


def test_masks_confidence_and_the_farthest_depth_choose_pixels():
    rng = np.random.default_rng(0)
    source = camera(width=40, height=30, focal=30)
    depth = np.full((30, 40), 3, np.float32)
    depth[:, 20:] = 3.05
    depth[0, :5] = (np.nan, np.inf, -1, 0, -np.inf)
    mask = rng.random((30, 40)) < 0.7
    trust = rng.uniform(-0.5, 2, (30, 40)).astype(np.float32)
    lifted = back_project(
        _numbered((30, 40)), depth, source, mask=mask, confidence=trust,
        options=BackProjectionOptions(edge=1e9, grazing=0, depth_max=3.02),
    )  # fmt: skip
    usable = np.isfinite(depth) & (depth > 0) & (depth <= 3.02)
    expected = usable & mask & (trust > 0)
    rows, cols = lifted.colors[:, 0].astype(int), lifted.colors[:, 1].astype(int)
    np.testing.assert_array_equal(_kept(lifted, (30, 40))[1:], expected[1:])
    assert lifted.dropped["masked"] == (usable & ~mask).sum()
    middle = (rows > 1) & (cols < 19)
    rays = source.rays()[rows, cols]
    cosine = 1 / np.linalg.norm(rays, axis=1)
    np.testing.assert_allclose(
        lifted.confidence[middle], (trust[rows, cols] * cosine)[middle], rtol=1e-4
    )


def test_the_free_space_grid_is_the_nearest_depth_of_whole_cells():
    rng = np.random.default_rng(1)
    source = camera(width=42, height=30, focal=30)
    depth = rng.uniform(1, 6, (30, 42)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.02] = 0
    mask = rng.random(depth.shape) < 0.99
    trust = (rng.random(depth.shape) < 0.99).astype(np.float32)
    lifted = back_project(
        _numbered(depth.shape), depth, source, mask=mask, confidence=trust,
        options=BackProjectionOptions(depth_max=3.0),
    )  # fmt: skip
    expected = np.zeros((8, 11), np.float32)
    for i in range(8):
        for j in range(11):
            cell = np.s_[i * FREE_CELL : (i + 1) * FREE_CELL, j * FREE_CELL : (j + 1) * FREE_CELL]
            if (depth[cell] > 0).all() and mask[cell].all() and (trust[cell] > 0).all():
                expected[i, j] = min(depth[cell].min(), 3.0)
    assert 0.3 < (expected > 0).mean() < 1
    np.testing.assert_array_equal(lifted.free_depth, expected)


def test_images_of_another_size_are_refused_with_both_sizes():
    source = camera(width=40, height=30)
    depth = np.ones((30, 40), np.float32)
    rgb = _numbered((30, 40))
    with pytest.raises(ShapeError, match=r"rgb has shape \(30, 39, 3\).*\(30, 40, 3\)"):
        back_project(rgb[:, :39], depth, source)
    for name in ("depth", "confidence", "mask"):
        images: dict[str, Any] = {
            "depth": depth,
            name: depth[:29] > 0 if name == "mask" else depth[:29],
        }
        with pytest.raises(ShapeError, match=f"{name} has shape"):
            back_project(rgb, camera=source, **images)


def pinhole(width: int, height: int) -> Cameras:
    return camera(width=width, height=height, focal=FOCAL)


def blocks(width: float, footprints: float = 0.0) -> dict[str, Any]:
    """Blocks as wide as a voxel's edge."""
    return {"levels": VoxelLevels(width, footprints), "pixel_binning": 1.0}


def wall(width: int, height: int, z: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(width)
    rgb = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    return rgb, np.full((height, width), z, np.float32)


def test_a_binned_point_is_the_mean_of_its_four_pixels():
    rgb, depth = wall(8, 6, NEAR)
    every = back_project(rgb, depth, pinhole(8, 6))
    binned = back_project(rgb, depth, pinhole(8, 6), **blocks(2 * NEAR / FOCAL))
    assert len(every) == 48 and len(binned) == 12
    shape = (3, 2, 4, 2)
    for name in ("positions", "colors", "confidence", "spacing"):
        values = getattr(every, name).astype(np.float64)
        mean = values.reshape(*shape, -1).mean((1, 3)).reshape(12, -1)
        tolerance = 0.5 if name == "colors" else 1e-6
        found = getattr(binned, name).reshape(12, -1)
        np.testing.assert_allclose(found, mean, atol=tolerance)
    assert binned.dropped == every.dropped
    np.testing.assert_array_equal(binned.free_depth, every.free_depth)


def test_far_blocks_are_binned_where_voxels_widen_with_them():
    rgb, depth = wall(16, 8, NEAR)
    depth[:, 8:] = FAR
    every = back_project(rgb, depth, pinhole(16, 8), options=STEEP)
    counts = [
        len(back_project(rgb, depth, pinhole(16, 8), options=STEEP, **blocks(*levels)))
        for levels in ((2 * NEAR / FOCAL, 0.0), (2 * NEAR / FOCAL, 2.0), (2 * NEAR / FOCAL, 1.0))
    ]
    # Far voxels of one footprint have no room for a block of two.
    assert counts == [len(every) * 5 // 8, len(every) // 4, len(every) * 5 // 8]


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 3), (5, 2), (7, 5)])
def test_what_is_not_whole_is_kept_pixel_by_pixel(width: int, height: int):
    rgb, depth = wall(width, height, NEAR)
    mask = np.ones(depth.shape, bool)
    mask[0, 0] = False
    lifted = len(back_project(rgb, depth, pinhole(width, height), mask=mask))
    binned = back_project(rgb, depth, pinhole(width, height), mask=mask, **blocks(1.0))
    # The corner's block is not whole, nor are those at an odd side's end.
    whole = max((width // 2) * (height // 2) - 1, 0)
    assert len(binned) == lifted - 3 * whole


def test_steep_surfaces_keep_their_points_and_nothing_is_binned_across_a_step():
    width, height, limit = 24, 16, 2.5 * NEAR / FOCAL
    x = (np.arange(width) + 0.5 - width / 2) / FOCAL
    rgb, _ = wall(width, height, NEAR)
    counts = []
    for slope in (0.5, 8.0):
        # The plane z = NEAR + slope x: pixels lie sqrt(1 + slope²) times as far apart along it.
        depth = np.tile((NEAR / (1 - slope * x)).astype(np.float32), (height, 1))
        depth[:, (depth[0] > 1.2) | (depth[0] < 0.8)] = 0
        every = back_project(rgb, depth, pinhole(width, height), options=STEEP)
        binned = back_project(rgb, depth, pinhole(width, height), options=STEEP, **blocks(limit))
        counts.append(len(binned) / len(every))
    assert counts[0] < 0.5 and counts[1] == 1
    _, step = wall(width, height, 2.0)
    step[:, 11:] = 2.6
    binned = back_project(
        rgb, step, pinhole(width, height), options=STEEP, **blocks(2.5 * 2.6 / FOCAL)
    )
    assert np.isin(binned.positions[:, 2], np.array([2.0, 2.6], np.float32)).all()
    assert len(binned) < width * height / 3


@pytest.mark.parametrize("confidence", [1e-45, 1.0, 3e38])
def test_any_confidence_is_kept(confidence):
    rgb, depth = wall(8, 6, NEAR)
    trust = np.full(depth.shape, confidence, np.float32)
    with np.errstate(all="raise"):
        binned = back_project(rgb, depth, pinhole(8, 6), confidence=trust, **blocks(1e300))
    assert len(binned) == 12 and np.isfinite(binned.confidence).all()
    assert (binned.confidence > 0).all()


CAMERA = Cameras.pinhole(96, 72, focal=60.0, name="a.png")
DISTANCE = 3.0


def sphere(face: Cameras) -> Guidance:
    """A face inside a sphere of smooth colours, whose lower cap (y > 0.5) is unknown."""
    rays = face.rays() @ face.cam_from_world[0, :3, :3]
    length = np.linalg.norm(rays, axis=-1)
    direction = rays / length[..., None]
    valid = direction[None, ..., 1] < 0.5
    rgb = np.where(valid[..., None], colors(direction)[None], 0).astype(np.float32)
    depth = np.where(valid, DISTANCE / length, 0).astype(np.float32)
    return Guidance(face, rgb, depth, valid, valid.astype(np.float32), direction[None, ..., 0] > 0)


def colors(direction: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * direction


@pytest.mark.parametrize(
    ("kind", "angle", "model"),
    [("equirectangular", 360, "EQUIRECTANGULAR"), ("fisheye", 170, "SIMPLE_FISHEYE")],
)
def test_pixels_show_the_directions_of_colmaps_lens(kind, angle, model):
    view = {"field_of_view": angle} if kind == "fisheye" else {}
    rig = Rig.of(LensOptions(kind=kind, width=240, **view), CAMERA, widest=0)
    width, height = rig.size
    assert height == (width // 2 if kind == "equirectangular" else width)
    focal = width / np.radians(angle)
    params = [width, height] if kind == "equirectangular" else [focal, width / 2, height / 2]
    lens = pycolmap.Camera(model=model, width=width, height=height, params=params)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.asarray(lens.cam_ray_from_img(np.stack([x, y], -1).reshape(-1, 2)))
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).reshape(height, width, 3)
    shown = rig.joined([sphere(face) for face in rig.cameras(CAMERA)], CAMERA)
    known = rig.inside & (rays[..., 1] < 0.45)
    assert shown.valid[0][known].all()
    assert not shown.valid[0][~rig.inside | (rays[..., 1] > 0.55)].any()
    # Across every seam and beside the hole: a step of a pixel is 0.013.
    np.testing.assert_allclose(shown.rgb[0][known], colors(rays)[known], atol=2e-3)
    np.testing.assert_allclose(shown.depth[0][known], DISTANCE, rtol=0.02)
    assert (shown.rgb[0][~shown.valid[0]] == 0).all()
    right = np.abs(rays[..., 0]) > 0.03
    np.testing.assert_array_equal(
        shown.generated[0][known & right], (rays[..., 0] > 0)[known & right]
    )


def test_a_fisheye_sees_behind_itself():
    rig = Rig.of(LensOptions(kind="fisheye", width=200, field_of_view=300), CAMERA, widest=0)
    shown = rig.joined([sphere(face) for face in rig.cameras(CAMERA)], CAMERA)
    angle = np.radians(99 / 200 * 300)
    np.testing.assert_allclose(
        shown.rgb[0, 100, 199], colors(np.array([np.sin(angle), 0, np.cos(angle)])), atol=0.01
    )
    assert abs(rig.inside.mean() - np.pi / 4) < 0.01


@pytest.mark.parametrize(
    "given", [{"width": 64}, {"kind": "equirectangular", "field_of_view": 90.0}]
)
def test_what_a_lens_does_not_heed_is_refused(given):
    with pytest.raises(OptionError, match="--lens"):
        LensOptions(**given)


def test_pictures_are_as_fine_as_the_cameras_within_a_limit():
    kinds = [LensOptions(kind="equirectangular"), LensOptions(kind="fisheye", field_of_view=90)]
    sizes = [Rig.of(options, CAMERA, widest=8192).size for options in kinds]
    assert sizes == [(376, 188), (92, 92)]
    assert Rig.of(kinds[0], CAMERA, widest=256).size == (256, 128)
    assert Rig.of(LensOptions(), CAMERA, widest=256) is None


@pytest.fixture
def leaning() -> Cameras:
    """Cameras that all look far down, held level to two degrees; one lies on its side."""
    rng = np.random.default_rng(3)
    yaw = np.linspace(-60, 60, 30)
    aim = np.stack([np.sin(np.radians(yaw)), np.cos(np.radians(yaw)), np.full(30, -0.7)], axis=1)
    world = look_at(np.zeros((30, 3)), aim, up=[0, 0, 1])
    roll = rng.normal(0, 2, 30)
    roll[7] = 90
    world[:, :3, :3] @= Rotation.from_euler("z", roll[:, None], degrees=True).as_matrix()
    return concatenate(
        [replace(CAMERA, cam_from_world=pose[None], names=(f"{number}@front.png",))
         for number, pose in enumerate(invert_rigid(world))]
    )  # fmt: skip


def test_panoramas_stand_upright_and_look_where_the_cameras_do(leaning):
    up = level_up(leaning)
    assert np.degrees(np.arccos(up[2])) < 1.5
    pictures = picture_cameras(leaning, LensOptions(kind="equirectangular"), captured=leaning)
    world = pictures.world_from_cam
    np.testing.assert_allclose(world[:, :3, 1], np.tile(-up, (30, 1)), atol=1e-12)
    apart = np.cross(world[:, :3, 2], leaning.world_from_cam[:, :3, 2]) @ up
    assert np.abs(np.degrees(np.arcsin(apart))).max() < 4
    assert pictures.names[:2] == ("0.png", "1.png")
    # A panorama's faces are one picture, which looks where its front does, wherever that is listed.
    faces = replace(leaning[:3], names=("a@back.png", "a@front.png", "a@left.png"))
    (picture,) = picture_cameras(faces, LensOptions(kind="equirectangular"), captured=leaning)
    assert picture.names == ("a.png",)
    np.testing.assert_array_equal(picture.cam_from_world[0], pictures.cam_from_world[1])
    # Straight down: the middle is what is above in the camera's picture.
    down = replace(
        CAMERA, cam_from_world=invert_rigid(look_at(np.zeros((1, 3)), -up, up=[0, 1, 0]))
    )
    level = picture_cameras(down, LensOptions(kind="equirectangular"), captured=leaning)
    assert level.world_from_cam[0, 1, 2] > 0.95


def test_a_fisheye_keeps_the_cameras_axes_and_faces_give_back_their_picture(leaning):
    options = LensOptions(kind="fisheye", width=64)
    (first, *_) = pictures = picture_cameras(leaning, options, captured=leaning)
    np.testing.assert_array_equal(pictures.cam_from_world, leaning.cam_from_world)
    rig = Rig.of(options, CAMERA, widest=64)
    (back,) = rig.pictures(rig.cameras(first))
    assert back.names == first.names == ("0.png",)
    np.testing.assert_allclose(back.cam_from_world, first.cam_from_world, atol=1e-12)
