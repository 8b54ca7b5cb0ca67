from __future__ import annotations

import pickle
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from gvtools.cameras import Cameras
from gvtools.errors import DegenerateError, ProjectError
from gvtools.procedural.layouts import scene
from gvtools.procedural.paths import camera_path
from gvtools.procedural.render import radiance, to_srgb
from gvtools.procedural.textures import photograph_names
from gvtools.scenes.collection import of_scenes
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.training.corruption import (
    NOTHING,
    CorruptionOptions,
    corrupted_depth,
    draw_strengths,
)
from gvtools.training.samples import (
    TENSORS,
    Clip,
    TrainingSample,
    collate,
    observe_context,
    project_observation,
)
from gvtools.training.views import (
    ContextChoice,
    ProceduralViews,
    SceneViews,
    context_seed,
    overlaps,
)

COUNT = 8  # as many as have one number of context views
PLAIN = ProceduralViews(size=(48, 48))
CLEAN = replace(PLAIN, faults=None)


@cache
def _samples(split: str, clean: bool) -> list[TrainingSample]:
    data = replace(CLEAN if clean else PLAIN, split=split)
    return [data.sample(index) for index in range(COUNT)]


def _equal(a: TrainingSample, b: TrainingSample) -> bool:
    pairs = ((getattr(a, entry.name), getattr(b, entry.name)) for entry in fields(TrainingSample))
    return all(torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y for x, y in pairs)


def test_a_sample_follows_from_its_number_alone() -> None:
    data = PLAIN
    before = torch.get_rng_state()
    assert _equal(data.sample(5), _samples("train", False)[5])
    assert torch.equal(before, torch.get_rng_state())
    assert not torch.equal(data.sample(6).images, data.sample(5).images)
    assert not torch.equal(replace(data, seed=1).sample(5).images, data.sample(5).images)


def test_splits_have_other_scenes_and_photographs() -> None:
    train, held_out = (ProceduralViews(split=split) for split in ("train", "held-out"))
    assert not torch.equal(_samples("train", True)[0].depth, _samples("held-out", True)[0].depth)
    assert not set(train.describe()["photographs"]) & set(held_out.describe()["photographs"])
    assert train.describe()["photographs"] == photograph_names("train")


@pytest.mark.parametrize("clean", [True, False])
@pytest.mark.parametrize("split", ["train", "held-out"])
def test_shapes_ranges_and_unit(split: str, clean: bool) -> None:
    for index, sample in enumerate(_samples(split, clean)):
        k = sample.context
        data = ProceduralViews(split=split)
        assert k == data.context.count(context_seed(0, split), index)
        assert sample.images.shape == sample.hint.shape == (8, 3, 48, 48)
        assert sample.depth.shape == sample.hint_depth.shape == sample.valid.shape == (8, 1, 48, 48)
        for name in TENSORS:
            assert bool(torch.isfinite(getattr(sample, name).float()).all())
        assert float(sample.hint.min()) >= 0 and float(sample.hint.max()) <= 1
        assert bool((sample.depth > 0).all()) and bool(sample.valid[:k].all())
        known = sample.hint_depth[:k]
        assert float(known[known > 0].mean()) == pytest.approx(1, abs=1e-4)
        holes = ~sample.valid[k:]
        assert not sample.hint_depth[k:][holes].any()
        assert not sample.hint[k:][holes.expand(-1, 3, -1, -1)].any()
        assert bool((sample.hint_depth[k:][~holes] > 0).all())
        torch.testing.assert_close(sample.cam_from_world[0], torch.eye(4), atol=1e-6, rtol=0)
        place = sample.place.tolist()
        assert sorted(place) == list(range(8))
        assert place[:k] == sorted(place[:k]) and place[k:] == sorted(place[k:])


def test_clean_hints_are_the_truth_where_they_are_valid() -> None:
    squared, depth, count = 0.0, [], 0
    for split in ("train", "held-out"):
        for sample in _samples(split, True):
            k, valid = sample.context, sample.valid[sample.context :]
            error = (sample.hint[k:] - sample.images[k:]).square().mean(1, keepdim=True)
            squared, count = squared + float(error[valid].sum()), count + int(valid.sum())
            ratio = sample.hint_depth[k:][valid] / sample.depth[k:][valid] - 1
            depth.append(float(ratio.abs().median()))
            assert torch.equal(sample.hint[:k], sample.images[:k])
    assert -10 * np.log10(squared / count) >= 27
    assert np.median(depth) < 2e-3


def test_coverage_leaves_something_to_generate() -> None:
    for split in ("train", "held-out"):
        samples = _samples(split, False)
        cover = [float(v.float().mean()) for s in samples for v in s.valid[s.context :]]
        assert 0.5 < np.mean(cover) < 0.9
        assert np.quantile(cover, 0.1) < 0.6


def _plane() -> Clip:
    return CLEAN.clip(3)


