from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import geoverse_models as micro
import numpy as np
import pytest
import torch
from training_runs import sets

from benchmarks.experiments.cases import held_out_cases
from benchmarks.experiments.classical import CLASSICAL, classical
from benchmarks.experiments.judging import COLUMNS, best, judge, records, table
from benchmarks.experiments.rows import FILL, HINTS, INPAINT, with_heads_of
from gvtools.completers import Completer, Completion
from gvtools.completers.geoverse import from_pretrained
from gvtools.completers.geoverse.weights import save_pretrained
from gvtools.guidance import Guidance
from pipelines.cli import main as run_command

pytestmark = pytest.mark.usefixtures("one_thread")


def main(argv: list[str]) -> int:
    return run_command(argv, modules={"experiment": "benchmarks.experiments.command"})


@pytest.fixture(scope="module")
def cases():
    return list(held_out_cases(2, size=64))


def test_cases_are_held_out_scenes_with_holes_and_truth(cases):
    again = next(iter(held_out_cases(1, size=64)))
    first = cases[0]
    assert first.guidance.rgb.tobytes() == again.guidance.rgb.tobytes()
    assert len(first.context) + len(first.guidance) == 8
    assert 0.02 < np.mean([case.generated.mean() for case in cases]) < 0.98
    assert (first.depth > 0).all() and first.rgb.max() <= 1
    # The memory's pixels show the truth, roughly: targets and truth are in one order.
    known = ~first.generated
    assert np.median(np.abs(first.guidance.rgb - first.rgb)[known]) < 0.08
    assert np.median(np.abs(first.guidance.depth / first.depth - 1)[known]) < 0.05


@pytest.mark.parametrize("name", CLASSICAL)
def test_fillers_keep_what_is_known_and_fill_the_rest(cases, name):
    guidance = cases[1].guidance
    assert not guidance.valid.all()
    made = classical(name).complete(cases[1].context, guidance)
    valid = guidance.valid
    assert (made.rgb[valid] == guidance.rgb[valid]).all()
    assert (made.depth[valid] == guidance.depth[valid]).all()
    some = valid.any(axis=(1, 2))
    assert (made.depth[some] > 0).all() and np.isfinite(made.depth).all()
    assert made.rgb.min() >= 0 and made.rgb.max() <= 1


def test_a_plane_is_continued_in_depth_and_a_flat_colour_in_colour(cases):
    guidance = cases[0].guidance[0]
    valid = np.ones_like(guidance.valid)
    valid[:, 20:40, 20:40] = False
    flat = Guidance(
        guidance.cameras,
        np.repeat(np.where(valid[..., None], np.float32(0.3), 0), 3, -1).astype(np.float32),
        np.where(valid, np.float32(2.5), 0).astype(np.float32),
        valid,
        valid.astype(np.float32),
        np.zeros_like(valid),
    )
    for name in CLASSICAL:
        made = classical(name).complete((), flat)
        np.testing.assert_allclose(made.rgb, 0.3, atol=0.004, err_msg=name)
        np.testing.assert_allclose(made.depth, 2.5, rtol=0.01, err_msg=name)


def test_the_truth_wins_every_figure(cases):
    class Truth(Completer):
        name = "truth"

        def complete(self, context, guidance, *, seed=0):
            case = next(c for c in cases if c.guidance is guidance)
            return Completion(case.rgb, case.depth, np.ones_like(case.depth))

    judged = judge({"nearest": classical("nearest"), "truth": Truth()}, cases, distance=None)
    for figure in ("psnr", "psnr_view", "depth", "energy"):
        assert best(judged, judged, figure) == "truth", figure
    against = dict.fromkeys(COLUMNS, "truth")
    found = {row["method"]: row for row in records(judged, against=against)}
    assert found["truth"]["energy"] == pytest.approx(1)
    assert found["nearest"]["difference"]["psnr"]["by"][2] < 0
    shown = table(judged, caption="two", against=against)
    assert [row[0] for row in shown.rows] == ["nearest", "truth"]


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("training")
    torch.set_num_threads(1)
    settings = sets(
        *(f"{name}.optimizer.steps=2" for name in ("encoder", "denoiser", "reflow")),
        "encoder.statistics=1",
        "data.pool=8",
        f"data.cache={out / 'pool'}",
    )
    options = ["--out", str(out), "--sheets", "0", "--quiet", "--device", "cpu"]
    assert run_command(["train", "micro", *options, *settings]) == 0
    return out


def experiment(name: str, weights: Path, tmp_path: Path, *more: str) -> dict:
    out = tmp_path / "figures.json"
    student = str(weights / "reflow" / "weights")
    arguments = ["experiment", name, "--weights", student]
    if name != "real-frames":
        arguments += ["--scenes", "2", "--size", "48"]
    assert main([*arguments, "--json", str(out), "--quiet", *more]) == 0
    return json.loads(out.read_text())


