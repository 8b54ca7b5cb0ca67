from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import geoverse_models as micro
import numpy as np
import pytest
import torch
from run_files import results, untimed
from tiny_scan import write_scan

from benchmarks.experiments import completion, poses
from benchmarks.experiments.classical import CLASSICAL
from benchmarks.experiments.options import ExperimentOptions
from gvtools.cameras import Cameras
from gvtools.completers import Completer, Completion, ContextView, ScaleStatus, create
from gvtools.completers.base import run_completer
from gvtools.completers.geoverse import completer as completer_module
from gvtools.completers.geoverse.completer import SHIPPED, GeoVerseCompleter
from gvtools.completers.geoverse.composition import GENERATED
from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.depth_scale import PassScale
from gvtools.completers.geoverse.model import Generated, GeoVerse
from gvtools.completers.geoverse.views import choose_views
from gvtools.completers.geoverse.weights import config_of
from gvtools.errors import CheckpointError, OptionError
from gvtools.guidance import Guidance
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.training.records import STAGES
from pipelines.cli import main

pytest.importorskip("safetensors", reason="weights are read with safetensors")


pytestmark = pytest.mark.usefixtures("unpainted")


def complete(
    weights: Path, context: list[ContextView], known: Guidance, *, seed: int = 0, **options: Any
) -> Completion:
    options = {"alignment": "hint", "device": "cpu", **options}
    return loaded(weights, **options).complete(context, known, seed=seed)


@cache
def loaded(weights: Path, **options: Any) -> Completer:
    completer = create("geoverse", weights=str(weights), **options)
    if options.keys().isdisjoint({"precision", "compile"}):
        # Read once for all options that do not change it.
        vars(completer)["model"] = model(weights)
    return completer


@cache
def model(weights: Path) -> GeoVerse:
    return GeoVerseCompleter(weights=str(weights), device="cpu").model


def statuses(result: Completion) -> list[ScaleStatus]:
    return [alignment.status for alignment in result.scale_alignment or () if alignment]


def after(patch: pytest.MonkeyPatch, look: Callable[..., Any], *, of: str = "generate") -> None:
    """Has ``look`` see, or change, what a method gave: the result, its arguments and options."""
    method = getattr(GeoVerse, of)

    def wrapper(self: GeoVerse, *args: Any, **options: Any) -> Any:
        made = method(self, *args, **options)
        look(made, *args, **options)
        return made

    patch.setattr(GeoVerse, of, wrapper)


def watched(monkeypatch: pytest.MonkeyPatch) -> list[tuple[ViewBatch, Any, Generated]]:
    seen: list[tuple[ViewBatch, Any, Generated]] = []
    after(monkeypatch, lambda made, batch, names, **_: seen.append((batch, names[0], made)))
    return seen


FIELDS = ("rgb", "depth", "valid", "confidence", "generated")
SIZES = [(30, 40), (24, 32), (17, 23), (9, 7), (64, 31), (1, 40), (100, 133)]


@pytest.mark.parametrize("size", SIZES)
def test_observed_pixels_are_kept_bit_for_bit_and_holes_are_filled(weights, size):
    context, known = micro.context_views(2), micro.guidance(2, size=size)
    result = complete(weights, context, known, alignment="centres" if min(size) < 20 else "hint")
    assert known.valid.any() and not known.valid.all()
    for name in ("rgb", "depth", "confidence"):
        found, given = getattr(result, name), getattr(known, name)
        assert found.dtype == np.float32
        assert found[known.valid].tobytes() == given[known.valid].tobytes(), name
    hole = ~known.valid
    assert result.rgb[hole].std() > 0.01 and result.rgb.min() >= 0 and result.rgb.max() <= 1
    assert np.isfinite(result.rgb).all() and np.isfinite(result.depth).all()
    confident = result.confidence[hole]
    assert (confident >= 0).all() and (confident <= GENERATED).all()
    assert ((result.depth[hole] > 0) == (confident > 0)).all()
    if min(size) >= 20:
        assert (result.depth[hole] > 0).all()
        assert 1 < np.median(result.depth[hole]) < 9
    assert result.rays is not None
    direction, moment = result.rays[..., :3], result.rays[..., 3:]
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, rtol=1e-4)
    np.testing.assert_allclose((direction * moment).sum(-1), 0, atol=1e-3)


