from __future__ import annotations

import numpy as np
import pytest

from gvtools.cameras import Cameras
from gvtools.completers.base import Completer, Completion, ScaleAlignment, ScaleStatus, create
from gvtools.completers.effort import EffortPolicy, SmallHolesInpainted
from gvtools.completers.hole_depth import hole_radius
from gvtools.completers.inpaint import InpaintCompleter
from gvtools.errors import OptionError
from gvtools.guidance import Guidance
from gvtools.settings import with_values
from pipelines.reconstruction.settings import RunSettings

HEIGHT, WIDTH = 60, 80
OWN = ScaleAlignment(ScaleStatus.CAMERA_CENTRES)


class Recorder(Completer):
    name = "recorder"
    batches_targets = True
    costly = True

    def __init__(self, alignment: ScaleAlignment | None = OWN) -> None:
        super().__init__()
        self.alignment = alignment
        self.calls: list[tuple[str, ...]] = []

    def complete(self, context, guidance: Guidance, *, seed: int = 0) -> Completion:
        self.calls.append(guidance.cameras.names)
        hole = ~guidance.valid
        rgb = np.where(hole[..., None], np.array([1, 0, 0], np.float32), guidance.rgb)
        depth = np.where(hole, np.float32(3), guidance.depth)
        alignment = None if self.alignment is None else (self.alignment,) * len(guidance)
        rays = np.full((*hole.shape, 6), 7, np.float32)
        return Completion(rgb, depth, hole * np.float32(0.5), rays, alignment)


def guidance_with(*radii: int) -> Guidance:
    """A grey wall at depth 2 in each view, with a round hole of the radius in its middle."""
    count = len(radii)
    pose = np.tile(np.eye(4), (count, 1, 1))
    K = np.tile(np.array([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]]), (count, 1, 1))
    names = tuple(f"r{radius}_{i}" for i, radius in enumerate(radii))
    cameras = Cameras(K, pose, np.full(count, WIDTH), np.full(count, HEIGHT), names)
    y, x = np.indices((HEIGHT, WIDTH))
    away = np.hypot(y - HEIGHT // 2, x - WIDTH // 2)
    valid = np.stack([away >= radius for radius in radii])
    return Guidance(
        cameras,
        (valid[..., None] * np.full(3, 0.5)).astype(np.float32),
        np.where(valid, np.float32(2), np.float32(0)),
        valid,
        valid.astype(np.float32),
        np.zeros_like(valid),
    )


@pytest.mark.parametrize("radius", [1, 5, 17])
def test_the_radius_of_a_hole_is_its_inner_one(radius):
    valid = guidance_with(radius).valid[0]
    # The middle pixel lies that far from the rim.
    assert hole_radius(valid) == pytest.approx(radius / 100, abs=1e-6)


def test_the_radius_at_the_ends():
    full = np.ones((HEIGHT, WIDTH), bool)
    assert hole_radius(full) == 0
    assert hole_radius(~full) == float("inf")
    strip = full.copy()
    strip[:, :10] = False
    assert hole_radius(strip) == pytest.approx(0.1)


def test_small_holes_go_to_the_cheap_one_and_the_rest_stay_as_they_were():
    guidance = guidance_with(2, 15, 0, 20, 4)
    alone, costly = Recorder(), Recorder()
    made = SmallHolesInpainted(costly, 0.05).complete((), guidance)
    assert costly.calls == [("r15_1", "r20_3")]
    whole = alone.complete((), guidance)
    cheap = InpaintCompleter().complete((), guidance)
    for row in range(5):
        expected = whole if row in (1, 3) else cheap
        for key in ("rgb", "depth", "confidence"):
            assert np.array_equal(getattr(made, key)[row], getattr(expected, key)[row])
    assert made.scale_alignment == (None, OWN, None, OWN, None)
    assert made.rays is not None
    assert (made.rays[[1, 3]] == 7).all()
    assert np.allclose(made.rays[0], guidance.cameras.plucker(0))


def test_only_costly_completers_leave_views_to_inpaint():
    policy, off = EffortPolicy(inpaint_below=0.02), EffortPolicy(inpaint_below=0)
    costly = Recorder()
    split = policy.wrap(costly)
    assert isinstance(split, SmallHolesInpainted)
    assert (split.name, split.batches_targets) == ("recorder", True)
    assert split.files == costly.files and split.notes == costly.notes
    assert off.wrap(costly) is costly
    for cheap in map(create, ("inpaint", "none")):
        assert policy.wrap(cheap) is cheap


def test_scale_alignment_is_absent_where_neither_has_a_scale_to_find():
    split = SmallHolesInpainted(Recorder(alignment=None), 0.05)
    assert split.complete((), guidance_with(2, 20)).scale_alignment is None


def test_a_faster_profile_makes_less_effort():
    shares = [
        with_values(RunSettings(), {"profile": profile}).effort.inpaint_below
        for profile in ("accurate", "balanced", "fast")
    ]
    assert shares == sorted(set(shares)) and shares[0] == 0
    with pytest.raises(OptionError, match=r"effort\.inpaint_below -0\.1; expected at least 0"):
        with_values(RunSettings(), {"effort.inpaint_below": -0.1})
