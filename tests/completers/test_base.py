from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from pydantic import Field
from tiny_scan import write_scan

from gvtools.cameras import Cameras
from gvtools.completers import (
    Completer,
    Completion,
    ContextView,
    ScaleAlignment,
    ScaleStatus,
    create,
    register,
)
from gvtools.completers.base import _REGISTRY, complete, run_completer
from gvtools.completers.effort import EffortPolicy, SmallHolesInpainted
from gvtools.completers.hole_depth import hole_radius
from gvtools.completers.inpaint import InpaintCompleter
from gvtools.completers.settings import CompleterSettings
from gvtools.errors import OptionError, ShapeError
from gvtools.guidance import Guidance
from gvtools.runs.folder import RunDirectory
from gvtools.runs.target_files import read_target
from gvtools.settings import with_values
from gvtools.similarity import align_depth_scale
from pipelines.cli import main
from pipelines.reconstruction.settings import RunSettings


class _PainterSettings(CompleterSettings):
    strength: float = Field(ge=0)
    rounds: int = 2
    soft: bool = False
    limit: float | None = None


class _Painter(Completer):
    name = "painter"
    settings_type = _PainterSettings
    made = 0

    def __init__(self, **options):
        super().__init__(**options)
        type(self).made += 1

    def complete(self, context, guidance, *, seed=0):
        hole = ~guidance.valid
        grey = np.float32(self.settings.strength)
        depth = np.where(hole, guidance.depth.max(), guidance.depth)
        confidence = np.where(hole, np.float32(0.5), np.minimum(guidance.confidence, 1))
        return Completion(np.where(hole[..., None], grey, guidance.rgb), depth, confidence)


@pytest.fixture
def painter():
    register("painter", _Painter)
    yield
    del _REGISTRY["painter"]


def _camera(width: int = 8) -> Cameras:
    return Cameras.pinhole(width, 6, focal=10)


def test_listing_the_completers_imports_none_of_them():
    code = (
        "import sys, gvtools.completers as c; c.available();"
        "bad = [m for m in ('numba', 'scipy', 'torch', 'open3d', 'gvtools.completers.inpaint')"
        " if m in sys.modules]; sys.exit(' '.join(bad) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("painter", {"strength": 1, "strenght": 1}, "'completer.strength'"),
        ("painter", {}, "required"),
        ("painter", {"strength": -1}, "completer.strength -1; expected at least 0"),
        ("painter", {"strength": 1, "rounds": 2.5}, "expected .*integer"),
        ("inpant", {}, "did you mean 'inpaint'"),
        ("none", {"strength": 1}, "no option 'strength'; it has none"),
    ],
)
def test_wrong_names_and_options_are_said(painter, name, options, words):
    with pytest.raises(OptionError, match=words):
        create(name, **options)


@pytest.mark.usefixtures("unpainted")
def test_a_completer_of_ones_own_serves_a_run_and_is_made_once(painter, tmp_path):
    scan, out = write_scan(tmp_path / "scan", views=4), tmp_path / "run"
    _Painter.made = 0
    words = ["--context", "first:2", "--targets", "range:2-3", "--views-per-round", "1"]
    words += ["--completer", "painter", "--set", "completer.strength=0.3", "--refine", "0"]
    assert main(["reconstruct", str(scan), "--out", str(out), "--quiet", *words]) == 0
    assert _Painter.made == 1
    for number in (1, 2):
        folder = RunDirectory(out).round_path(number)
        for entry in RunDirectory(out).reports()[number]["views"]:
            target = read_target(folder, entry)
            assert target.generated.any() and entry["fused_pixels"] > 0
            # 0.3 of 255.
            assert np.isin(target.picture[target.generated], (76, 77)).all()


class _Careless(Completer):
    name = "careless"

    def __init__(self, outcome):
        super().__init__()
        self.outcome = outcome

    def complete(self, context, guidance, *, seed=0):
        rgb, depth = guidance.rgb.copy(), guidance.depth.copy()
        if self.outcome == "changed":
            rgb[guidance.valid] *= 0.5
        elif self.outcome == "not finite":
            depth[~guidance.valid] = np.nan
        elif self.outcome == "too few":
            rgb, depth = rgb[:, :4], depth[:, :4]
        else:
            return None
        return Completion(rgb, depth, np.zeros_like(depth))


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        ("changed", "changed colours where the guidance is valid"),
        ("not finite", "depth holds NaN or infinity"),
        ("too few", r"careless: depth \(1, 4, 80\); expected \(1, 60, 80\)"),
        ("nothing", "returned a NoneType; expected a Completion"),
    ],
)
def test_what_breaks_the_contract_is_named(outcome, words):
    guidance = guidance_with(15)
    with pytest.raises((OptionError, ShapeError), match=words):
        complete((), guidance, completer=_Careless(outcome))
    with pytest.raises(OptionError, match="steps beside a completer that was made before"):
        complete((), guidance, completer=_Careless(outcome), steps=2)


def test_a_taken_name_and_a_malformed_reference_are_refused(painter):
    register("painter", _Painter)
    with pytest.raises(OptionError, match="taken"):
        register("painter", "other:Thing")
    with pytest.raises(OptionError, match="module:class"):
        register("other", "no_colon")


