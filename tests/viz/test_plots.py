from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_line import refused
from PIL import Image
from scipy.spatial.transform import Rotation

from gvtools.errors import OptionError
from pipelines.cli import main
from viz.plots.canvas import png
from viz.plots.curves import draw_losses, draw_pareto, loss_names, running_median
from viz.plots.rounds import draw_growth, draw_quality, draw_timing, growth_text, stage_seconds
from viz.plots.trajectories import Trajectories, draw_trajectories, principal_axes

RNG = np.random.default_rng(0)


def rounds(count: int = 3) -> list[dict]:
    return [
        {
            "round": k,
            "points": 1000 + 200 * k,
            "voxels": 600 + 150 * k,
            "added": 1000 if k == 0 else 200,
            "merged": 300 if k == 0 else 40,
            "rejected": 0 if k == 0 else 25,
            "observed": 1000,
            "generated": 200 * k,
            "coverage_before": None if k == 0 else 0.5 + 0.1 * k,
            "coverage_after": None if k == 0 else 0.7 + 0.1 * k,
            "seconds": {"depth": 0.1, "fuse": 0.5, "project": 0.2, "complete": 1.0, "align": 0.0},
            "bytes": 50_000,
        }
        for k in range(count)
    ]


def points(axes: Any, label: str) -> np.ndarray:
    dots = next(dots for dots in axes.collections if str(dots.get_label()).startswith(label))
    return np.asarray(dots.get_offsets())


def poses(centres: np.ndarray) -> np.ndarray:
    """Upright cameras (y down, so that world y is down) at the centres, looking along z."""
    out = np.tile(np.eye(4), (len(centres), 1, 1))
    out[:, :3, 3] = centres
    return out


