from __future__ import annotations

import math

import geoverse_models as micro
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gvtools.cameras import Cameras, invert_rigid
from gvtools.completers.base import ScaleStatus
from gvtools.completers.geoverse.camera_encoding import (
    CENTRED,
    GLD_PIXEL_OFFSET,
    Projective,
    camera_condition,
    normalised_poses,
    plucker_map,
)
from gvtools.completers.geoverse.depth_scale import (
    MAX_FIELD,
    PassScale,
    ScaledDepth,
    centre_scale,
    pass_scale,
    scale_depth,
)
from gvtools.completers.geoverse.views import resample_depth
from gvtools.networks.compute import attend
from gvtools.networks.depth_anything.geometry_head import ViewGeometry


def rigid(count: int, *, seed: int = 0, reach: float = 1.0) -> torch.Tensor:
    """(count, 4, 4) random rigid poses, positions up to ``reach`` from the origin."""
    rng = np.random.default_rng(seed)
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    pose[:, :3, 3] = rng.uniform(-reach, reach, (count, 3))
    return torch.from_numpy(pose)


def cameras(
    batch: int = 2, views: int = 3, dtype: torch.dtype = torch.float64
) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses (batch, views, 4, 4) and intrinsics (batch, views, 3, 3) for 84 x 112 pixels."""
    pose = rigid(batch * views, seed=5).unflatten(0, (batch, views))
    rng = np.random.default_rng(6)
    K = np.tile(np.eye(3), (batch, views, 1, 1))
    K[..., 0, 0], K[..., 1, 1] = rng.uniform(70, 130, (2, batch, views))
    K[..., 0, 2], K[..., 1, 2] = 56 + rng.uniform(-5, 5, (2, batch, views))
    return pose.to(dtype), torch.from_numpy(K).to(dtype)


ALIGNMENTS = ("centres", "hint", "field")


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
    for found in (known, known[:2]):
        other = of(fitting / 50.0, truth, found)
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


ENCODED = (14, 28)


def test_rays_through_pixel_centres_are_those_of_the_cameras():
    pose, K = cameras()
    found = plucker_map(pose, K, ENCODED, pixel_offset=CENTRED)
    for b, view in np.ndindex(2, 3):
        world = invert_rigid(pose[b, view].numpy())
        numpy = Cameras.alike(K[b, view].numpy(), world, size=ENCODED[::-1])
        np.testing.assert_allclose(
            np.moveaxis(found[b, view].numpy(), 0, -1), numpy.plucker(), rtol=1e-9, atol=1e-9
        )


def test_the_published_offset_is_a_principal_point_one_pixel_to_the_right():
    pose, K = cameras()
    moved = K.clone()
    moved[..., 0, 2] += 1
    torch.testing.assert_close(
        plucker_map(pose, K, ENCODED, pixel_offset=GLD_PIXEL_OFFSET),
        plucker_map(pose, moved, ENCODED, pixel_offset=CENTRED),
    )


@pytest.mark.parametrize("reference", [-1, 0])
def test_poses_are_relative_and_the_farthest_component_is_one(reference):
    pose, _ = cameras()
    rebased, scale = normalised_poses(pose, reference=reference)
    torch.testing.assert_close(rebased[:, reference], torch.eye(4).double().expand(2, 4, 4))
    torch.testing.assert_close(
        rebased[..., :3, 3].abs().amax(dim=(1, 2)), torch.ones(2).double(), rtol=0, atol=1e-7
    )
    expected = torch.linalg.inv(pose[:, reference, None]) @ pose
    expected[..., :3, 3] *= scale[:, None, None]
    torch.testing.assert_close(rebased, expected)


def test_views_far_from_the_origin_keep_their_digits():
    pose, _ = cameras()
    far = pose.clone()
    far[..., :3, 3] += torch.tensor([4e5, 5.5e6, 1e2]).double()
    torch.testing.assert_close(
        normalised_poses(far)[0], normalised_poses(pose)[0], rtol=1e-7, atol=1e-7
    )
    near = far.float()
    near[..., :3, 3] = pose[..., :3, 3].float() + 512
    torch.testing.assert_close(
        normalised_poses(near)[0].double(), normalised_poses(pose)[0], rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("where", [0.0, 123.456])
def test_a_turning_camera_has_no_scale_to_blow_up(where, dtype):
    pose = rigid(4, reach=0.0)[None].to(dtype)
    pose[..., :3, 3] = where
    rebased, scale = normalised_poses(pose)
    assert scale.tolist() == [1.0]
    assert not rebased[..., :3, 3].any()
    K = cameras(1, 4, dtype)[1]
    assert camera_condition(pose, K, ENCODED, context=1).map.isfinite().all()


def test_the_condition_of_views():
    pose, K = cameras()
    condition = camera_condition(pose, K, ENCODED, context=2)
    rebased, scale = normalised_poses(pose)
    assert condition.map.shape == (2, 3, 7, *ENCODED) and condition.context == 2
    assert [view.unique().tolist() for view in condition.map[0, :, 0]] == [[0.0], [0.0], [1.0]]
    torch.testing.assert_close(
        condition.map[:, :, 1:], plucker_map(rebased, K, ENCODED, pixel_offset=GLD_PIXEL_OFFSET)
    )
    # Relative poses of what PRoPE gets are those of the map.
    between = condition.cam_from_world[:, 0] @ torch.linalg.inv(condition.cam_from_world[:, 2])
    expected = torch.linalg.inv(rebased[:, 0]) @ rebased[:, 2]
    torch.testing.assert_close(between, expected, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(condition.scale, scale)


@pytest.mark.parametrize(
    ("mode", "poses", "intrinsics"),
    [("new", False, False), ("old", False, True), ("old_train", True, False)],
)
def test_without_cameras_only_the_mask_and_what_the_mode_keeps_is_left(mode, poses, intrinsics):
    pose, K = cameras()
    given = camera_condition(pose, K, ENCODED, context=1)
    bare = given.unconditional(mode)
    torch.testing.assert_close(bare.map[:, :, 0], given.map[:, :, 0])
    assert not bare.map[:, :, 1:].any()
    kept = given.cam_from_world if poses else torch.eye(4).double().expand(2, 3, 4, 4)
    torch.testing.assert_close(bare.cam_from_world, kept)
    kept = given.K if intrinsics else torch.eye(3).double().expand(2, 3, 3, 3)
    torch.testing.assert_close(bare.K, kept)
    assert given.map[:, :, 1:].any()


PICTURE = (84, 112)
GRID = (3, 4)


def tokens(head_dim: int, *, batch=2, views=3, heads=2, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, heads, views * GRID[0] * GRID[1], head_dim)
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)


def lifted(pose, K, size=PICTURE):
    """K in shares of the image, and the 4x4 it becomes, element by element."""
    shares = torch.zeros_like(pose)
    shares[..., 0, 0], shares[..., 1, 1] = K[..., 0, 0] / size[1], K[..., 1, 1] / size[0]
    shares[..., 0, 2] = K[..., 0, 2] / size[1] - 0.5
    shares[..., 1, 2] = K[..., 1, 2] / size[0] - 0.5
    shares[..., 2, 2] = shares[..., 3, 3] = 1
    return shares


def dense(matrix: np.ndarray, y: int, x: int, head_dim: int, *, base: float = 100.0) -> np.ndarray:
    """The whole head_dim x head_dim transform of one token."""
    groups = head_dim // 8
    out = np.zeros((head_dim, head_dim))
    for group in range(groups):
        out[4 * group : 4 * group + 4, 4 * group : 4 * group + 4] = matrix
    start = head_dim // 2
    for position in (x, y):
        for i in range(groups):
            angle = position * base ** (-i / groups)
            a, b = start + i, start + groups + i
            out[a, a] = out[b, b] = np.cos(angle)
            out[a, b], out[b, a] = np.sin(angle), -np.sin(angle)
        start += head_dim // 4
    return out


@pytest.mark.parametrize("head_dim", [8, 24])
def test_every_token_is_transformed_as_the_definition_says(head_dim):
    pose, K = cameras()
    encoding = Projective(pose, K, PICTURE, grid=GRID, head_dim=head_dim)
    P = (lifted(pose, K) @ pose).numpy()
    x = tokens(head_dim)
    found = [f(x).numpy() for f in (encoding.query, encoding.key, encoding.value, encoding.output)]
    count = GRID[0] * GRID[1]
    for b, view, row, column in np.ndindex(2, 3, *GRID):
        token = view * count + row * GRID[1] + column
        inverse = np.linalg.inv(P[b, view])
        forward = [dense(m, row, column, head_dim) for m in (P[b, view].T, inverse, inverse)]
        # The result's rotation is the inverse of the others'.
        backward = dense(P[b, view], -row, -column, head_dim)
        for ours, transform in zip(found, [*forward, backward], strict=True):
            np.testing.assert_allclose(
                ours[b, :, token], x[b, :, token].numpy() @ transform.T, rtol=1e-9, atol=1e-9
            )


@pytest.mark.parametrize("invert_K", [True, False])
def test_the_world_frame_does_not_matter_and_a_moved_camera_does(invert_K):
    pose, K = cameras()
    q, k, v = (tokens(24, seed=seed) for seed in range(3))
    other = pose.clone()
    other[:, 1, 0, 3] += 0.5
    results = []
    for poses in (pose, pose @ rigid(1, seed=9, reach=3.0)[0], other):
        e = Projective(poses, K, PICTURE, grid=GRID, head_dim=24, invert_K=invert_K)
        results.append(e.output(attend(e.query(q), e.key(k), e.value(v))))
    torch.testing.assert_close(results[0], results[1], rtol=1e-9, atol=1e-9)
    assert (results[0] - results[2]).abs().max() > 1e-2


def test_keys_of_a_coarser_grid_lie_at_the_centres_of_their_tokens():
    pose, K = cameras(1, 1)
    coarse = Projective(pose, K, PICTURE, grid=(1, 2), head_dim=8, position_scale=(3.0, 2.0))
    # Columns 0, 1 have their middle at 0.5, columns 2, 3 at 2.5; rows 0 to 2 at 1.
    x, y = torch.tensor([0.5, 2.5]).double(), torch.ones(2).double()
    torch.testing.assert_close(coarse.cos[:, :, 0], torch.stack((x, y), -1).cos())
    torch.testing.assert_close(coarse.sin[:, :, 0], torch.stack((x, y), -1).sin())
    fine = Projective(pose, K, PICTURE, grid=GRID, head_dim=8)
    torch.testing.assert_close(coarse.key_matrix, fine.key_matrix)
