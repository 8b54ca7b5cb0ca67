from __future__ import annotations

import pickle
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
from gvtools.scenes.collection import of_scenes
from gvtools.scenes.project import open_project
from gvtools.scenes.scene import Frame, Scene, View
from gvtools.training.views import ContextChoice, SceneViews, overlaps

TALL, WIDE = 96, 128


class Loaded:
    """Pixels that are there already."""

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
    """Hints of cropped and reduced views lie where their truth is."""
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