def moved(world_from_cam: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, shift
    return motion @ world_from_cam


def test_dollar_signs_in_names_are_no_formulas():
    name = "proj $x_{$"
    with_sign, without = (
        png(draw_growth(rounds(), title=title, panels=["time"]), dpi=40)
        for title in (name, "proj x_{")
    )
    assert with_sign != without
    records = [{"step": k, "loss": 1.0, name: 2.0} for k in range(3)]
    assert png(draw_losses({"stage $^$": records}, title=name))


def test_the_bars_of_the_stages_sum_up_to_the_run():
    told = [{**entry, "seconds": {**entry["seconds"], "total": 2.5}} for entry in rounds()]
    told[1]["seconds"]["refine"] = 0.2
    stages = stage_seconds(told)
    assert list(stages) == ["depth", "fuse", "project", "complete", "refine", "other"]
    assert stages["other"] == pytest.approx([0.7, 0.5, 0.7])
    axes: Any = draw_timing(told, panels=["stages"]).axes[0]
    assert sum(bar.get_width() for bar in axes.patches) == pytest.approx(7.5)
    assert axes.get_xlabel() == "seconds"
    axes = draw_timing(told, panels=["rounds"]).axes[0]
    assert sum(bar.get_height() for bar in axes.patches) == pytest.approx(7.5)


def test_up_and_right_are_found_in_any_world_frame():
    """What is drawn of cameras does not depend on the frame that they are given in."""
    centres = np.stack([np.linspace(-2, 2, 9), 0.1 * RNG.normal(size=9), RNG.normal(size=9)], 1)
    flat = poses(centres * [1, 1, 0.2])
    axes = principal_axes(flat, flat)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[2], [0, -1, 0], atol=1e-12)
    rotation = Rotation.random(random_state=3).as_matrix()
    turned = moved(flat, rotation, np.array([5.0, -3, 2]))
    np.testing.assert_allclose(principal_axes(turned, turned), axes @ rotation.T, atol=1e-9)
    one, other = (
        points(draw_trajectories(Trajectories(p, p[:2]), panels=["top"]).axes[0], "context")
        for p in (flat, turned)
    )
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_from_above_right_is_right_and_forward_is_up():
    centres = np.array([[-2.0, 0, 0], [2, 0, 0], [0, 0, 1], [0, -1, 0]])
    top: Any
    side: Any
    top, side = draw_trajectories(Trajectories(poses(centres), poses(centres[2:3]))).axes
    middle = np.concatenate([centres, centres[2:3]]).mean(axis=0)
    expected = centres - middle
    np.testing.assert_allclose(points(top, "context"), expected[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(points(side, "context"), expected[:, [0, 1]] * [1, -1], atol=1e-9)
    assert [top.get_xlabel(), top.get_ylabel(), side.get_ylabel()] == [
        "right, scene units", "forward, scene units", "up, scene units"
    ]  # fmt: skip


def test_estimated_poses_that_were_not_found_are_counted():
    requested = poses(RNG.normal(size=(5, 3)))
    estimated = requested.copy()
    estimated[2] = np.nan
    axes: Any = draw_trajectories(
        Trajectories(np.zeros((0, 4, 4)), requested, estimated), panels=["side"]
    ).axes[0]
    assert points(axes, "estimated").shape == (4, 2)
    assert "4 of 5 located" in axes.get_legend().get_texts()[-1].get_text()


@pytest.mark.parametrize(
    "centres",
    [np.zeros((1, 3)), np.zeros((4, 3)), np.array([[0.0, 0, 0], [0, -1, 0]]) + 4e6],
    ids=["one", "at one place", "straight up and far away"],
)
def test_cameras_that_spread_in_no_plane_still_draw(centres):
    axes = principal_axes(poses(centres), poses(centres))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
    png(draw_trajectories(Trajectories(poses(centres), poses(centres))), dpi=40)


def test_the_running_median_is_that_of_each_neighbourhood():
    values = RNG.normal(size=40)
    values[7] = np.nan
    expected = [np.nanmedian(values[max(0, i - 2) : i + 3]) for i in range(40)]
    np.testing.assert_allclose(running_median(values, 5), expected)
    np.testing.assert_array_equal(running_median(values, 1), values)


def test_each_stage_of_a_training_shows_its_losses():
    records = [
        {"step": 10 * k, "loss": 2.0 / k, "rgb": 1.0 / k, "ray": 0.1 - 0.01 * k, "rate": 1e-4,
         "seconds": k, "rgb_psnr": 20.0, "rgb_pixels": 9.0, "gradient_norm": 1.0, "skipped": 0}
        for k in range(1, 30)
    ]  # fmt: skip
    assert loss_names(records) == ["loss", "ray", "rgb"]
    panels: Any = draw_losses({"encoder": records, "denoiser": records[:1]}).axes
    assert [axes.get_title() for axes in panels] == ["encoder", "denoiser"]
    raw = panels[0].lines[0]
    np.testing.assert_allclose(raw.get_xdata(), [r["step"] for r in records])
    np.testing.assert_allclose(raw.get_ydata(), [r["loss"] for r in records])
    assert panels[0].get_xlabel() == "training step"
    assert "loss" in panels[0].get_ylabel()
    # A part of the loss is negative in the first stage alone.
    assert [axes.get_yscale() for axes in panels] == ["symlog", "log"]
    with pytest.raises(OptionError, match="no record with a loss"):
        draw_losses({"encoder": [{"step": 1, "rate": 0.1}]})


def test_quality_draws_each_target_and_the_means():
    views: list[dict[str, Any]] = [
        {"round": 1, "psnr": 20.0, "psnr_generated": None},
        {"round": 1, "psnr": 30.0, "psnr_generated": 10.0},
        {"round": 2, "psnr": 18.0, "psnr_generated": None},
    ]
    axes: Any = draw_quality(views).axes[0]
    assert [line.get_label() for line in axes.lines] == ["whole", "generated"]
    np.testing.assert_allclose(axes.lines[0].get_xydata(), [[1, 25], [2, 18]])
    np.testing.assert_allclose(axes.collections[1].get_offsets(), [[1, 10]])
    assert axes.get_ylabel() == "PSNR, dB"


def test_a_front_over_time():
    def trial(label: str, seconds: float) -> SimpleNamespace:
        return SimpleNamespace(label=label, seconds=seconds, psnr=20.0)

    trials = [trial("start", 2.0), trial("profile fast", 7.0)]
    figure: Any = draw_pareto(trials, front=trials[:1], chosen=trials[0], budget=4.0)
    (axes,) = figure.axes
    *marks, budget = axes.lines
    xy = {line.get_label(): line.get_xydata().tolist() for line in marks}
    assert xy == {"trial": [[2, 20]], "profile": [[7, 20]], "front": [[2, 20]],
                  "recommended": [[2, 20]]}  # fmt: skip
    assert budget.get_label() == "budget 4" and axes.get_xscale() == "log"
    assert axes.get_ylabel() == "PSNR, dB, whole pictures"


@pytest.mark.parametrize("kind", ["growth", "coverage", "timing", "trajectories", "frames"])
def test_each_figure_of_a_run_from_the_command_line(small_run, tmp_path, kind):
    assert main(["plot", kind, str(small_run), "--out", str(tmp_path / "f.png"), "--quiet"]) == 0
    assert np.asarray(Image.open(tmp_path / "f.png").convert("L")).std() > 10


def test_losses_of_a_training_and_of_one_stage(tmp_path):
    stage = tmp_path / "mine" / "encoder"
    stage.mkdir(parents=True)
    lines = [json.dumps({"step": k, "loss": 1 / k}) for k in (1, 2, 3)]
    (stage / "log.jsonl").write_text("\n".join(lines))
    for folder, ending in ((stage.parent, "svg"), (stage, "pdf")):
        out = tmp_path / f"losses.{ending}"
        assert main(["plot", "losses", str(folder), "--out", str(out), "--quiet"]) == 0
        start = {"svg": b"<?xml", "pdf": b"%PDF"}[ending]
        assert out.read_bytes().startswith(start)


def test_what_cannot_be_drawn_is_refused(small_run, tmp_path, capsys):
    out = tmp_path / "f.png"
    assert "log.jsonl" in refused(capsys, "plot", "losses", tmp_path, "--out", out)
    assert "run.json" in refused(capsys, "plot", "growth", tmp_path, "--out", out)
    assert ".svg" in refused(capsys, "plot", "growth", small_run, "--out", tmp_path / "f.bmp")
    assert not list(tmp_path.iterdir())


def heights(axes, label):
    container = next(c for c in axes.containers if c.get_label() == label)
    return [patch.get_height() for patch in container]


def test_the_bars_are_the_figures():
    panels: list[Any] = draw_growth(rounds(), title="room").axes
    stored, fates, coverage, times = panels
    assert [axes.get_ylabel() for axes in panels] == [
        "observations, voxels", "points, voxels (logarithmic)", "coverage, % of pixels", "seconds",
    ]  # fmt: skip
    assert heights(stored, "observed") == [1000, 1000, 1000]
    assert heights(stored, "generated") == [0, 200, 400]
    assert list(stored.lines[0].get_ydata()) == [600, 750, 900]
    assert heights(fates, "added") == [1000, 200, 200]
    assert heights(fates, "merged") == [300, 40, 40]
    assert heights(fates, "rejected") == [0, 25, 25]
    assert heights(fates, "new voxels") == [600, 150, 150]
    before, after = (np.asarray(dots.get_offsets()) for dots in coverage.collections[1:])
    np.testing.assert_allclose(before, [[1, 60], [2, 70]])
    np.testing.assert_allclose(after, [[1, 80], [2, 90]])
    assert sum(bar.get_height() for bar in times.patches) == pytest.approx(3 * 1.8)


def test_the_text_fits_and_tells_the_same():
    text = growth_text(rounds())
    lines = text.splitlines()
    assert max(map(len, lines)) <= 72
    bars = lines[1:4]
    assert [bar.count("+") > 0 for bar in bars] == [False, True, True]
    observed = [bar.count("#") for bar in bars]
    assert max(observed) - min(observed) <= 1
    assert bars[2].count("+") / bars[2].count("#") == pytest.approx(0.4, abs=0.05)
    assert "60.0% -> 80.0%" in bars[1]
    assert "200 added, 40 merged, 25 rejected, 150 new voxels" in lines[5]