@pytest.mark.slow
def test_completion_compares_fillers_student_and_teacher(weights, tmp_path):
    teacher = str(weights / "denoiser" / "weights")
    tables = tmp_path / "tables.md"
    found = experiment(
        "completion", weights, tmp_path, "--teacher", teacher, "--markdown", str(tables)
    )
    rows = {row["method"]: row for row in found["against_best_filler"]}
    assert {*CLASSICAL, INPAINT, FILL, HINTS, "student 3+1", "teacher 24+1"} < set(rows)
    assert all(np.isfinite(row["psnr"]) for row in rows.values())
    assert rows["student 3+1"]["difference"]["depth"]["to"] in (*CLASSICAL, INPAINT)
    others = {row["method"]: row for row in found["against_best_other_filler"]}
    assert others["student 3+1"]["difference"]["depth"]["to"] in CLASSICAL
    # Undenoised features are decoded, which the fill alone is not.
    assert rows[HINTS]["psnr"] != rows[FILL]["psnr"]
    others = {row["method"]: row for row in found["against_teacher"]}
    assert set(others["student 3+1"]["difference"]["psnr"]) == {"to", "by"}
    assert others["student 3+1"]["difference"]["psnr"]["to"] == "teacher 24+1"
    assert "| student 3+1 |" in tables.read_text()


@pytest.mark.slow
def test_poses_compares_with_constant_answers(weights, tmp_path):
    found = experiment("poses", weights, tmp_path)["true pictures, cameras told"]
    assert 0 <= found["rotation_deg_median"] <= 180
    # Lengths are in mean context depths, so that the path's own is a fraction of one.
    assert 0.01 < found["centre_if_mean_of_truth"] <= found["centre_if_first_view"] < 3


def test_an_experiment_without_what_it_needs_is_one_line(tmp_path, capsys):
    assert main(["experiment", "ablations", "--scenes", "1"]) == 2
    assert "needs --out" in capsys.readouterr().err
    assert main(["experiment", "completion", "--scenes", "0"]) == 2
    assert "expected at least 1" in capsys.readouterr().err
    assert main(["experiment", "poses", "--teacher", "x", "--pictures", "y"]) == 2
    assert "poses does not look at --pictures, --teacher" in capsys.readouterr().err
    absent = str(tmp_path / "absent")
    assert main(["experiment", "poses", "--weights", absent]) == 2
    assert absent in capsys.readouterr().err


def test_a_teacher_is_judged_with_the_students_heads(tmp_path):
    """Its own denoisers, so that heads that were trained later are not taken for distillation."""
    config = replace(micro.CONFIG, trained=False)
    student, teacher = micro.model(replace(config, trained=True)), micro.model(config)
    before = tmp_path / "teacher"
    save_pretrained(teacher, before)
    with torch.no_grad():
        for parameter in student.parameters():
            parameter.add_(1)
    save_pretrained(student, tmp_path / "student")
    with with_heads_of(before, tmp_path / "student") as merged:
        found = from_pretrained(merged)
        assert found.config.trained
        states = student.state_dict(), teacher.state_dict()
        for name, tensor in found.state_dict().items():
            other = states[0 if name.startswith(("rgb_head.", "geometry.head.")) else 1]
            assert torch.equal(tensor, other[name]), name
    assert not merged.exists()


@pytest.mark.slow
def test_long_sequences_follow_memory_and_its_absence(weights, tmp_path):
    found = experiment("long-sequences", weights, tmp_path, "--size", "96", "--scenes", "1")
    arms = found["results"]
    assert {len(rounds) for rounds in arms.values()} == {3}
    with_memory = arms["student 3+1, with memory"]
    without = arms["student 3+1, without memory"]
    assert with_memory[0]["psnr"] > without[0]["psnr"] + 3


@pytest.mark.slow
def test_ablations_train_their_variants_and_test_them(weights, tmp_path):
    pytest.importorskip("diffusers", reason="the extra wan is not installed")
    from benchmarks.experiments.ablations import VARIANTS

    student = str(weights / "encoder" / "weights")
    out = tmp_path / "figures.json"
    arguments = ["experiment", "ablations", "--weights", student, "--scenes", "1", "--size", "48"]
    arguments += ["--steps", "1", "--out", str(tmp_path / "trainings"), "--json", str(out)]
    assert main([*arguments, "--training", "micro", "--quiet"]) == 0
    rows = json.loads(out.read_text())["results"]
    assert [row["method"] for row in rows] == list(VARIANTS)


@pytest.mark.slow
def test_a_scan_is_judged_by_tuned_weights_too(weights, shared, tmp_path):
    scan, tuned = str(shared / "data" / "sevenscenes_reg"), str(tmp_path / "tuned")
    tune = ["train", "tune", "--scene", scan, "--context", "every:20", "--steps", "2", "--quiet"]
    assert run_command([*tune, "--init", str(weights / "reflow" / "weights"), "--out", tuned]) == 0
    found = experiment(
        "real-frames", weights, tmp_path, "--project", scan,
        "--tuned", tuned, "--pictures", str(tmp_path / "pictures"),
    )  # fmt: skip
    rows = [row["method"] for row in found["against_best_filler"]]
    assert "tuned 3+1" in rows and "biharmonic" not in rows
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 5


@pytest.mark.slow
def test_step_sweeps_say_which_bounds_they_take(weights, tmp_path):
    found = experiment("few-steps", weights, tmp_path, "--scenes", "1")
    rows = [row["method"] for row in found["student, level 1"]]
    assert rows[0] == "3+1, own bounds" and "3+1, equal steps" in rows and len(rows) == 8
    assert len(found["student, cascade"]) == 5