def test_without_memory_the_model_sees_no_projection(weights, monkeypatch):
    seen = watched(monkeypatch)
    context, known = micro.context_views(2), micro.guidance(2, size=(24, 32))
    completer = create("geoverse", weights=str(weights), memory="false", output="views",
                       alignment="centres-alone")  # fmt: skip
    result = run_completer(completer, context, known)
    (batch, _, _), other = seen[0], micro.guidance(2, size=(24, 32), share=-1.0)
    assert batch.valid[:, :2].all()
    for image in (batch.valid, batch.images, batch.depth):
        assert not image[:, 2:].any()
    assert result.whole and np.array_equal(result.rgb, completer.complete(context, other).rgb)
    with pytest.raises(OptionError, match=r"give completer\.output=views too"):
        create("geoverse", weights=str(weights), memory=False)


def test_a_models_own_number_of_steps_has_its_own_times(weights, monkeypatch):
    given: list[dict[str, Any]] = []
    after(monkeypatch, lambda *_, **options: given.append(options))
    completer = GeoVerseCompleter(weights=str(weights), alignment="hint")
    own = (1.0, 0.3, 0.1, 0.0)
    completer.config = replace(
        completer.config, flow=replace(completer.config.flow, level1=own, cascade=(1.0, 0.5, 0.0))
    )
    for options, expected in (({}, own), ({"steps": 3}, own), ({"steps": 2}, (1.0, 0.5, 0.0))):
        completer.settings = completer.settings.replaced(**options)
        completer.complete(micro.context_views(1), micro.guidance(1))
        assert given[-1]["bounds"] == pytest.approx(expected)
        assert given[-1]["cascade_bounds"] == (1.0, 0.5, 0.0)


def test_whole_views_are_the_models_pixels_everywhere(weights, monkeypatch):
    seen = watched(monkeypatch)
    context, known = micro.context_views(2), micro.guidance(2, size=(24, 32))
    known.valid[1] = True
    known.rgb[1], known.depth[1], known.confidence[1] = 0.25, 3, 1
    completer = create("geoverse", weights=str(weights), alignment="hint", output="views")
    result = run_completer(completer, context, known)
    assert result.whole and len(seen) == 1
    decoded = seen[0][2].decoded.rgb[0].permute(0, 2, 3, 1).clamp(0, 1).numpy()
    np.testing.assert_allclose(result.rgb, decoded, atol=1e-6)
    assert (result.confidence <= GENERATED).all() and (result.depth > 0).all()
    kept = create("geoverse", weights=str(weights), alignment="hint").complete(context, known)
    assert not kept.whole and (kept.rgb[1] == 0.25).all()


def test_more_targets_than_a_pass_takes_go_through_several(weights, monkeypatch):
    seen = watched(monkeypatch)
    context, known = micro.context_views(3), micro.guidance(3)
    result = complete(weights, context, known, context_views=2, views=4)
    assert [(batch.images.shape[1], batch.context) for batch, _, _ in seen] == [(4, 2), (3, 2)]
    names = [name for _, names, _ in seen for name in names[2:]]
    assert names == [f"target {name}" for name in known.cameras.names]
    assert (result.depth[~known.valid] > 0).all()
    # Without these options it is the model's own numbers that count.
    seen.clear()
    complete(weights, micro.context_views(5), micro.guidance(1))
    assert seen[0][0].context == micro.CONFIG.context == 2
    # The context leaves room for one target at least.
    seen.clear()
    complete(weights, context, known, context_views=3, views=2)
    assert [(batch.images.shape[1], batch.context) for batch, _, _ in seen] == [(2, 1)] * 3


def test_views_without_holes_come_back_and_are_not_computed(weights, monkeypatch):
    seen = watched(monkeypatch)
    context, known = micro.context_views(1), micro.guidance(3)
    full = micro.guidance(3, share=1.1)
    parts = (known, full, known)
    rows = (np.stack([getattr(part, name)[i] for i, part in enumerate(parts)]) for name in FIELDS)
    mixed = Guidance(known.cameras, *rows)
    result = complete(weights, context, mixed)
    (_, names, _), = seen  # fmt: skip
    assert names == ["context photo_0_0", "target target_1_0", "target target_1_2"]
    for name in ("rgb", "depth", "confidence"):
        assert getattr(result, name)[1].tobytes() == getattr(mixed, name)[1].tobytes()
    expected = np.float32(mixed.cameras.plucker(1))
    assert result.rays is not None and result.rays[1].tobytes() == expected.tobytes()
    seen.clear()
    complete(weights, context, full)
    assert not seen
    nothing = Guidance(full.cameras[:0], *(getattr(full, name)[:0] for name in FIELDS))
    assert complete(weights, context, nothing).rgb.shape == (0, 30, 40, 3)


