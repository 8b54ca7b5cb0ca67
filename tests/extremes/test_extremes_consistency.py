from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvtools.cameras import Cameras
from gvtools.evaluation.depth_reprojection import depth_reprojection
from gvtools.evaluation.feature_consistency import feature_consistency
from gvtools.evaluation.posed_picture import PosedPicture

pytestmark = pytest.mark.filterwarnings("error")

SIZE = (24, 32)
NOISE = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
EVERYWHERE = np.ones(SIZE, np.bool_)


def wall(
    *,
    depth: float | None = 2.0,
    shift: float = 0.0,
    rgb: np.ndarray = NOISE,
    mask: np.ndarray | None = None,
) -> PosedPicture:
    """A wall at ``depth``, seen from ``shift`` along x."""
    size = rgb.shape[:2]
    pose = np.eye(4)
    pose[0, 3] = -shift
    K = np.array([[[30.0, 0, size[1] / 2], [0, 30, size[0] / 2], [0, 0, 1]]])
    camera = Cameras(K, pose[None], np.array([size[1]]), np.array([size[0]]), ("c",))
    lengths = None if depth is None else np.full(size, depth, np.float32)
    return PosedPicture(f"at {shift:g}", camera, rgb, lengths, mask)


@settings(max_examples=30, deadline=None)
@given(st.integers(-36, 36), st.sampled_from([0.0, 0.1, 0.5]))
def test_exact_depth_agrees_in_any_unit(power, step):
    unit = 10.0**power
    first, second = wall(depth=2 * unit), wall(depth=2 * unit, shift=step * unit)
    found = depth_reprojection(first, second)
    assert found.ok
    assert found.mean_pixels == pytest.approx(0, abs=1e-10)
    assert found.mean_relative_depth == pytest.approx(0, abs=1e-12)
    # The wall moves by 30 step / 2 pixels.
    assert found.covisible == pytest.approx(24 * (32 - 15 * step), abs=24)


@pytest.mark.parametrize("depth", [np.nan, np.inf, -np.inf, 0.0, -1.0, None])
def test_depth_that_is_none_gives_a_status_and_no_figure(depth):
    for first, second in ((wall(depth=depth), wall()), (wall(), wall(depth=depth))):
        found = depth_reprojection(first, second)
        assert found.status.startswith("empty: ")
        assert found.mean_pixels is found.mean_relative_depth is None
        features = feature_consistency(first, second)
        assert features.status.startswith("empty: ")
        assert features.score is None and features.places == 0