@pytest.mark.parametrize(
    "fault", [name for name in CorruptionOptions.model_fields if name not in ("clean", "absent")]
)
def test_every_fault_by_itself(fault: str) -> None:
    clip = _plane()
    strength = NOTHING.replaced(**{fault: 1.0 if fault in ("flying", "dropped") else 0.2})
    perfect = observe_context(clip, (0, 2), NOTHING, rng=np.random.default_rng(0))
    harmed = observe_context(clip, (0, 2), strength, rng=np.random.default_rng(0))
    first, second = harmed.views
    kept = perfect.views[1]
    assert kept.depth is not None and np.array_equal(kept.depth, clip.depth[2])
    assert np.array_equal(np.rint(kept.rgb * 255), clip.rgb[2])
    depth_faults = ("depth_noise", "depth_scale", "holes", "flying")
    assert (second.depth is None) == (fault == "dropped") and first.depth is not None
    if fault in depth_faults:
        assert second.depth is not None and not np.array_equal(second.depth, kept.depth)
    if fault in ("exposure", "color"):
        assert not np.array_equal(second.rgb, kept.rgb)
        assert np.array_equal(first.rgb, perfect.views[0].rgb)
    moved = [
        not np.allclose(a.cam_from_world, b.camera.cam_from_world)
        for a, b in zip(harmed.lifted, harmed.views, strict=True)
    ]
    assert moved == [fault in ("rotation", "translation")] * 2


def test_depth_noise_grows_with_depth() -> None:
    rng = np.random.default_rng(0)
    depth = np.repeat(np.linspace(1, 4, 128, dtype=np.float32)[None], 128, 0)
    strength = NOTHING.replaced(depth_noise=0.02)
    errors = np.array([corrupted_depth(rng, depth, strength) / depth - 1 for _ in range(40)])
    spread = errors.std((0, 1))
    expected = 0.02 * depth[0] / depth.mean()
    assert np.abs(spread / expected - 1).mean() < 0.15


def test_holes_take_the_share_they_are_given() -> None:
    rng = np.random.default_rng(0)
    depth = np.ones((64, 64), np.float32)
    strength = NOTHING.replaced(holes=0.4)
    shares = [(corrupted_depth(rng, depth, strength) == 0).mean() for _ in range(200)]
    assert max(shares) <= 0.4 + 1e-3 and np.mean(shares) == pytest.approx(0.2, abs=0.03)


def test_projection_noise_touches_valid_target_pixels_alone() -> None:
    noisy = replace(CLEAN, faults=NOTHING.replaced(projection=0.1)).sample(2)
    clean = replace(CLEAN, faults=NOTHING).sample(2)
    k = clean.context
    assert torch.equal(noisy.hint[:k], clean.hint[:k])
    assert not noisy.hint[k:][~noisy.valid[k:].expand(-1, 3, -1, -1)].any()
    change = (noisy.hint - clean.hint)[k:][clean.valid[k:].expand(-1, 3, -1, -1)]
    assert 0 < float(change.std()) <= 0.1


def test_strengths_are_drawn_within_their_ranges() -> None:
    options = CorruptionOptions()
    strengths = [draw_strengths(np.random.default_rng(n), options) for n in range(400)]
    for name in CorruptionOptions.model_fields:
        if name not in ("clean", "absent"):
            values = np.array([getattr(strength, name) for strength in strengths])
            assert values.min() == 0 and values.max() <= getattr(options, name)
    untouched = np.mean([strength == NOTHING for strength in strengths])
    assert untouched == pytest.approx(options.clean, abs=0.08)
    assert draw_strengths(np.random.default_rng(0), CorruptionOptions(clean=1.0)) == NOTHING


def test_a_memory_without_points_projects_nothing() -> None:
    clip = _plane()
    blind = Clip(clip.rgb, np.zeros_like(clip.depth), clip.cameras)
    guidance = project_observation(
        observe_context(blind, (0,), NOTHING, rng=np.random.default_rng(0)), clip.cameras[1:]
    )
    assert not guidance.valid.any()


def test_batches_are_what_the_model_takes() -> None:
    samples = _samples("train", False)[:8]
    batch = collate(samples)
    assert batch.views.images.shape == (8, 8, 3, 48, 48)
    assert batch.views.context == samples[0].context and batch.views.valid.dtype == torch.bool
    assert torch.equal(batch.images[3], samples[3].images)


TALL, WIDE = 96, 128


class Loaded:
    def __init__(self, frame: Frame) -> None:
        self.frame = frame

    def __call__(self) -> Frame:
        return self.frame