TURN = micro.rotation((0.3, 1.0, -0.4), 2.0)

WORLDS: dict[str, dict[str, Any]] = {
    "millimetres": {"scale": 1e3},
    "tiny": {"scale": 1e-7},
    "turned": {"turn": TURN},
    "far, turned, in millimetres": {"turn": TURN, "shift": (40.0, 1e3, -2e3), "scale": 1e3},
}


@cache
def two_views(weights: Path, alignment: str) -> Completion:
    return complete(weights, micro.context_views(2), micro.guidance(2), alignment=alignment)


@pytest.mark.parametrize(
    ("world", "alignment"),
    [*((world, "hint") for world in WORLDS), ("far, turned, in millimetres", "field")],
)
def test_neither_the_worlds_unit_nor_its_frame_matter(weights, alignment, world):
    moved = micro.moved(micro.context_views(2), micro.guidance(2), **WORLDS[world])
    expected, found = two_views(weights, alignment), complete(weights, *moved, alignment=alignment)
    scale = WORLDS[world].get("scale", 1.0)
    assert (expected.depth > 0).all()
    np.testing.assert_allclose(found.rgb, expected.rgb, atol=2e-4)
    np.testing.assert_allclose(found.depth, expected.depth * scale, rtol=5e-4)
    np.testing.assert_allclose(found.confidence, expected.confidence, atol=2e-4)


def test_a_pass_that_went_wrong_leaves_holes_and_says_so(weights, monkeypatch):
    def damage(made: Generated, *_: Any, **__: Any) -> None:
        made.decoded.rgb[:, 0, :, :8, :8] = torch.nan
        made.decoded.geometry.depth[:, -1] = torch.nan

    after(monkeypatch, damage)
    known = micro.guidance(2)
    result = complete(weights, micro.context_views(2), known, alignment="field")
    for name in ("rgb", "depth", "confidence"):
        assert np.isfinite(getattr(result, name)).all()
    hole = ~known.valid
    assert not result.depth[0, :6, :6][hole[0, :6, :6]].any()
    assert not result.confidence[1][hole[1]].any() and not result.depth[1][hole[1]].any()


@pytest.mark.filterwarnings("error")
def test_without_any_support_for_a_scale_there_is_no_depth(weights, monkeypatch):
    monkeypatch.setattr(
        "gvtools.completers.geoverse.composition.pass_scale",
        lambda *a, **k: PassScale(float("nan"), ScaleStatus.UNSUPPORTED),
    )
    known = micro.guidance(2, share=-1.0)
    result = complete(weights, micro.context_views(2), known)
    assert not result.depth.any() and not result.confidence.any() and result.rgb.any()
    assert statuses(result) == [ScaleStatus.UNSUPPORTED] * 2
    assert result.rays is not None
    np.testing.assert_array_equal(result.rays[1], np.float32(known.cameras.plucker(1)))


def true_rays(cameras: Cameras, unit: float, grid: tuple[int, int]) -> torch.Tensor:
    """(1, V, h, w, 6) what a perfect geometry head would say, in the first view's frame."""
    world_from_cam = cameras.cam_from_world[0] @ cameras.world_from_cam
    small = cameras.resized(grid[1], grid[0])
    maps = []
    for view, pose in enumerate(world_from_cam):
        origin = np.broadcast_to(pose[:3, 3] / unit, (*grid, 3))
        maps.append(np.concatenate((small.rays(view) @ pose[:3, :3].T, origin), axis=-1))
    return torch.from_numpy(np.stack(maps)).float()[None]


@pytest.mark.parametrize("world", [{}, {"turn": TURN, "shift": (4.0, -2.0, 9.0), "scale": 20.0}])
def test_predicted_rays_come_back_to_the_world(weights, monkeypatch, world):
    context, known = micro.moved(micro.context_views(2), micro.guidance(2, share=-1.0), **world)
    # Without any known depth, the centres alone give the scale.
    context = [replace(view, depth=None) for view in context]
    order = choose_views(context, known.cameras, known.depth, count=2, selection="nearest")

    def perfect(made: Generated, *_: Any, **__: Any) -> None:
        ray = made.decoded.geometry.ray
        ray.copy_(true_rays(micro.joined(order, known), 2.5, (ray.shape[2], ray.shape[3])))

    after(monkeypatch, perfect)
    result = complete(weights, context, known, alignment="centres")
    assert statuses(result) == [ScaleStatus.CAMERA_CENTRES] * 2
    assert result.rays is not None
    for view in range(2):
        expected = known.cameras.plucker(view)[4:-4, 4:-4]
        # Predicted in the first view's frame and another unit; the rim is extrapolated.
        np.testing.assert_allclose(result.rays[view][4:-4, 4:-4], expected, rtol=1e-3, atol=2e-3)


