from __future__ import annotations

import math

import geoverse_models as micro
import numpy as np
import pytest
import torch

from gvtools.completers.base import ScaleStatus
from gvtools.completers.geoverse.depth_scale import (
    MAX_FIELD,
    PassScale,
    ScaledDepth,
    centre_scale,
    pass_scale,
    scale_depth,
)
from gvtools.completers.geoverse.views import resample_depth
from gvtools.networks.depth_anything.geometry_head import ViewGeometry

ALIGNMENTS = ("centres", "hint", "field")
pytestmark = pytest.mark.usefixtures("one_thread")

SIZE = (30, 40)


def geometry(origins: np.ndarray, *, seed: int = 0, noise: float = 0.0) -> ViewGeometry:
    """Rays that start at (V, 3) origins, noisy where they are not confident."""
    generator = torch.Generator().manual_seed(seed)
    views = len(origins)
    ray = torch.randn(1, views, 4, 5, 6, generator=generator)
    ray[..., 3:] *= noise
    ray[..., 3:] += torch.from_numpy(origins).float()[None, :, None, None]
    certain = 1 + torch.rand(1, views, 4, 5, generator=generator)
    depth = torch.ones(1, views, 8, 10)
    return ViewGeometry(depth, depth + 1, ray, certain)


def poses(count: int) -> np.ndarray:
    return micro.cameras(count, seed=7).world_from_cam


def model_centres(world_from_cam: np.ndarray, scale: float) -> np.ndarray:
    """The centres in another unit and the first view's frame."""
    relative = np.linalg.inv(world_from_cam[0]) @ world_from_cam
    return relative[:, :3, 3] / scale


@pytest.mark.parametrize("views", [4, 6])
@pytest.mark.parametrize("scale", [1e-3, 0.4, 2500.0])
def test_the_scale_between_centres_is_found(views, scale):
    known = poses(views)
    found = centre_scale(geometry(model_centres(known, scale)), known)
    assert found.status is ScaleStatus.CAMERA_CENTRES and found.centres == views
    assert found.scale == pytest.approx(scale, rel=1e-5)
    assert found.correlation == pytest.approx(1)
    known[:, :3, 3] += [1e6, -2e6, 5e5]
    far = centre_scale(geometry(model_centres(poses(views), scale)), known)
    assert far.scale == pytest.approx(scale, rel=1e-5)


def test_a_centre_is_the_mean_of_its_rays_by_their_confidence():
    known = poses(4)
    made = geometry(model_centres(known, 2.0), noise=0.01)
    found = centre_scale(made, known)
    assert found.scale == pytest.approx(2.0, rel=0.02)
    worse = made.ray.clone()
    worse[:, 1, 0, 0, 3:] = 100.0
    made.ray_confidence[:, 1, 0, 0] = 0.0
    again = centre_scale(ViewGeometry(made.depth, made.depth, worse, made.ray_confidence), known)
    assert again.scale == pytest.approx(found.scale, rel=0.02)


def refused() -> dict[str, tuple[ViewGeometry, np.ndarray]]:
    rng = np.random.default_rng(0)
    known = poses(4)
    centres = model_centres(known, 2.0)
    nan = geometry(centres)
    nan.ray[:, 1:, 0, 0, 4] = math.nan
    blind = geometry(centres)
    blind.ray_confidence[:, 2] = math.nan
    empty = geometry(centres)
    empty.ray_confidence[:, 2] = 0
    rounding = np.full((4, 3), 0.3) + 1e-8 * rng.normal(size=(4, 3))
    one_place = known.copy()
    one_place[:, :3, 3] = [3.0, 1.0, 4.0]
    return {
        "unrelated": (geometry(rng.normal(size=(8, 3))), poses(8)),
        "nan rays": (nan, known),
        "nan confidence": (blind, known),
        "no confidence": (empty, known),
        "same predicted": (geometry(np.full((4, 3), 0.3)), known),
        "two that differ by rounding": (geometry(rounding[:2]), known[:2]),
        "rounding": (geometry(rounding), known),
        "same requested": (geometry(centres), one_place),
        "one view": (geometry(centres[:1]), known[:1]),
        "three views": (geometry(centres[:3]), known[:3]),
    }


@pytest.mark.parametrize("what", list(refused()))
def test_centres_that_support_no_scale_are_refused(what):
    found = centre_scale(*refused()[what])
    assert math.isnan(found.scale) and found.status is ScaleStatus.UNSUPPORTED
    assert found.centres == {"three views": 3}.get(what, found.centres)


METHODS = {
    "centres": ScaleStatus.CAMERA_CENTRES,
    "hint": ScaleStatus.MEMORY_DEPTH,
    "field": ScaleStatus.MEMORY_FIELD,
}


def statuses(found: ScaledDepth) -> list[ScaleStatus]:
    return [alignment.status for alignment in found.alignment]


def scene(
    views: int = 2, *, scale: float = 3.0, seed: int = 0
) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
    """The model's depth, the memory's as ``scale`` times it, and where it is known."""
    rng = np.random.default_rng(seed)
    made = rng.uniform(0.8, 1.2, (views, *SIZE)).astype(np.float32)
    valid = rng.random((views, *SIZE)) < 0.4
    return torch.from_numpy(made), (made * np.float32(scale)), valid


