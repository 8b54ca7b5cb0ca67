"""Pictures of Gaussians in the memory's guidance, and as depth of photographs."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from skimage.filters import gaussian
from splat_scene import HEIGHT, WALL, WIDTH, K, photographs, pose, rough_gaussians, walk

from gvtools.appearance.appearance import (
    SHARES,
    TOLERANCES,
    Appearance,
    Blend,
    best_blend,
    blend_colors,
)
from gvtools.appearance.camera_corrections import Exposures
from gvtools.appearance.fit import Fit
from gvtools.appearance.fit_options import FitOptions
from gvtools.appearance.free_space import SHARE, UNKNOWN_SHARE, floaters, free_depth
from gvtools.appearance.gaussians import Gaussians
from gvtools.appearance.splat.project_kernels import LOG_SCALE, LOGIT, VALUES
from gvtools.appearance.splat.splat import Lens
from gvtools.cameras import Cameras
from gvtools.depth.shown import LEAST_CONFIDENCE, OPAQUE, FittedDepth
from gvtools.errors import MemoryFileError
from gvtools.guidance import Guidance
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.scenes.scene import Frame

SIZE = np.array([WIDTH]), np.array([HEIGHT])
CAMERA = Cameras(K[None], pose(0.1)[None], *SIZE, ("one",))


@pytest.fixture(scope="module")
def solid() -> Gaussians:
    """Nearly opaque Gaussians on the left of the picture."""
    some = rough_gaussians()
    some.values[:, LOGIT] = 4.0
    return Gaussians(some.values[some.values[:, 0] < 0.2])


@pytest.fixture(scope="module")
def guidance() -> Guidance:
    rng = np.random.default_rng(0)
    shape = (1, HEIGHT, WIDTH)
    valid = rng.uniform(size=shape) < 0.8
    return Guidance(
        CAMERA,
        rng.uniform(0, 1, (*shape, 3)).astype(np.float32) * valid[..., None],
        rng.uniform(1, 3, shape).astype(np.float32) * valid,
        valid,
        rng.uniform(0, 1, shape).astype(np.float32) * valid,
        valid & (rng.uniform(size=shape) < 0.3),
    )


def test_only_colours_of_surfaces_that_gaussians_show_change(solid, guidance):
    picture = Appearance(solid, 0.05).picture(CAMERA)
    where = guidance.valid[0] & (picture.alpha > 0.5)
    assert 0 < where.sum() < guidance.valid[0].sum()
    assert guidance.generated[0][where].any()
    result = Appearance(solid, 0.05, Blend(0.3, 0.5)).recolor(guidance, picture)
    for name in ("depth", "valid", "generated", "confidence"):
        np.testing.assert_array_equal(getattr(result, name), getattr(guidance, name))
    assert result.cameras is guidance.cameras
    np.testing.assert_array_equal(result.rgb[0][~where], guidance.rgb[0][~where])
    assert (result.rgb[0] != guidance.rgb[0]).any(axis=2)[where].mean() > 0.95
    expected = blend_colors(picture.rgb, guidance.rgb[0], where, blend=Blend(0.3, 0.5))
    # Generated content adds no detail.
    made = where & guidance.generated[0]
    expected[made] = picture.rgb[made]
    np.testing.assert_array_equal(result.rgb[0], expected)
    # Where random colours were behind the Gaussians it is mostly a photograph's.
    fitted = Appearance(solid, 0.05, Blend(0.3, 0.5), backdrop=True)
    half = blend_colors(picture.rgb, guidance.rgb[0], where, blend=Blend(0.15, 0.5))[made]
    np.testing.assert_allclose(fitted.recolor(guidance, picture).rgb[0][made], half, atol=1e-6)


def test_a_picture_does_not_depend_on_the_gaussians_frame(solid):
    plain = Appearance(solid, 0.05).picture(CAMERA)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    frame = LocalFrame.at([40.0, -7.0, 2.0], turn * np.sign(np.linalg.det(turn)))
    camera = Cameras(K[None], frame.cam_from_world(pose(0.1)[None]), *SIZE, ("one",))
    moved = Appearance(Gaussians(solid.values, frame=frame), 0.05).picture(camera)
    np.testing.assert_allclose(moved.rgb, plain.rgb, atol=1e-4)
    np.testing.assert_allclose(moved.alpha, plain.alpha, atol=1e-4)


def test_what_is_nearer_than_the_near_plane_is_not_drawn(solid):
    beyond = Appearance(solid, WALL + 1)
    picture = beyond.picture(CAMERA)
    assert not picture.alpha.any() and not picture.rgb.any() and not beyond.depth(CAMERA).any()
    assert not picture.solid.any()


def test_colours_are_over_black():
    veil = Gaussians.at([[0.0, 0, 2.0]], [[200, 100, 50]], sizes=[3.0])
    picture = Appearance(veil, 0.05).picture(CAMERA)
    assert picture.alpha.max() < 0.2
    seen = picture.alpha > 0.05
    assert seen.mean() > 0.9
    expected = picture.alpha[..., None] * np.array([200, 100, 50]) / 255
    np.testing.assert_allclose(picture.rgb[seen], expected[seen], atol=1e-4)
    # Not where random colours were behind them in the fit: what stops half of the light or more
    # has its own colour then.
    fitted = Appearance(veil, 0.05, backdrop=True).picture(CAMERA)
    np.testing.assert_allclose(fitted.rgb[seen], 2 * expected[seen], atol=1e-4)
    dense = Gaussians(veil.values.copy(), frame=veil.frame)
    dense.values[:, LOGIT] = 1.5
    thick = Appearance(dense, 0.05, backdrop=True).picture(CAMERA)
    middle = thick.solid
    assert middle.any() and thick.alpha[middle].max() < 0.9
    colors = np.broadcast_to(np.array([200, 100, 50]) / 255, thick.rgb.shape)
    np.testing.assert_allclose(thick.rgb[middle], colors[middle], atol=1e-4)


def test_fitted_depth_is_what_opaque_gaussians_show_trusted_by_the_look(solid):
    appearance = Appearance(solid, 0.05)
    shown = appearance.picture(CAMERA)
    rgb = np.rint(shown.rgb * 255).astype(np.uint8)
    rgb[:, :10] = 255 - rgb[:, :10] // 2
    source = FittedDepth(appearance)

    view: Any = SimpleNamespace(camera=CAMERA)
    scene: Any = None
    found = source.depth(scene, view, Frame(rgb, None, None))
    assert found.depth.dtype == found.confidence.dtype == np.float32
    opaque = shown.alpha > OPAQUE
    assert 0.1 < opaque.mean() < 0.9
    np.testing.assert_array_equal(found.depth[opaque], appearance.depth(CAMERA)[opaque])
    assert not found.depth[~opaque].any()
    assert source.covers(view) and found.source == source.name == "fitted"
    assert found.confidence[:, 10:].min() > 0.99
    off = np.abs(shown.rgb - rgb / np.float32(255)).mean(axis=2)[:, :10]
    expected = np.maximum(np.exp(-np.square(off / 0.12)), LEAST_CONFIDENCE)
    np.testing.assert_allclose(found.confidence[:, :10], expected, rtol=1e-5)
    assert found.confidence[:, :10].min() == np.float32(LEAST_CONFIDENCE)


SHAPE = (int(CAMERA.height[0]), int(CAMERA.width[0]))


class _Maps:
    """Depth maps of views, by name."""

    def __init__(self, maps):
        self.maps = maps

    def covers(self, view):
        return view.name in self.maps

    def depth(self, view):
        # Half of the size of what is asked, as a sweep in little time.
        shape = SHAPE if view.name == "one" else (SHAPE[0] // 2, SHAPE[1] // 2)
        return np.full(shape, self.maps[view.name], np.float32)


@pytest.mark.parametrize(
    ("maps", "confidence"),
    [
        ({}, 0.35),
        ({"one": WALL}, 0.82),
        ({"one": 1.5 * WALL}, 0.25),
        ({"one": WALL, "two": WALL, "three": WALL}, 0.93),
        ({"two": WALL, "three": 1.5 * WALL}, 0.82),
    ],
)
def test_confidence_is_by_the_depth_maps_that_agree(solid, maps, confidence):
    rgb = np.zeros((*SHAPE, 3), np.uint8)
    views: Any = [SimpleNamespace(name=name, camera=CAMERA, load=lambda: Frame(rgb, None, None))
             for name in ("one", "two", "three")]  # fmt: skip
    cameras = Cameras(
        np.repeat(CAMERA.K, 3, axis=0), np.repeat(CAMERA.cam_from_world, 3, axis=0),
        np.repeat(CAMERA.width, 3), np.repeat(CAMERA.height, 3), ("one", "two", "three"),
    )  # fmt: skip
    scene: Any = SimpleNamespace(
        views=views,
        subset=lambda names: SimpleNamespace(
            cameras=cameras[[cameras.names.index(name) for name in names]]
        ),
    )
    appearance = Appearance(solid, 0.05)
    found = FittedDepth(appearance, _Maps(maps)).depth(scene, views[0], views[0].load())
    plain = appearance.depth(CAMERA)
    middle = np.abs(plain / WALL - 1) < 0.01
    middle &= appearance.picture(CAMERA).alpha > OPAQUE
    assert middle.mean() > 0.05
    known = found.confidence[middle]
    assert np.isclose(known, confidence, atol=1e-4).mean() > 0.6
    np.testing.assert_allclose(found.depth[middle], WALL, rtol=0.011)


@pytest.fixture(scope="module")
def truth():
    rng = np.random.default_rng(0)
    smooth = gaussian(rng.uniform(0, 1, (40, 50, 3)), 4, channel_axis=2)
    fine = 0.1 * rng.standard_normal((40, 50, 3))
    return np.clip(0.5 + 3 * (smooth - 0.5) + fine, 0.05, 0.95).astype(np.float32)


@pytest.fixture(scope="module")
def where():
    return np.random.default_rng(1).uniform(size=(40, 50)) < 0.9


def soft(picture):
    return gaussian(picture, 2, channel_axis=2).astype(np.float32)


def score(shown, memory, where, truth, blend):
    off = (blend_colors(shown, memory, where, blend=blend) - truth)[where]
    return -10 * np.log10(np.square(off).mean())


def test_the_best_blend_is_that_of_the_best_mean_psnr(truth, where):
    rng = np.random.default_rng(2)
    noisy = np.clip(truth + 0.1 * rng.standard_normal(truth.shape), 0, 1).astype(np.float32)
    half = np.where(rng.uniform(size=(40, 50, 1)) < 0.5, noisy, soft(truth)).astype(np.float32)
    samples = [(soft(truth), noisy, where, truth), (noisy, half, where, truth)]
    samples.append((truth, truth, np.zeros((40, 50), bool), truth))
    found = best_blend(samples)
    scores = {
        (share, tolerance): sum(score(*sample, Blend(share, tolerance)) for sample in samples[:2])
        for share in SHARES
        for tolerance in TOLERANCES
    }
    assert scores[found.share, found.tolerance] == pytest.approx(max(scores.values()), abs=1e-3)


def test_without_pixels_that_both_know_the_default_stays(truth):
    assert best_blend([]) is None
    assert best_blend([(truth, truth, np.zeros((40, 50), bool), truth)]) is None


@pytest.mark.parametrize("blend", [Blend(), Blend(1.0, 4.0), Blend(0.0, 0.05), Blend(0.65, 0.1)])
def test_a_blend_lies_between_the_two_and_is_the_memorys_elsewhere(truth, where, blend):
    shown, memory = soft(truth), np.random.default_rng(3).uniform(0, 1, truth.shape)
    memory = memory.astype(np.float32)
    result = blend_colors(shown, memory, where, blend=blend)
    assert result.dtype == np.float32
    np.testing.assert_array_equal(result[~where], memory[~where])
    least, most = np.minimum(shown, memory), np.maximum(shown, memory)
    assert (result >= least - 1e-6).all()
    assert (result <= most + 1e-6).all()


def test_what_only_one_knows_does_not_count(truth, where):
    shown, memory = soft(truth), truth.copy()
    other = memory.copy()
    other[~where] = 0
    first = blend_colors(shown, memory, where, blend=Blend())
    second = blend_colors(shown, other, where, blend=Blend())
    np.testing.assert_array_equal(first[where], second[where])


def lens_at(cam_from_world, near=0.01):
    return Lens.of(cam_from_world, K, size=(WIDTH, HEIGHT), near=near)


def free_of(surface, lens):
    free = free_depth(surface, lens)
    assert free is not None
    return free


def point(x, y, z):
    """(3,) seen at a place in the picture [px] of a camera at the origin."""
    return np.array([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z])


def test_free_space_ends_before_the_nearest_of_the_surfaces_in_a_part_of_the_picture():
    spots = ((0.25 * WIDTH, 2.0), (0.25 * WIDTH, 3.0), (0.75 * WIDTH, 5.0))
    surface = np.array([point(x, HEIGHT / 2, z) for x, z in spots], np.float32)
    free = free_of(surface, lens_at(np.eye(4)))
    rows, columns = free.shape
    assert free[rows // 2, columns // 4] == pytest.approx(SHARE * 2)
    assert free[rows // 2, 3 * columns // 4] == pytest.approx(SHARE * 5)
    # No surface is known in the corners.
    assert free[0, 0] == pytest.approx(UNKNOWN_SHARE * 2)
    assert free[0, -1] == pytest.approx(UNKNOWN_SHARE * 5)


def test_without_a_surface_in_the_picture_nothing_is_free():
    assert free_depth(np.array([[0, 0, -2.0]], np.float32), lens_at(np.eye(4))) is None
    assert free_depth(np.zeros((0, 3), np.float32), lens_at(np.eye(4))) is None


def test_floaters_are_before_the_surface_and_not_behind_the_camera_or_it():
    surface = np.array([point(WIDTH / 2, HEIGHT / 2, 2.0)], np.float32)
    lens = lens_at(np.eye(4))
    values = np.zeros((4, VALUES), np.float32)
    # Before it, on it, behind the camera, and beside the picture, where its border holds.
    values[:, :LOG_SCALE] = [
        point(WIDTH / 2, HEIGHT / 2, 1.0), point(WIDTH / 2, HEIGHT / 2, 1.9),
        [0, 0, -1], point(2 * WIDTH, HEIGHT / 2, 0.5),
    ]  # fmt: skip
    found = floaters(values, lens, free_of(surface, lens))
    assert found.tolist() == [True, False, False, True]
    rows = np.array([3, 1])
    assert floaters(values, lens, free_of(surface, lens), rows=rows).tolist() == [True, False]


def fog(count=40):
    """Opaque Gaussians just before the cameras of the walk."""
    rng = np.random.default_rng(0)
    eye = -pose(0.0)[:3, :3].T @ pose(0.0)[:3, 3]
    ahead = pose(0.0)[2, :3]
    places = eye + 0.3 * ahead + rng.normal(0, 0.05, (count, 3))
    out = Gaussians.at(places, np.full((count, 3), 90), sizes=np.full(count, 0.05))
    out.values[:, LOGIT] = 2.0
    return out


def test_a_fit_clears_free_space_and_a_picture_does_not_show_it():
    start = rough_gaussians()
    surface = start.values[:, :LOG_SCALE].copy()
    both = Gaussians(np.concatenate([start.values, fog().values]), frame=start.frame)
    kept = {}
    for name, known in (("all", None), ("free", surface)):
        fit = Fit(both, photographs(walk(5)), options=FitOptions(steps=40), surface=known)
        fit.run()
        lens = lens_at(pose(0.0))
        found = fit.gaussians.values
        floating = floaters(found, lens, free_of(surface, lens))
        kept[name] = (1 / (1 + np.exp(-found[floating, LOGIT]))).sum()
    assert kept["free"] < 0.1 * kept["all"]
    camera = Cameras(K[None], pose(0.0)[None], np.array([WIDTH]), np.array([HEIGHT]), ("a",))
    shown = Appearance(both, 0.01, surface=surface)
    truth = Appearance(start, 0.01).picture(camera)
    assert np.abs(shown.picture(camera).rgb - truth.rgb).max() < 0.02
    clouded = replace(shown, surface=None)
    assert np.abs(clouded.picture(camera).rgb - shown.picture(camera).rgb).mean() > 0.05
    depths = [one.depth(camera) for one in (clouded, shown)]
    near = [int(((depth > 0) & (depth < 1)).sum()) for depth in depths]
    assert near[0] > 100 and near[1] == 0


def test_surfaces_and_exposures_come_back_from_the_file(tmp_path):
    surface = np.array([[1, 2, 3]], np.float32)
    exposures = Exposures(np.stack([pose(0.0), pose(0.05)]), np.full((2, 3), [-0.2, 0.1, 0]), 2.0)
    kept = Appearance(fog(), 0.1, surface=surface, exposures=exposures)

    def again(**changed):
        arrays = {**kept.arrays(), **changed}
        np.savez(
            tmp_path / "a.npz", **{n: array for n, array in arrays.items() if array is not None}
        )
        return Appearance.load(tmp_path / "a.npz")

    np.testing.assert_array_equal(again().surface, surface)
    np.testing.assert_array_equal(again().picture(CAMERA).rgb, kept.picture(CAMERA).rgb)
    # Earlier versions knew none.
    assert again(surface=None).surface is None
    with pytest.raises(MemoryFileError, match="log_gains"):
        again(log_gains=np.zeros((1, 3)))
