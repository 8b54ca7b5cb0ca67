from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from consistency_scene import blurred, camera, moved, noisy, picture, real_pictures

from gvtools.evaluation.feature_consistency import (
    DenseGradient,
    feature_consistency,
    load_met3r,
    met3r_score,
)
from gvtools.evaluation.posed_picture import PosedPicture

WIDTH, HEIGHT = 240, 180


class Network:
    """Features from a function of the picture."""

    name = "given"

    def __init__(self, function: Callable[[np.ndarray], Any]) -> None:
        self.function = function

    def features(self, rgb: np.ndarray) -> np.ndarray:
        return np.asarray(self.function(rgb), np.float32)


@pytest.fixture(scope="module")
def pair():
    size = {"width": WIDTH, "height": HEIGHT}
    return (
        picture(camera((-0.2, 0, 0), turn=(0, -3, 0), **size), "left"),
        picture(camera((0.1, 0.05, 0.1), turn=(0, 2, 1), **size), "right"),
    )


def _score(*pair):
    result = feature_consistency(*pair)
    assert result.ok
    return result.score


def test_one_scene_is_consistent_and_unrelated_content_is_not(pair):
    result = feature_consistency(*pair)
    assert (result.first, result.second, result.network) == ("left", "right", "dense-gradient")
    assert result.score < 0.1 and result.unrelated > 0.6
    assert 0.7 < result.overlap < 1
    assert result.places == round(result.overlap * 60 * 45) and result.undefined == 0
    itself = feature_consistency(pair[0], replace(pair[0], name="twin"))
    assert itself.score == pytest.approx(0, abs=1e-6) and itself.overlap == 1


@pytest.mark.parametrize("what", ["blur", "noise", "shift", "turn", "place", "depth"])
def test_inconsistency_raises_the_score(pair, what):
    first, second = pair
    near, far = first.depth, second.depth
    scores = [_score(first, second)]
    for k in (1, 2):
        changed = {
            "blur": lambda k=k: (first, blurred(second, 2.0 * k)),
            "noise": lambda k=k: (first, noisy(second, 20 * k)),
            "shift": lambda k=k: (first, replace(second, rgb=np.roll(second.rgb, 3 * k, axis=1))),
            "turn": lambda k=k: (first, moved(second, turn=(k, 0, 0))),
            "place": lambda k=k: (first, moved(second, shift=(0.03 * k, 0, 0))),
            "depth": lambda k=k: (
                replace(first, depth=near * np.float32(1 + 0.1 * k)),
                replace(second, depth=far * np.float32(1 + 0.1 * k)),
            ),
        }[what]()
        scores.append(_score(*changed))
    assert scores[0] * 1.1 < scores[1] < scores[2]


def test_the_score_is_one_minus_the_cosine_of_what_the_network_gives(pair):
    first, second = pair
    angles = {first.rgb.tobytes(): 0.2, second.rgb.tobytes(): 1.0}

    def constant(rgb: np.ndarray) -> np.ndarray:
        angle = angles[rgb.tobytes()]
        # The length is no part of a cosine.
        return np.full((2, 7, 9), [[[np.cos(angle)]], [[np.sin(angle)]]]) * (1 + angle)

    result = feature_consistency(first, second, network=Network(constant))
    assert result.score == pytest.approx(1 - np.cos(0.8), abs=1e-6)
    assert 0 < result.places <= 7 * 9


def test_features_are_taken_from_where_the_geometry_says():
    # A step sideways by 20 pixels' parallax before a flat wall: the network tells columns apart by
    # a phase that turns once in 60 pixels, so that places 20 pixels apart differ by a third of it.
    at, aside = camera((0, 0, 0)), camera((0.4, 0, 0))
    depth = np.full((120, 160), 0.4 * at.K[0, 0, 0] / 20, np.float32)
    column = np.broadcast_to(np.arange(160, dtype=np.uint8)[None, :, None], (120, 160, 3))

    def phase(rgb: np.ndarray) -> np.ndarray:
        angle = rgb[..., 0] * (2 * np.pi / 60)
        return np.stack([np.cos(angle), np.sin(angle)])

    first, second = (PosedPicture("wall", c, column, depth) for c in (at, aside))
    result = feature_consistency(first, second, network=Network(phase))
    assert result.score == pytest.approx(1 - np.cos(2 * np.pi / 3), abs=1e-4)
    assert result.overlap == pytest.approx(140 / 160)
    painted = replace(second, rgb=np.ascontiguousarray(column + np.uint8(20)))
    right = feature_consistency(first, painted, network=Network(phase))
    assert right.score == pytest.approx(0, abs=1e-4)


def test_places_where_both_features_are_zero_are_left_out_and_counted(pair):
    def half(rgb: np.ndarray) -> np.ndarray:
        features = rgb[::4, ::4].transpose(2, 0, 1).astype(float)
        return np.where(np.arange(60) < 30, features, 0)

    result = feature_consistency(*pair, network=Network(half))
    assert result.ok and result.undefined > 500 and result.places > 500
    empty = feature_consistency(*pair, network=Network(lambda rgb: np.zeros((3, 6, 8))))
    assert empty.score is None and empty.places == 0 and empty.unrelated is None
    assert empty.status == "empty: left and right have no co-visible place with features"


