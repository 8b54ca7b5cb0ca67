"""Cameras at the ends: lenses of a hundredth of a degree and of 170, UTM places, broken numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from extreme_scenes import SIZE, focal
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_scenes import camera, points

from gvtools.cameras import Cameras, check_usable, invert_rigid, rigid_transform
from gvtools.errors import ShapeError
from gvtools.memory.back_projection import back_project
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions

LENSES = (1e-2, 1.0, 60.0, 170.0, 179.9)

BACKENDS = ("cpu", "torch", "nearest", "open3d")


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    degrees=st.sampled_from(LENSES),
    power=st.integers(-6, 6),
    far=st.sampled_from([0.0, 1e3, 1e7]),
)
def test_rays_and_projection_are_inverse(seed, degrees, power, far):
    """To 1e-9 pixels beside the origin; far away, to what float64 leaves of a pixel there."""
    rng = np.random.default_rng(seed)
    scale = 10.0**power
    center = scale * rng.normal(0, 1, 3) + far * rng.uniform(-1, 1, 3)
    one = camera(**SIZE, focal=focal(degrees), center=center, rotation=rng.normal(0, 1, 3))
    z = scale * 10 ** rng.uniform(-2, 2, (SIZE["height"], SIZE["width"], 1))
    world = (z * one.rays()) @ one.world_from_cam[0, :3, :3].T + one.centers[0]
    xy, depth = one.project(world.reshape(-1, 3))
    rows, columns = np.mgrid[: SIZE["height"], : SIZE["width"]]
    expected = np.stack([columns.ravel(), rows.ravel()], 1) + 0.5
    step = np.spacing(max(far, np.abs(world).max()))
    sight = np.abs(one.rays()).max(-1).ravel()
    off = np.abs(xy[0] - expected).max(axis=1)
    tolerance = 1e-9 + 16 * focal(degrees) * sight * step / z.ravel()
    seen = depth[0] > 0
    assert (off[seen] <= tolerance[seen]).all()
    assert (np.abs(depth[0] - z.ravel()) <= 16 * step * sight + 1e-12 * z.ravel()).all()
    # Only a depth below the rounding of the place may fall behind the camera.
    assert (z.ravel()[~seen] <= 16 * step * sight[~seen]).all()


@pytest.mark.parametrize("degrees", LENSES)
@pytest.mark.parametrize("far", [0.0, 1e7])
def test_pluecker_rays_are_unit_and_pass_through_the_centre(degrees, far):
    center = np.array((far + 1, 2 - far, 0.3 * far + 3))
    one = camera(**SIZE, focal=focal(degrees), center=center, rotation=(0.3, -0.2, 0.1))
    ray = one.plucker()
    direction, moment = ray[..., :3], ray[..., 3:]
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, rtol=1e-14)
    np.testing.assert_allclose(
        moment, np.cross(center, direction), atol=1e-14 * (1 + np.abs(center).max())
    )
    # The spread of the rays is that of the lens.
    middle = direction[SIZE["height"] // 2]
    spread = np.arccos(np.clip(middle[0] @ middle[-1], -1, 1))
    inner = 2 * np.arctan((SIZE["width"] - 1) / 2 / focal(degrees))
    assert spread == pytest.approx(inner, rel=1e-2 if degrees > 179 or degrees < 0.1 else 2e-3)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), power=st.integers(-6, 7))
def test_inverting_twice_keeps_the_place(seed, power):
    rng = np.random.default_rng(seed)
    center = 10.0**power * rng.normal(0, 1, 3)
    pose = camera(center=center, rotation=rng.normal(0, 2, 3)).cam_from_world
    np.testing.assert_allclose(
        invert_rigid(invert_rigid(pose)), pose, rtol=0, atol=4e-15 * 10**power + 1e-15
    )
    rigid, defect = rigid_transform(pose[0], what="pose")
    assert defect < 1e-14
    np.testing.assert_array_equal(rigid[:3, 3], pose[0, :3, 3])


@pytest.mark.parametrize(
    ("name", "entry", "value", "said"),
    [
        ("K", (0, 0, 2), np.nan, "NaN or infinity"),
        ("K", (0, 0, 0), np.inf, "NaN or infinity"),
        ("cam_from_world", (0, 1, 3), np.nan, "NaN or infinity"),
        ("K", (0, 1, 1), 0, "expected positive ones"),
        ("K", (0, 0, 0), -60, "focal lengths -60 and 60 px"),
        ("height", 0, 0, "64 x 0 pixels"),
        ("width", 0, -3, "-3 x 48 pixels"),
    ],
)
def test_cameras_without_a_picture_are_refused_in_a_line(name, entry, value, said):
    """They gave an empty picture, or another library's error."""
    bad = replace(camera(**SIZE, focal=60), names=("cam7",))
    array = getattr(bad, name).copy()
    array[entry] = value
    bad = replace(bad, **{name: array})
    memory = SpatialMemory(0.1)
    memory.fuse(points([(0, 0, 2)]), round=0)
    depth = np.ones((max(0, int(bad.height[0])), max(0, int(bad.width[0]))), np.float32)
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    calls: list[Callable[[], object]] = [
        lambda: check_usable(bad),
        bad.rays,
        bad.plucker,
        lambda: back_project(rgb, depth, bad),
    ]
    for backend in BACKENDS:
        calls.append(partial(memory.project, bad, options=SplatOptions(backend=backend)))
    for call in calls:
        with pytest.raises(ShapeError, match=said) as caught:
            call()
        assert str(caught.value).startswith("cam7: ")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("backend", ["cpu", "torch", "nearest"])
@pytest.mark.parametrize("f", [1e-30, 1e-3, 1e6, 1e15, 1e30])
@pytest.mark.parametrize("aside", [0.0, 1e10, -1e30])
def test_absurd_lenses_give_finite_pictures(f, aside, backend):
    good = camera(**SIZE, focal=60)
    K = np.array([[[f, 0, 32.5 + aside], [0, f, 24.5], [0, 0, 1]]])
    absurd = Cameras(K, good.cam_from_world, good.width, good.height, good.names)
    memory = SpatialMemory(0.1)
    memory.fuse(points([(0, 0, 2), (0.3, 0.2, 4), (-0.1, 5, 3)], spacing=0.1), round=0)
    seen = memory.project(absurd, options=SplatOptions(backend=backend))
    for image in (seen.rgb, seen.depth, seen.confidence):
        assert np.isfinite(image).all()
    if aside == 0:
        # The point on the axis stays there whatever the focal length is.
        assert seen.valid[0, 24, 32]
        assert 2 - 1e-5 <= seen.depth[0, 24, 32] <= 2.2
    else:
        assert not seen.valid.any()
