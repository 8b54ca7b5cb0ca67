"""Views with small holes are left to a cheap completer, and the rest get what they got before."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from tiny_scan import write_scan

from gvtools.cameras import Cameras
from gvtools.completers.base import Completion, create
from gvtools.completers.effort import SparingCompleter, sparing
from gvtools.completers.geoverse.completer import GeoVerseCompleter
from gvtools.completers.holes import hole_reach
from gvtools.completers.inpaint import InpaintCompleter
from gvtools.errors import OptionError
from gvtools.guidance import Guidance
from gvtools.settings import with_profile, with_values
from pipelines.cli import main
from pipelines.reconstruction.settings import RunSettings

HEIGHT, WIDTH = 60, 80


@dataclass
class Recorder:
    """Paints holes red, and tells whom it was given."""

    name: str = "recorder"
    joint: bool = True
    costly: bool = True
    said: str | None = "own"
    given: list[tuple[str, ...]] = field(default_factory=list)

    def complete(self, context, guidance: Guidance, *, seed: int = 0) -> Completion:
        self.given.append(guidance.cameras.names)
        hole = ~guidance.valid
        rgb = np.where(hole[..., None], np.array([1, 0, 0], np.float32), guidance.rgb)
        depth = np.where(hole, np.float32(3), guidance.depth)
        support = None if self.said is None else (self.said,) * len(guidance)
        rays = np.full((*hole.shape, 6), 7, np.float32)
        return Completion(rgb, depth, hole * np.float32(0.5), rays, {"passes": 1.0}, support)


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
def test_the_reach_of_a_hole_is_its_inner_radius(radius):
    valid = guidance_with(radius).valid[0]
    # The middle pixel lies that far from the rim.
    assert hole_reach(valid) == pytest.approx(radius / 100, abs=1e-6)


def test_the_reach_at_the_ends():
    full = np.ones((HEIGHT, WIDTH), bool)
    assert hole_reach(full) == 0
    assert hole_reach(~full) == float("inf")
    strip = full.copy()
    strip[:, :10] = False
    assert hole_reach(strip) == pytest.approx(0.1)


def test_small_holes_go_to_the_cheap_one_and_the_rest_stay_as_they_were():
    guidance = guidance_with(2, 15, 0, 20, 4)
    alone, costly = Recorder(), Recorder()
    made = SparingCompleter(costly, 0.05).complete((), guidance)
    assert costly.given == [("r15_1", "r20_3")]
    assert made.spent["spared_views"] == 3 and made.spent["passes"] == 1
    whole = alone.complete((), guidance)
    cheap = InpaintCompleter().complete((), guidance)
    for row in range(5):
        expected = whole if row in (1, 3) else cheap
        for key in ("rgb", "depth", "confidence"):
            assert np.array_equal(getattr(made, key)[row], getattr(expected, key)[row])
    assert made.support == (None, "own", None, "own", None)
    assert made.rays is not None
    assert (made.rays[[1, 3]] == 7).all()
    assert np.allclose(made.rays[0], guidance.cameras.plucker(0))


def test_nothing_is_asked_of_a_completer_that_has_nothing_to_do():
    costly, cheap = Recorder(), Recorder("cheap")
    SparingCompleter(costly, 0.05, cheap).complete((), guidance_with(2, 3))
    assert not costly.given and len(cheap.given) == 1
    SparingCompleter(costly, 0.05, cheap).complete((), guidance_with(20))
    assert len(costly.given) == 1 and len(cheap.given) == 1


def test_only_costly_completers_are_spared_and_only_where_that_is_on():
    costly = Recorder()
    wrapped = sparing(costly, 0.02)
    assert isinstance(wrapped, SparingCompleter)
    assert (wrapped.name, wrapped.joint) == ("recorder", True)
    assert sparing(costly, 0.0) is costly
    modest = replace(costly, costly=False)
    assert sparing(modest, 0.02) is modest
    for name, spared in (("inpaint", False), ("none", False), ("exemplar", True)):
        assert isinstance(sparing(create(name), 0.02), SparingCompleter) == spared


def test_a_completer_of_several_steps_is_told_where_one_will_do():
    core = create("geoverse")
    assert isinstance(core, GeoVerseCompleter)
    assert sparing(core, 0.0, one_step=0.1) == replace(core, one_step_holes=0.1)
    wrapped = sparing(core, 0.02, one_step=0.1)
    assert isinstance(wrapped, SparingCompleter)
    assert wrapped.costly == replace(core, one_step_holes=0.1)
    assert sparing(core, 0.0, one_step=0.0) is core
    assert sparing(core, 0.0, half_size=0.2) == replace(core, half_size_holes=0.2)
    assert sparing(core, 0.0, no_prior=0.3) == replace(core, no_prior_holes=0.3)
    assert sparing(core, 0.0, near_holes=True) == replace(core, near_holes=True)
    for share in (0.05, 0.0):
        told = create(
            "geoverse",
            one_step_holes=share,
            half_size_holes=share,
            no_prior_holes=share,
            near_holes=False,
        )
        same = sparing(told, 0.0, one_step=0.1, half_size=0.1, no_prior=0.1, near_holes=True)
        assert same is told
    inpaint = create("inpaint")
    assert sparing(inpaint, 0.02, one_step=0.1) is inpaint


def test_support_is_absent_where_neither_has_a_scale_to_find():
    costly = Recorder(said=None)
    assert SparingCompleter(costly, 0.05).complete((), guidance_with(2, 20)).support is None


@pytest.mark.parametrize("profile", ["fast", "balanced", "accurate"])
def test_a_run_hands_its_savings_on(tmp_path, monkeypatch, profile):
    told = []

    def kept(completer, minor, **savings):
        told.append({"minor_holes": minor, **savings})
        return sparing(completer, minor, **savings)

    monkeypatch.setattr("pipelines.reconstruction.run_round.sparing", kept)
    scan = write_scan(tmp_path / "scan", views=4)
    options = ("--context", "first:3", "--targets", "range:3-3", "--profile", profile, "--quiet")
    assert main(["reconstruct", str(scan), "--out", str(tmp_path / "run"), *options]) == 0
    savings = with_profile(RunSettings(), profile).savings
    names = ("minor_holes", "one_step", "half_size", "no_prior", "near_holes")
    assert told == [{name: getattr(savings, name) for name in names}]


@pytest.mark.parametrize("name", ["minor_holes", "one_step", "half_size", "no_prior"])
def test_a_faster_profile_spares_more(name):
    shares = [
        getattr(with_profile(RunSettings(), profile).savings, name)
        for profile in ("accurate", "balanced", "fast")
    ]
    assert shares == sorted(set(shares)) and shares[0] == 0


def test_a_negative_share_is_refused():
    with pytest.raises(OptionError, match="minor_holes"):
        with_values(RunSettings(), {"savings.minor_holes": -0.1})