def test_a_network_that_tells_nothing_apart_is_reported(pair):
    blank = [replace(view, rgb=np.full_like(view.rgb, 90)) for view in pair]
    for result in (
        feature_consistency(*blank),
        feature_consistency(*pair, network=Network(lambda rgb: np.ones((4, 10, 10)))),
    ):
        assert result.status.startswith("degenerate: ") and "tells nothing apart" in result.status
        assert result.score is None and result.unrelated == pytest.approx(0, abs=1e-3)


def test_views_without_overlap_or_depth_give_a_status(pair):
    first, second = pair
    nothing = "empty: left and right have no co-visible place with features"
    for views, status in (
        ((first, moved(second, turn=(0, 180, 0))), nothing),
        ((first, replace(second, depth=None)), "empty: right has no depth"),
        ((replace(first, depth=None), second), "empty: left has no depth"),
        ((first, replace(second, mask=np.zeros((HEIGHT, WIDTH), bool))), nothing),
    ):
        result = feature_consistency(*views)
        assert result.status == status and not result.ok
        assert result.score is None and result.unrelated is None and result.overlap == 0


def test_dense_gradients_cover_pictures_of_any_size():
    rng = np.random.default_rng(1)
    for height, width in ((40, 64), (37, 50), (5, 3), (1, 1)):
        rgb = rng.integers(0, 256, (height, width, 3), np.uint8)
        features = DenseGradient().features(rgb)
        assert features.dtype == np.float32
        assert features.shape == (76, -(-height // 4), -(-width // 4))
        assert np.isfinite(features).all()
        assert np.linalg.norm(features[:72], axis=0).max() <= 1 + 1e-6
        assert np.abs(features[:72].mean(0)).max() < 1e-6


def test_dense_gradients_of_a_turned_picture_are_the_turned_features():
    rgb = np.random.default_rng(2).integers(0, 256, (48, 64, 3), np.uint8)
    straight = DenseGradient().features(rgb)
    turned = DenseGradient().features(np.ascontiguousarray(np.rot90(rgb)))
    # A quarter turn takes each of the 3 x 3 cells, and each of the 8 orientations, to another.
    layout = straight[:72].reshape(3, 3, 8, 12, 16)
    expected = np.rot90(np.rot90(np.roll(layout, -2, axis=2), axes=(0, 1)), axes=(3, 4))
    np.testing.assert_allclose(turned[:72], expected.reshape(72, 16, 12), atol=1e-5)
    np.testing.assert_allclose(turned[72:], np.rot90(straight[72:], axes=(1, 2)), atol=1e-5)


@pytest.mark.data
def test_a_real_recording_is_consistent_until_a_pose_is_wrong(shared):
    first, second = real_pictures(shared, slice(0, 3, 2))
    good = feature_consistency(first, second)
    bad = feature_consistency(first, moved(second, turn=(0, 2, 0)))
    assert good.score < 0.1 * good.unrelated
    assert bad.score > 3 * good.score


class FakeMet3r(torch.nn.Module):
    """Stands for met3r.MEt3R: records what it is given."""

    def __init__(self, img_size: int, mask: float = 1.0) -> None:
        super().__init__()
        self.img_size, self.mask = img_size, mask
        self.calls: list[dict[str, Any]] = []

    def forward(self, **inputs: Any) -> tuple[torch.Tensor, torch.Tensor, None, None]:
        self.calls.append(inputs)
        mask = torch.zeros(1, self.img_size, self.img_size)
        mask[:, : self.img_size // 4] = self.mask
        return torch.tensor([0.125]), mask, None, None


def _installed(monkeypatch: pytest.MonkeyPatch, metric: Callable[..., Any] | None) -> None:
    module = ModuleType("met3r")
    module.MEt3R = metric  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "met3r", None if metric is None else module)


def test_met3r_is_given_square_pairs_from_minus_one_to_one(monkeypatch, pair):
    _installed(monkeypatch, FakeMet3r)
    metric, status = load_met3r(64)
    assert isinstance(metric, FakeMet3r) and status == "ready" and metric.img_size == 64
    black, white = (np.full((HEIGHT, WIDTH, 3), level, np.uint8) for level in (0, 255))
    white[:, :30] = white[:, -30:] = 0  # beside the centred square of 180 x 180
    views = replace(pair[0], rgb=black), replace(pair[1], rgb=white)
    result = met3r_score(*views, metric, size=64)
    assert (result.status, result.score, result.overlap) == ("measured", 0.125, 0.25)
    assert (result.first, result.second) == ("left", "right")
    (call,) = metric.calls
    images = call.pop("images")
    assert images.shape == (1, 2, 3, 64, 64) and images.dtype == torch.float32
    assert (images[:, 0] == -1).all() and (images[:, 1] == 1).all()
    off = dict.fromkeys(("return_score_map", "return_projections"), False)
    assert call == {"return_overlap_mask": True, **off}
    apart = met3r_score(pair[0], pair[1], FakeMet3r(256, mask=0.0))
    assert (apart.status, apart.score) == ("empty: MEt3R finds no overlap", None)


def test_met3r_that_is_lacking_says_how_to_get_it(monkeypatch):
    _installed(monkeypatch, None)
    metric, status = load_met3r()
    assert metric is None and status.startswith("unavailable: ")
    assert "pip install git+https://github.com/mohammadasim98/met3r" in status

    def offline(**options: Any) -> None:
        raise OSError("no route to host")

    _installed(monkeypatch, offline)
    metric, status = load_met3r()
    assert metric is None and "no route to host" in status
