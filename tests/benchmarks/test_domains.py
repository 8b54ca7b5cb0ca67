from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from quake_map import room, write_archive
from tiny_scan import write_colmap_scan, write_scan

from benchmarks.experiments.baselines import (
    DISTANCES,
    FILLS,
    SHRINK_LENGTH,
    BlendCompleter,
    ShrunkInpaint,
    fit_blend,
)
from benchmarks.experiments.cases import held_out_cases
from benchmarks.experiments.domains import (
    DEPTH,
    LEVELS,
    PHOTOGRAPHS,
    ROOMS,
    SHIPPED,
    JudgedSet,
    verdict,
)
from benchmarks.experiments.generated_pixels import score
from benchmarks.experiments.judging import Judged
from benchmarks.experiments.scan_cases import scan_cases, splits
from gvtools.completers.base import create
from gvtools.errors import OptionError
from gvtools.scenes.project import open_project
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def cases():
    return list(held_out_cases(3, size=64, seed=4))


def test_the_shrink_draws_far_colours_to_the_mean_of_the_known(cases):
    case = cases[0]
    plain = create("inpaint").complete(case.context, case.guidance)
    made = ShrunkInpaint().complete(case.context, case.guidance)
    valid = case.guidance.valid[0]
    rows, columns = np.nonzero(~valid)
    known = np.argwhere(valid)
    for y, x in list(zip(rows, columns, strict=True))[:: max(1, len(rows) // 20)]:
        distance = np.sqrt(np.square(known - (y, x)).sum(1).min()) / np.hypot(64, 64)
        mean = case.guidance.rgb[0][valid].mean(0)
        expected = mean + np.exp(-distance / SHRINK_LENGTH) * (plain.rgb[0, y, x] - mean)
        np.testing.assert_allclose(made.rgb[0, y, x], expected, atol=1e-5)
    assert (made.rgb[case.guidance.valid] == case.guidance.rgb[case.guidance.valid]).all()
    assert made.depth.tobytes() == plain.depth.tobytes()


def test_a_fit_finds_weights_that_differ_by_fill_and_distance(cases):
    rng = np.random.default_rng(0)
    true = BlendCompleter(rng.uniform(0.1, 0.4, (len(FILLS), len(DISTANCES))))
    made = [
        replace(case, rgb=true.complete(case.context, case.guidance).rgb)
        for case in [*cases, *held_out_cases(1, size=64, seed=5)]
    ]
    *fitted, other = made
    found = BlendCompleter(fit_blend(fitted)).complete(other.context, other.guidance)
    plain = create("inpaint").complete(other.context, other.guidance)
    holes = other.generated
    before = np.square(plain.rgb - other.rgb)[holes].mean()
    after = np.square(found.rgb - other.rgb)[holes].mean()
    assert after < 0.02 * before


@pytest.mark.parametrize(("views", "rounds"), [(100, 1), (50, 1), (20, 2), (8, 1)])
def test_splits_give_enough_targets_apart_from_the_context(views, rounds):
    found = splits(views)
    assert len(found) == rounds
    for split in found:
        assert len(split.context) == len(set(split.context)) == 5
        assert not set(split.context) & set(split.targets)
        assert list(split.targets) == sorted(set(split.targets)) and split.targets[-1] < views
    total = sum(len(split.targets) for split in found)
    assert total >= 25 or views == 8
    with pytest.raises(OptionError, match="expected more than 5"):
        splits(5)


def test_a_recording_gives_a_case_for_each_target(tmp_path):
    scene = open_project(write_scan(tmp_path / "scan", views=8))
    found = list(scan_cases(scene, context=2, targets=4))
    assert len(found) == 4 and all(len(case.context) == 2 for case in found)
    for case in found:
        known = case.guidance.valid
        assert not (case.generated & known).any() and (case.generated | known).all()
        assert np.median(np.abs(case.guidance.rgb - case.rgb)[known]) < 0.02
        assert np.median(np.abs(case.guidance.depth / case.depth - 1)[known]) < 0.01
    # What one side of the square hides, and beyond the context's border.
    assert 0.005 < np.mean([case.generated.mean() for case in found]) < 0.5


def test_photographs_are_judged_by_colour_alone(tmp_path):
    scene = open_project(write_colmap_scan(tmp_path / "photographs", views=6))
    case = next(scan_cases(scene, context=2, targets=1))
    assert case.context[0].depth is not None and (case.context[0].depth > 0).any()
    assert not case.depth.any() and case.generated.any()


def of_errors(*errors: float) -> Judged:
    """One score an error of all pixels, without depth or distance."""
    truth, holes = np.full((1, 8, 8, 3), 0.5, np.float32), np.ones((1, 8, 8), bool)
    depth = np.zeros((1, 8, 8), np.float32)
    return Judged(
        [
            score(truth + np.float32(error), depth, true_rgb=truth, true_depth=depth,
                  generated=holes)
            for error in errors
        ]
    )  # fmt: skip


def judged_set(name: str, domain: str, *, better: bool) -> JudgedSet:
    errors = np.linspace(0.1, 0.3, 12)
    mine = 0.9 * errors if better else np.where(np.arange(12) % 2, 0.8, 1.25) * errors
    judged = {SHIPPED: of_errors(*mine), "fill": of_errors(*errors), "bad": of_errors(*3 * errors)}
    return JudgedSet(name, domain, 12, 12, judged)


def test_a_model_is_better_only_where_it_is_on_three_domains_and_on_all_their_sets():
    sets = [
        judged_set("rooms", ROOMS, better=True),
        judged_set("levels", LEVELS, better=True),
        judged_set("kitchen", DEPTH, better=True),
        judged_set("fox", PHOTOGRAPHS, better=True),
        judged_set("fern", PHOTOGRAPHS, better=False),
    ]
    found = verdict(sets, SHIPPED, ("fill", "bad"))
    assert found.better and found.won == (ROOMS, LEVELS, DEPTH)
    assert found.lost == {PHOTOGRAPHS: "fill on fern"}
    assert "better than fill, bad" in str(found) and "3 of 4 domains" in str(found)
    few = verdict([*sets[:2], *sets[3:]], SHIPPED, ("fill", "bad"))
    assert not few.better and few.won == (ROOMS, LEVELS)
    assert "NOT better" in str(few)
    assert "unsettled" in str(verdict(sets[:2], SHIPPED, ("fill", "bad")))


@pytest.mark.slow
def test_domains_end_to_end_with_a_model_to_judge(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.experiments.domains.FITTED", 2)
    torch.set_num_threads(1)
    steps = [f"{name}.optimizer.steps=2" for name in ("encoder", "denoiser", "reflow")]
    settings = [part for text in (*steps, "encoder.statistics=1") for part in ("--set", text)]
    options = ["--sheets", "0", "--quiet", "--device", "cpu"]
    assert main(["train", "micro", "--out", str(tmp_path / "t"), *options, *settings]) == 0
    levels = write_archive(tmp_path / "levels", {"room": room()})
    scan = write_scan(tmp_path / "scan", views=8)
    arguments = ["experiment", "domains", "--scenes", "2", "--size", "48", "--quiet"]
    arguments += ["--weights", str(tmp_path / "t" / "reflow" / "weights")]
    arguments += ["--levels", str(levels), "--projects", str(scan), "--pictures", str(tmp_path)]
    tables, figures = tmp_path / "tables.md", tmp_path / "figures.json"
    arguments += ["--markdown", str(tables), "--json", str(figures)]
    assert main(arguments, modules={"experiment": "benchmarks.experiments.command"}) == 0
    found = json.loads(figures.read_text())
    assert [each["domain"] for each in found["sets"]] == [ROOMS, LEVELS, DEPTH]
    assert [each["cases"] for each in found["sets"]] == [2, 1, 3]
    for each in found["sets"]:
        rows = {row["method"]: row for row in each["results"]}
        assert len(rows) == 6 and all(np.isfinite(row["psnr_view"]) for row in rows.values())
        assert set(rows["inpaint"]["difference"]["psnr_view"]) == {"to", "by"}
    assert [each["model"] for each in found["verdicts"]] == [SHIPPED, "geoverse, --weights"]
    assert "geoverse: " in tables.read_text()
    sheet = np.asarray(Image.open(tmp_path / "domains.png"))
    assert sheet.shape[1] == 8 * (112 + 4) and sheet.shape[0] > 112