@pytest.mark.parametrize("alignment", ALIGNMENTS)
@pytest.mark.parametrize("scale", [0.002, 3.0, 4000.0])
def test_all_alignments_agree_where_everything_fits(alignment, scale):
    made, truth, valid = scene(scale=scale)
    hint = np.where(valid, truth, 0)
    found = scale_depth(made, hint, valid, whole=PassScale(scale), alignment=alignment)
    np.testing.assert_allclose(found.depth, truth, rtol=1e-4)
    np.testing.assert_allclose(found.scale, scale, rtol=1e-4)
    assert statuses(found) == [METHODS[alignment]] * 2
    for outcome, where in zip(found.alignment, valid, strict=True):
        assert outcome.overlap_px == where.sum() and outcome.scale == 1
        assert outcome.residual < 1e-4 and outcome.inlier_share == pytest.approx(1)
    assert found.depth.dtype == np.float32


def test_each_alignment_uses_its_own_evidence():
    made, truth, valid = scene(scale=3.0)
    truth[1] *= 1.2
    hint = np.where(valid, truth, 0)
    found = {
        name: scale_depth(made, hint, valid, whole=PassScale(3.3), alignment=name)
        for name in ALIGNMENTS
    }
    np.testing.assert_allclose(found["centres"].scale, [3.3, 3.3])
    np.testing.assert_allclose(found["hint"].scale, [3, 3.6], rtol=1e-4)
    np.testing.assert_allclose(found["field"].scale, [3, 3.6], rtol=1e-4)
    np.testing.assert_allclose(found["centres"].depth, 3.3 * made.numpy(), rtol=1e-6)


@pytest.mark.parametrize("views", [2, 3, 4])
def test_the_papers_scale_is_s_star_whatever_is_known(views):
    known = poses(views)
    made = geometry(model_centres(known, 2.0))
    deep = np.full((1, 8, 10), 30.0, np.float32)
    whole = pass_scale(made, known, np.tile(deep, (1, 4, 4)), alignment="centres-alone")
    assert whole.scale == pytest.approx(2) and whole.status is ScaleStatus.CAMERA_CENTRES
    depth, truth, valid = scene(scale=9.0)
    hint = np.where(valid, truth, 0)
    found = scale_depth(depth, hint, valid, whole=whole, alignment="centres-alone")
    np.testing.assert_allclose(found.depth, 2 * depth.numpy(), rtol=1e-5)
    assert statuses(found) == [ScaleStatus.CAMERA_CENTRES] * 2
    other = scale_depth(depth, hint, valid, whole=whole, alignment="centres")
    assert statuses(other) == [ScaleStatus.MEMORY_DEPTH] * 2
    one = pass_scale(geometry(np.zeros((1, 3))), poses(1), deep, alignment="centres-alone")
    assert one.status is ScaleStatus.UNSUPPORTED


def test_a_field_follows_the_memory_and_stays_within_its_limit():
    made, truth, valid = scene(views=1)
    x = np.linspace(0, 1, SIZE[1])
    bent = truth * np.exp(0.3 * (x - 0.5)).astype(np.float32)
    bent[0, 3, 3] *= 10  # another surface, no error of scale
    valid[0, 3, 3] = True
    hint = np.where(valid, bent, 0)
    found = scale_depth(made, hint, valid, whole=PassScale(math.nan), alignment="field")
    rest = valid.copy()
    rest[0, 3, 3] = False
    np.testing.assert_allclose(found.depth[rest], hint[rest], rtol=1e-4)
    ratio = found.depth[0] / (found.scale[0] * made[0].numpy())
    assert ratio[3, 3] == pytest.approx(MAX_FIELD, rel=1e-4)
    # Holes have what stands around them.
    calm = np.ones(SIZE, bool)
    calm[:12, :12] = False
    assert np.abs(found.depth / bent - 1)[0][calm].max() < 0.1
    plain = scale_depth(made, hint, valid, whole=PassScale(math.nan), alignment="hint")
    assert np.abs(plain.depth / bent - 1)[0][calm].max() > 0.12


def test_without_support_the_next_one_is_asked_and_at_last_none():
    made, truth, valid = scene(views=3)
    valid[1] = False  # nothing known
    valid[2].flat[50:] = False  # hardly anything
    hint = np.where(valid, truth, 0)
    nan = math.nan
    for alignment, centres, methods in (
        ("hint", 3.6, ("hint", "centres", "centres")),
        ("field", 3.6, ("field", "centres", "centres")),
        ("centres", nan, ("hint", "none", "none")),
        ("hint", nan, ("hint", "none", "none")),
        ("field", nan, ("field", "none", "none")),
    ):
        found = scale_depth(made, hint, valid, whole=PassScale(centres), alignment=alignment)
        wanted = [METHODS.get(method, ScaleStatus.UNSUPPORTED) for method in methods]
        assert statuses(found) == wanted
        for view, method in enumerate(methods):
            expected = {"none": nan, "centres": centres}.get(method, 3.0)
            assert found.scale[view] == pytest.approx(expected, rel=1e-4, nan_ok=True)
            assert bool(found.depth[view].any()) is (method != "none")