@cache
def _scene(seed: int = 0, *, count: int = 20, masked: bool = False) -> Scene:
    rng = np.random.default_rng([seed, 4])
    place = scene(rng, "train")
    cameras = camera_path(rng, place.geometry, views=count, size=(TALL, WIDE))
    light, depth = radiance(place.geometry, place.look, cameras)
    rgb = to_srgb(light, place.key / light.mean())
    mask = np.ones((TALL, WIDE), bool)
    mask[:10] = False
    views = tuple(
        View(
            f"{i:03d}.png",
            cameras[i],
            Loaded(Frame(rgb[i], depth[i], mask if masked else None)),
            has_depth=True,
        )
        for i in range(count)
    )
    return Scene(Path("room"), "rgbd", views)


def _views(**changes) -> SceneViews:
    plain = {"scenes": (_scene(),), "faults": None, "size": (48, 48), **changes}
    return SceneViews(**{**plain, "scenes": of_scenes(plain["scenes"])})


def test_samples_are_windows_of_neighbouring_views() -> None:
    data = _views()
    for index in range(6):
        clip, truth = data.clips(index)
        assert clip.rgb.shape == (8, 96, 96, 3) and truth.rgb.shape == (8, 48, 48, 3)
        rows = [int(name[:3]) for name in clip.cameras.names]
        steps = set(np.diff(rows).tolist())
        assert len(steps) == 1 and 1 <= abs(steps.pop()) <= 2
        assert min(overlaps(truth)) >= data.overlap


def test_samples_follow_from_their_number() -> None:
    data = _views()
    first, again = data.sample(3), _views().sample(3)
    restored = pickle.loads(pickle.dumps(data)).sample(3)
    for other in (again, restored):
        assert torch.equal(first.hint, other.hint) and torch.equal(first.depth, other.depth)
    assert not torch.equal(first.images, _views(seed=1).sample(3).images)


def test_cropped_cameras_fit_their_pictures() -> None:
    errors, cover = [], []
    for index in range(6):
        sample = _views().sample(index)
        k, valid = sample.context, sample.valid[sample.context :]
        error = (sample.hint[k:] - sample.images[k:]).square().mean(1, keepdim=True)
        errors.append(float(error[valid].mean()))
        cover.append(float(valid.float().mean()))
        ratio = sample.hint_depth[k:][valid] / sample.depth[k:][valid] - 1
        assert float(ratio.abs().median()) < 0.01
    assert -10 * np.log10(np.mean(errors)) > 25
    assert np.mean(cover) > 0.5


def test_masked_pixels_have_no_depth() -> None:
    data = _views(scenes=(_scene(masked=True),))
    clip, truth = data.clips(0)
    assert not truth.depth[:, :5].any() and (truth.depth[:, 6:] > 0).all()
    assert not clip.depth[:, :10].any()


def test_overlap_counts_what_the_next_view_shows() -> None:
    clip = _views().clips(0)[1]
    turned = clip.cameras.cam_from_world.copy()
    turned[1::2] = np.diag([-1.0, 1, -1, 1]) @ turned[1::2]
    K, width, height = clip.cameras.K, clip.cameras.width, clip.cameras.height
    away = type(clip)(clip.rgb, clip.depth, Cameras(K, turned, width, height, clip.cameras.names))
    assert max(overlaps(away)) == 0
    same = type(clip)(clip.rgb[[0, 0]], clip.depth[[0, 0]], clip.cameras[[0, 0]])
    assert overlaps(same) == [1.0]


def test_scenes_that_cannot_be_used_are_refused() -> None:
    with pytest.raises(ProjectError, match="6 of 6 views have depth"):
        _views(scenes=(_scene(1, count=6),))
    with pytest.raises(ProjectError, match="no scene"):
        _views(scenes=())
    with pytest.raises(DegenerateError, match="lower the overlap"):
        _views(overlap=0.9999).sample(0)


@pytest.mark.data
def test_real_frames(shared: Path) -> None:
    place = open_project(shared / "data" / "sevenscenes_reg")
    data = SceneViews(scenes=of_scenes([place]), faults=None)
    sample = data.sample(0)
    k, valid = sample.context, sample.valid[sample.context :]
    assert sample.images.shape == (8, 3, 96, 96) and 0.1 < float(valid.float().mean()) < 0.99
    both = valid & (sample.depth[k:] > 0)
    ratio = sample.hint_depth[k:][both] / sample.depth[k:][both] - 1
    assert float(ratio.abs().median()) < 0.05


def test_a_selection_limits_the_views(tmp_path):
    place = _scene(count=20)
    data = SceneViews(
        scenes=of_scenes([place]), select="every:4", views=4, size=(32, 32), overlap=0.0,
        context=ContextChoice(most=2),
    )  # fmt: skip
    listed = {int(name[:3]) for index in range(20) for name in data.clips(index)[0].cameras.names}
    assert listed == set(range(0, 20, 4))
    assert data.sample(3).images.shape == (4, 3, 32, 32)
    with pytest.raises(ProjectError, match="'every:10'"):
        SceneViews(
            scenes=of_scenes([place]), select="every:10", views=4, context=ContextChoice(most=2)
        )
