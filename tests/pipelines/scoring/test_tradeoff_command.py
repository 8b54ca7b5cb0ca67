from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import arguments, refused
from tiny_scan import write_scan

from gvtools.runs.folder import folder_lock
from gvtools.settings import changes, with_texts, with_values
from pipelines.cli import main
from pipelines.commands.sweep import asked_for
from pipelines.reconstruction.settings import RunSettings
from pipelines.scoring import tradeoff
from pipelines.scoring.tradeoff import EQUAL, changed

# Another edge than the first guess, as if it had been measured.
WIDER = ("--set", "fusion.voxel_scale=1.25", "--set", "refine.seconds=0",
         "--set", "refine.poses=false")  # fmt: skip


def rows(folder: Path, name: str) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / f"{name}.csv").read_text().splitlines()))


@pytest.fixture(scope="module", autouse=True)
def fewer_values() -> Iterator[None]:
    """One value of each setting is tried, and no network."""
    with pytest.MonkeyPatch.context() as patch:
        real = tradeoff._values
        patch.setattr(
            tradeoff, "_values", lambda *plan: {key: some[:1] for key, some in real(*plan).items()}
        )
        yield


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    return write_scan(tmp_path_factory.mktemp("scan"))


@pytest.fixture(scope="module")
def swept(scan, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("sweep") / "out"
    command = ["tradeoff", str(scan), "--out", str(out), "--budget", "1h", "--quiet"]
    assert main([*command, *WIDER]) == 0
    return out


def test_a_sweep_leaves_table_front_plot_and_profile(swept):
    trials, front = (rows(swept, name) for name in ("trials", "front"))
    assert len(trials) == len(list((swept / "trials").iterdir())) > 12
    assert (swept / "front.png").read_bytes()[:4] == b"\x89PNG"
    psnr = [float(row["PSNR (dB)"]) for row in front]
    assert psnr and psnr == sorted(psnr)
    stored = {row["trial"]: float(row["observations"]) for row in trials}
    coarse = next(name for name in stored if name.startswith("voxel "))
    assert 1.2 * stored[coarse] < stored["start"]


@pytest.mark.parametrize("label", ["recommended", "profile accurate"])
def test_reconstruct_gives_the_figures_of_a_trial(scan, swept, tmp_path, label):
    tried = {row["trial"]: row for row in rows(swept, "trials")}
    if label == "recommended":
        best = max(float(row["PSNR (dB)"]) for row in tried.values())
        equal = [row for row in tried.values() if float(row["PSNR (dB)"]) >= best - EQUAL]
        trial = min(equal, key=lambda row: float(row["a run (s)"]))
        chosen = ["--config", str(swept / "profile.json")]
    else:
        trial = tried[label]
        chosen = ["--profile", "accurate", *WIDER]
    words = ["reconstruct", str(scan), "--refine", "0", "--set", "refine.poses=false"]
    words += ["--context", "every:2", "--targets", "every:2+1"]
    assert main([*words, "--out", str(tmp_path / "run"), "--quiet", *chosen]) == 0
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["observations"] == float(trial["observations"])
    assert found["psnr"] == pytest.approx(float(trial["PSNR (dB)"]), abs=1e-6)


@pytest.mark.parametrize("own", [[], ["max_side=200"], ["voxel=0.03", "profile=accurate"]])
def test_settings_of_ones_own_stand_over_every_profile(own, tmp_path):
    file = tmp_path / "given.json"
    file.write_text('{"profile": "accurate", "effort": {"inpaint_below": 0.07}}')
    words = ["tradeoff", "scan", "--out", "out", "--config", file]
    args = arguments(*words, *(word for text in own for word in ("--set", text)))
    start = asked_for(args)
    assert start.profile == "accurate" and start.memory.merge_angle_deg == 0
    for name in RunSettings.presets["profile"]:
        wanted = with_texts(
            with_values(RunSettings(), {"profile": name}), ["effort.inpaint_below=0.07"]
        )
        wanted = with_texts(wanted, [text for text in own if "profile" not in text])
        wanted = wanted.replaced(context=start.context, targets=start.targets)
        assert asked_for(args, name) == wanted, name
        # As a trial reaches it, from the start with the edge that it has.
        found = start.replaced(voxel=start.voxel or 0.02)
        tried = changed(found, changes(found, wanted))
        assert tried.replaced(profile=name) == wanted


def test_a_second_sweep_takes_over_what_is_there(scan, swept, capsys):
    before = {path: path.stat().st_mtime_ns for path in (swept / "trials").iterdir()}
    assert main(["tradeoff", str(scan), "--out", str(swept), "--budget", "0.01", *WIDER]) == 0
    captured = capsys.readouterr()
    assert "no trial is within the budget" in captured.err
    after = {path: path.stat().st_mtime_ns for path in (swept / "trials").iterdir()}
    assert all(after[path] == stamp for path, stamp in before.items())
    assert not (swept / "profile.json").exists()


def test_a_project_that_is_read_otherwise_is_tried_anew(scan, swept, capsys):
    before = set((swept / "trials").iterdir())
    arguments = ["tradeoff", str(scan), "--out", str(swept), "--limit", "1"]
    assert main([*arguments, "--depth-unit", "0.002", "--quiet", *WIDER]) == 0
    assert set((swept / "trials").iterdir()) - before
    assert "trials were left out for --limit" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--set", "targets=orbit:3"], "targets orbit:3: no views of the project"),
        (["--limit", "100MB"], "expected seconds"),
        (["--set", "splat.bandd=1"], "did you mean"),
        (["--set", "rounds=1"], "give fewer --targets"),
    ],
)
def test_what_cannot_be_swept_is_one_line(scan, tmp_path, capsys, more, said):
    assert said in refused(capsys, "tradeoff", scan, "--out", tmp_path / "x", *more)
    assert not (tmp_path / "x").exists()


def test_a_folder_takes_one_sweep_at_a_time(scan, tmp_path, capsys):
    out = tmp_path / "out"
    with folder_lock(out):
        assert "another process is at work" in refused(capsys, "tradeoff", scan, "--out", out)