def test_a_scale_that_contradicts_the_memory_is_not_taken():
    made, truth, valid = scene(views=2, scale=3.0)
    hint = np.where(valid, truth, 0)
    # The centres are off by thirty: the memory is asked instead, and a view that knows nothing is
    # not given a scale that its sibling refutes.
    blind = valid.copy()
    blind[1] = False
    found = scale_depth(made, hint, blind, whole=PassScale(90.0), alignment="centres")
    assert statuses(found) == [ScaleStatus.MEMORY_DEPTH, ScaleStatus.CONTRADICTED]
    found = scale_depth(made, hint, valid, whole=PassScale(90.0), alignment="centres")
    assert statuses(found) == [ScaleStatus.MEMORY_DEPTH] * 2
    np.testing.assert_allclose(found.scale, [3, 3], rtol=1e-4)
    # Depth without any relation to the memory is left out, whatever the centres say.
    noise = np.random.default_rng(3).uniform(0.01, 10, truth.shape).astype(np.float32)
    for centres in (3.0, 90.0):
        found = scale_depth(made, noise, valid, whole=PassScale(centres), alignment="field")
        assert statuses(found) == [ScaleStatus.CONTRADICTED] * 2 and not found.depth.any()
    # Where the memory knows too little to tell, the centres stand.
    valid[:] = False
    found = scale_depth(made, hint, valid, whole=PassScale(90.0), alignment="centres")
    assert statuses(found) == [ScaleStatus.CAMERA_CENTRES] * 2


@pytest.mark.parametrize("alignment", ALIGNMENTS)
def test_damaged_depth_does_no_harm_around_it(alignment):
    made, truth, valid = scene(views=1)
    hint = np.where(valid, truth, math.nan)
    valid[0, 9, 9] = True
    hint[0, 9, 9] = math.inf
    damaged = made.clone()
    damaged[0, :4, :4] = math.nan
    damaged[0, 5, 5] = math.inf
    found = scale_depth(damaged, hint, valid, whole=PassScale(3.0), alignment=alignment)
    assert not found.depth[0, :4, :4].any() and found.depth[0, 5, 5] == 0
    intact = np.isfinite(damaged[0].numpy())
    intact[8:11, 8:11] = False
    np.testing.assert_allclose(found.depth[0][intact], truth[0][intact], rtol=0.01)
    assert np.isfinite(found.depth).all()


@pytest.mark.parametrize("size", [(96, 128), (50, 61), (24, 32)])
def test_a_plane_stays_a_plane(size):
    """1 / z is linear over the picture; half a pixel of the small one is left out at the rim."""

    def plane(rows: int, columns: int) -> torch.Tensor:
        y = (torch.arange(rows).double() + 0.5) / rows
        x = (torch.arange(columns).double() + 0.5) / columns
        return 1 / (0.3 + 0.1 * x[None] + 0.2 * y[:, None])

    found = resample_depth(plane(24, 32)[None], size)[0]
    rim = max(1, -(-size[0] // 24))
    inner = np.s_[rim:-rim, rim:-rim]
    torch.testing.assert_close(found[inner], plane(*size)[inner], rtol=1e-9, atol=1e-9)


def test_one_scale_a_pass_stands_on_centres_and_on_the_context():
    known = poses(6)
    made = geometry(model_centres(known, 2.0))
    truth = np.random.default_rng(1).uniform(1, 3, (2, 40, 50)).astype(np.float32)
    fitting = torch.from_numpy(np.concatenate((truth, np.ones((4, 40, 50), np.float32))))[None]

    def of(depth: torch.Tensor, context: np.ndarray, cameras: np.ndarray = known) -> PassScale:
        ray, sure = made.ray[:, : len(cameras)], made.ray_confidence[:, : len(cameras)]
        return pass_scale(ViewGeometry(depth, depth + 1, ray, sure), cameras, context)

    agreed = of(fitting / 2.0, truth)
    assert agreed.status is ScaleStatus.CAMERA_CENTRES
    assert agreed.scale == pytest.approx(2.0, rel=1e-4)
    # The context's own depth is better evidence than the centres, and stands in for them.
    for cameras in (known, known[:2]):
        other = of(fitting / 50.0, truth, cameras)
        assert other.status is ScaleStatus.CONTEXT_DEPTH
        assert other.scale == pytest.approx(50.0, rel=1e-4)
    # A model that misses the depth of its own context is not believed.
    noise = torch.from_numpy(np.random.default_rng(2).uniform(0.01, 9, fitting.shape)).float()
    missed = of(noise, truth)
    assert missed.status is ScaleStatus.CONTRADICTED and math.isnan(missed.scale)
    # Without known depth the centres decide, if there are enough of them.
    nothing = np.zeros_like(truth)
    assert of(fitting, nothing).status is ScaleStatus.CAMERA_CENTRES
    few = of(fitting, nothing, known[:3])
    assert (few.status, few.centres) == (ScaleStatus.UNSUPPORTED, 3)