def test_steps_and_the_scale_of_guidance_are_the_options(weights, monkeypatch):
    calls: list[float] = []
    after(monkeypatch, lambda v, p, state, t, **_: calls.extend(t.tolist()), of="velocity1")
    context, known = micro.context_views(1), micro.guidance(1)
    for options, times in (
        ({}, [1, 2 / 3, 1 / 3]),
        ({"steps": 2}, [1, 0.5]),
        ({"steps": 2, "cfg_scale": 1.5}, [1, 1, 0.5, 0.5]),
    ):
        calls.clear()
        complete(weights, context, known, **options)
        assert sorted(calls, reverse=True) == pytest.approx(times)


def test_temperature_scales_the_noise_that_level_1_starts_from(weights, monkeypatch):
    states: list[Any] = []
    after(monkeypatch, lambda v, p, state, t, **_: states.append(state.clone()), of="velocity1")
    context, known = micro.context_views(1), micro.guidance(1)
    pictures = {}
    for temperature in (None, 1.0, 0.25, 0.0):
        options: dict[str, Any] = {} if temperature is None else {"temperature": temperature}
        pictures[temperature] = complete(weights, context, known, steps=1, **options).rgb
    own, whole, quarter, none = states
    assert torch.equal(own, whole) and whole.std() > 0.9
    assert torch.equal(quarter, 0.25 * whole) and not none.any()
    assert np.array_equal(pictures[None], pictures[1.0])
    assert not np.array_equal(pictures[None], pictures[0.25])
    with pytest.raises(OptionError, match=r"completer\.temperature"):
        create("geoverse", weights=str(weights), temperature=-1)


def test_half_precision_gives_nearly_the_same(weights):
    context, known = micro.context_views(2), micro.guidance(2)
    full = complete(weights, context, known, precision="float32")
    half = complete(weights, context, known, precision="bfloat16")
    error = np.abs(half.rgb - full.rgb)
    assert 0 < error.max() < 0.05
    np.testing.assert_allclose(half.depth, full.depth, rtol=0.05)


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("g++"), reason="needs a C++ compiler")
def test_compiled_blocks_give_the_same(weights):
    context, known = micro.context_views(2), micro.guidance(2)
    plain, compiled = (complete(weights, context, known, compile=c) for c in (False, True))
    np.testing.assert_allclose(compiled.rgb, plain.rgb, atol=1e-4)
    np.testing.assert_allclose(compiled.depth, plain.depth, rtol=1e-3)


