"""Panoramas and fisheye pictures: directions as of COLMAP's lenses, holes, which way is up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, concatenate, invert_rigid
from gvtools.errors import OptionError
from gvtools.guidance import Guidance
from gvtools.memory.panoramas import LensOptions, Rig, picture_cameras
from gvtools.trajectories import level_up, look_at

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