def test_none_passes_valid_pixels_and_leaves_the_rest_empty():
    guidance = guidance_with(5, 17)
    valid, confidence = guidance.valid, np.full(guidance.valid.shape, 3, np.float32)
    noise = np.random.default_rng(0).random((*valid.shape, 3), np.float32)
    guidance = replace(guidance, rgb=noise, depth=noise[..., 0] + 1, confidence=confidence)
    result = create("none").complete([], guidance)
    assert np.array_equal(result.rgb[valid], guidance.rgb[valid])
    assert np.array_equal(result.depth[valid], guidance.depth[valid])
    assert not result.rgb[~valid].any() and not result.depth[~valid].any()
    assert not result.confidence[~valid].any()
    assert result.confidence.max() == 1


def test_shapes_that_do_not_fit_are_refused():
    image = np.zeros((6, 8, 3), np.float32)
    with pytest.raises(ShapeError, match=r"view a: rgb \(6, 8, 3\); expected \(6, 9, 3\)"):
        ContextView("a", _camera(9), image)
    with pytest.raises(ShapeError, match="2 cameras; expected one"):
        ContextView("a", _camera()[[0, 0]], image)
    with pytest.raises(ShapeError, match="depth"):
        ContextView("a", _camera(), image, np.zeros((6, 7), np.float32))
    with pytest.raises(ShapeError, match="completion"):
        Completion(image, image[..., 0], image[..., 0])
    with pytest.raises(ShapeError, match="scale alignment of 2 views; expected 1"):
        none = (None, None)
        Completion(image[None], image[None, ..., 0], image[None, ..., 0], scale_alignment=none)


def test_a_fit_becomes_an_outcome_with_figures_and_words():
    depth = np.random.default_rng(0).uniform(1, 2, (30, 40))
    valid = np.ones(depth.shape, bool)
    good = ScaleAlignment.of_fit(align_depth_scale(depth, 3 * depth, valid=valid))
    assert (good.status, good.overlap_px) == (ScaleStatus.MEMORY_DEPTH, 1200) and good.accepted
    assert good.scale == pytest.approx(3) and good.residual < 1e-9 and good.inlier_share == 1
    shown = good.to_json()
    assert shown["status"] == "memory_depth" and "1200 common pixels" in shown["description"]
    noise = np.random.default_rng(1).uniform(0.1, 10, depth.shape)
    for reference, where, status in (
        (noise, valid, ScaleStatus.CONTRADICTED),
        (depth, ~valid, ScaleStatus.UNSUPPORTED),
    ):
        bad = ScaleAlignment.of_fit(align_depth_scale(depth, reference, valid=where))
        assert bad.status is status and not bad.accepted and np.isnan(bad.scale)
        assert bad.describe().startswith("refused: ")


class Hungry(Completer):
    """Fills with a number of the view's own; memory suffices for ``most`` views."""

    name = "hungry"
    batches_targets = True

    def __init__(self, most: int, error: Exception, *, rays: bool = False) -> None:
        super().__init__()
        self.most, self.error, self.rays = most, error, rays
        self.calls: list[int] = []

    def complete(self, context, guidance, *, seed=0):
        self.calls.append(len(guidance))
        if len(guidance) > self.most:
            raise self.error
        depth = guidance.depth + 1
        return Completion(
            guidance.rgb, depth, np.ones_like(depth),
            np.zeros((*depth.shape, 6), np.float32) if self.rays else None,
        )  # fmt: skip


def guidance(count: int) -> Guidance:
    cameras = Cameras.pinhole(8, 6, focal=8.0)[[0] * count]
    shape = (count, 6, 8)
    valid = np.zeros(shape, bool)
    depth = np.broadcast_to(np.arange(count, dtype=np.float32)[:, None, None], shape).copy()
    return Guidance(
        cameras, np.zeros((*shape, 3), np.float32), depth, valid, np.zeros(shape, np.float32), valid
    )


ERRORS = (
    MemoryError(),
    RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
)


@pytest.mark.parametrize("error", ERRORS, ids=("python", "cuda", "cpu"))
@pytest.mark.parametrize("rays", [False, True])
def test_views_come_in_smaller_parts_and_in_order(error, rays):
    completer = Hungry(2, error, rays=rays)
    completion = run_completer(completer, (), guidance(7))
    np.testing.assert_array_equal(completion.depth[:, 0, 0], np.arange(7) + 1)
    assert completer.calls == [7, 3, 1, 2, 4, 2, 2]
    assert (completion.rays is not None) == rays


@pytest.mark.parametrize("error", ERRORS, ids=("python", "cuda", "cpu"))
def test_one_view_that_does_not_fit_is_one_line(error):
    said = r"completer hungry: memory does not suffice for one view of 8x6 .*--max-side 4"
    with pytest.raises(OptionError, match=said) as caught:
        run_completer(Hungry(0, error), (), guidance(3))
    assert not re.search("\n", str(caught.value))


def test_other_errors_are_no_lack_of_memory():
    completer = Hungry(0, RuntimeError("a shape is wrong"))
    with pytest.raises(RuntimeError, match="a shape is wrong"):
        run_completer(completer, (), guidance(4))
    assert completer.calls == [4]


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
    cameras = Cameras.alike(K, pose, size=(WIDTH, HEIGHT), names=names)
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