def test_compiling_without_a_compiler_is_refused(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(OptionError, match=r"completer\.compile"):
        create("geoverse", compile=True)


@pytest.mark.parametrize(
    ("folder", "said"), [(None, "completer.weights=DIR"), ("absent", "gvtools weights list")]
)
def test_a_folder_that_is_not_there_is_refused_in_one_line_at_creation(
    folder, said, tmp_path, monkeypatch
):
    # As in an installation that was stripped of its weights.
    monkeypatch.setattr(completer_module, "SHIPPED", tmp_path / "nothing")
    with pytest.raises((OptionError, CheckpointError)) as refused:
        create("geoverse", weights=folder and str(tmp_path / folder))
    assert said in str(refused.value) and "\n" not in str(refused.value)


def test_weights_that_cannot_be_loaded_are_refused_before_anything_is_computed(weights, tmp_path):
    torn = tmp_path / "torn"
    shutil.copytree(weights, torn)
    file = torn / "geoverse.safetensors"
    file.write_bytes(file.read_bytes()[:-10])
    with pytest.raises(CheckpointError, match=r"geoverse\.safetensors"):
        create("geoverse", weights=str(torn))
    file.unlink()
    with pytest.raises(CheckpointError, match="absent"):
        create("geoverse", weights=str(torn))
    other = tmp_path / "other"
    shutil.copytree(weights, other)
    config = json.loads((other / "config.json").read_text())
    config["level1"]["depth"] += 1
    (other / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=r"missing: level1\.blocks\.6"):
        create("geoverse", weights=str(other))


def test_untrained_weights_are_said(tmp_path, weights):
    assert not GeoVerseCompleter(weights=str(weights)).notes
    plain = tmp_path / "plain"
    shutil.copytree(weights, plain)
    config = json.loads((plain / "config.json").read_text())
    (plain / "config.json").write_text(json.dumps({**config, "trained": False}))
    (note,) = GeoVerseCompleter(weights=str(plain)).notes
    assert "untrained" in note


OPTIONS = ("--context", "first:2", "--targets", "range:2-5", "--views-per-round", "2")


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    return write_scan(tmp_path_factory.mktemp("scan"))


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    return micro.weights_folder(tmp_path_factory.mktemp("weights") / "micro")


def reconstruct(scan: Path, weights: Path, out: Path, *words: str) -> int:
    given = ("--completer", "geoverse", "--set", f"completer.weights={weights}", "--quiet")
    return main(
        ["reconstruct", str(scan), "--refine", "0", "--out", str(out), *OPTIONS, *given, *words]
    )


@pytest.fixture(scope="module")
def whole(scan, tmp_path_factory) -> Path:
    """A run, the weights that it was made with beside it."""
    folder = tmp_path_factory.mktemp("whole")
    weights = micro.weights_folder(folder / "weights")
    assert reconstruct(scan, weights, folder / "run") == 0
    return folder / "run"


def test_a_run_names_its_weights_and_resumes_to_the_same_bytes(scan, whole, tmp_path):
    out = tmp_path / "run"
    rounds = untimed(whole)
    assert [entry["round"] for entry in rounds] == [0, 1, 2]
    assert len(SpatialMemory.load(whole / "memory.npz")) == rounds[-1]["points"] > 0
    assert len(json.loads((whole / "run.json").read_text(encoding="utf-8"))["weights"]) == 64
    shutil.copytree(whole, out)
    shutil.rmtree(out / "round_002")
    assert reconstruct(scan, whole.parent / "weights", out, "--resume") == 0
    assert results(out) == results(whole) and untimed(out) == rounds


def test_changed_weights_refuse_to_resume(scan, whole, tmp_path, capsys):
    weights, before = whole.parent / "weights", results(whole)
    shutil.copytree(weights, tmp_path / "own")
    try:
        micro.weights_folder(weights, seed=1)
        assert reconstruct(scan, weights, whole, "--resume") == 2
    finally:
        shutil.copytree(tmp_path / "own", weights, dirs_exist_ok=True)
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "another run (weights differ)" in said
    assert results(whole) == before


def test_it_is_small_and_brings_its_record():
    files = [path for path in SHIPPED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 30e6
    card = (SHIPPED / "MODEL_CARD.md").read_text(encoding="utf-8")
    for word in ("gvtools train tiny", "Seed 0", "Limits", "Figures", "Data"):
        assert word in card, word
    for stage in STAGES:
        settings = json.loads((SHIPPED / f"training_{stage}.json").read_text(encoding="utf-8"))
        lines = (SHIPPED / f"log_{stage}.jsonl").read_text(encoding="utf-8").splitlines()
        assert settings["seed"] == 0
        assert json.loads(lines[-1])["step"] == settings[stage]["optimizer"]["steps"]


def test_a_completer_without_weights_uses_it():
    completer = create("geoverse")
    assert isinstance(completer, GeoVerseCompleter)
    assert completer.folder == SHIPPED
    assert config_of(SHIPPED).trained and not completer.notes


@pytest.mark.slow
def test_its_rays_give_back_the_cameras_that_it_was_told():
    found, _ = poses.run(ExperimentOptions(scenes=3))
    figures = found["true pictures, cameras told"]
    assert figures["rotation_deg_median"] < 6
    assert figures["gain_over_first_view"] > 2


@pytest.mark.slow
def test_it_completes_held_out_rooms_better_than_the_usual_fillers():
    found, _ = completion.run(ExperimentOptions(scenes=3))
    rows = {row["method"]: row for row in found["against_best_other_filler"]}
    student = rows["student 3+1"]
    others = [rows[name] for name in CLASSICAL]
    assert student["depth"] < 0.8 * min(row["depth"] for row in others)
    assert student["psnr"] > max(row["psnr"] for row in others)
