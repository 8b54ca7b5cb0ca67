from __future__ import annotations

import json
import shutil
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_line import refused
from PIL import Image
from scipy.spatial.transform import Rotation

from gvtools.errors import OptionError
from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.cli import main
from pipelines.viewing.source import ViewSource
from viz.plots.canvas import COLORS, GREY, png
from viz.plots.curves import draw_losses, draw_pareto, loss_names, running_median
from viz.plots.rounds import draw_growth, draw_quality, draw_timing, growth_text, stage_seconds
from viz.plots.trajectories import Trajectories, draw_trajectories, principal_axes
from viz.viewer.colors import MODES, VIRIDIS, depth_errors, point_colors, view_counts
from viz.viewer.render import RunRenderer, picture_of
from viz.viewer.run_view import CONTEXT, TARGET, detail
from viz.viewer.standpoint import guess_up

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


@pytest.fixture(scope="module")
def run(small_run):
    return ViewSource(small_run).read()


def rgb(color):
    return [int(color[k : k + 2], 16) for k in (1, 3, 5)]


def test_counts_are_those_of_the_rounds_and_of_the_memory_itself(run, small_run):
    lines = [json.loads(line) for line in (small_run / "rounds.jsonl").read_text().splitlines()]
    assert run.last_round == 2 and run.whole
    bare = ViewSource(small_run / "memory.npz").read()
    for number, line in enumerate(lines):
        expected = (line["observed"], line["generated"])
        for shown in (run, bare):
            counts = shown.counts(number)
            assert (counts.observed, counts.generated) == expected
    assert lines[2]["generated"] > lines[1]["generated"] > 0


def test_cameras_are_the_context_and_the_targets_with_their_rounds(run):
    kinds = [(shown.kind, shown.round) for shown in run.cameras]
    assert kinds == [(CONTEXT, 0)] * 3 + [(TARGET, 1)] * 2 + [(TARGET, 2)] * 2
    assert run.cameras[3].name == "frame-000004.color.png"
    # The walk's cameras hold -y to be up.
    np.testing.assert_allclose(run.up(), [0, -1, 0], atol=1e-6)


def test_pictures_are_the_rounds_files_and_the_projects_truth(run, small_run):
    target = run.cameras[3]
    pictures = run.pictures(target)
    assert list(pictures) == ["guidance", "completion", "memory after", "truth"]
    stored = Image.open(small_run / "round_001" / f"generated_{target.stem}.png")
    np.testing.assert_array_equal(pictures["completion"], np.array(stored))
    truth = Image.open(small_run.parent / "scan" / target.name)
    np.testing.assert_array_equal(pictures["truth"], np.array(truth))
    assert list(run.pictures(run.cameras[0])) == ["truth"]


def test_a_run_whose_project_is_gone_shows_what_it_has(small_run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(small_run, copy)
    record = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps({**record, "project": str(tmp_path / "gone")}))
    source = ViewSource(copy)
    shown = source.read()
    assert "truth" not in shown.pictures(shown.cameras[3])
    assert "gone" in str(source.lacking())
    # Told where the project lies now, it has them again.
    moved = ViewSource(copy, project=small_run.parent / "scan").read()
    assert "truth" in moved.pictures(moved.cameras[3])


@pytest.mark.parametrize("mode", list(MODES))
def test_every_mode_colours_every_point_and_says_how_to_read_it(run, mode):
    count = len(run.memory)
    whole = point_colors(run.memory, mode, true_depth=run.recorded_depth)
    rows = np.arange(0, count, 7)
    some = point_colors(run.memory, mode, rows=rows, true_depth=run.recorded_depth)
    assert whole.rgb.shape == (count, 3) and whole.rgb.dtype == np.uint8
    np.testing.assert_array_equal(whole.rgb[rows], some.rgb)
    assert whole.legend.text


def test_colours_say_what_is_so(run):
    memory = run.memory
    made = memory.generated
    np.testing.assert_array_equal(
        point_colors(memory, "color").rgb, memory.columns.colors[: len(memory)]
    )
    source = point_colors(memory, "source").rgb.astype(int)
    # Blue stands out where observed, red over blue where generated.
    assert (source[~made, 2] > source[~made, 0]).all() and (source[made, 0] > source[made, 2]).all()
    by_round = point_colors(memory, "round").rgb
    rounds = run.round_of_points()
    assert (by_round[rounds == 0] == rgb(GREY)).all()
    assert (by_round[rounds == 2] == rgb(VIRIDIS[-1])).all()
    confidence = point_colors(memory, "confidence").rgb.astype(int)
    order = np.argsort(memory.confidence)
    # Viridis grows in green from end to end.
    assert (np.diff(confidence[order, 1]) >= 0).all()
    assert {color for color, _ in point_colors(memory, "source").legend.swatches} == {
        COLORS["observed"], COLORS["generated"],
    }  # fmt: skip


def test_views_of_a_voxel_are_counted(run):
    memory = run.memory
    voxel = np.floor(memory.columns.positions * (1.0 / memory.voxel)).astype(int)
    view = memory.columns.view[: len(memory)]
    seen: dict = {}
    for place, number in zip(map(tuple, voxel.tolist()), view.tolist(), strict=True):
        seen.setdefault(place, set()).add(number)
    expected = [len(seen[place]) for place in map(tuple, voxel.tolist())]
    np.testing.assert_array_equal(view_counts(memory), expected)
    assert max(expected) > 1


def test_depth_errors_are_those_that_were_put_in(run):
    rows = np.arange(len(run.memory))
    errors = depth_errors(run.memory, rows, run.recorded_depth)
    context = ~run.memory.generated
    # A wall and a square, recorded to the millimetre and averaged within voxels.
    assert np.nanmedian(errors[context]) < 0.005

    def a_tenth_farther(name):
        depth = run.recorded_depth(name)
        return None if depth is None else depth * np.float32(1.1)

    wrong = depth_errors(run.memory, rows, a_tenth_farther)
    assert np.nanmedian(wrong[context]) == pytest.approx(0.1 / 1.1, abs=0.005)
    nothing = depth_errors(run.memory, rows, lambda name: None)
    assert np.isnan(nothing).all()


def test_what_is_drawn_is_even_and_does_not_change_as_the_memory_grows(run, small_run):
    memory = run.memory
    everything = detail(memory, len(memory))
    assert everything.edge == 0 and len(everything.rows) == len(memory)
    drawn = detail(memory, 800)
    assert 200 < len(drawn.rows) <= 800 and drawn.size >= drawn.edge > 0
    np.testing.assert_array_equal(drawn.rows, detail(memory, 800).rows)
    # Every cell of each source has its point.
    cells = np.floor(memory.columns.positions / drawn.edge).astype(int)
    keys = np.column_stack([cells, memory.generated])
    assert len(np.unique(keys, axis=0)) == len(np.unique(keys[drawn.rows], axis=0))
    # The points of earlier rounds are drawn before the last round as after it.
    earlier = SpatialMemory.load(small_run / "memory.npz")
    earlier.forget(round=2)
    budget = memory.voxels
    now, before = detail(memory, budget), detail(earlier, budget)
    assert now.edge == before.edge == memory.voxel
    assert set(before.rows.tolist()) < set(now.rows.tolist())


def test_rendering_goes_back_and_forth_between_rounds_exactly(run, small_run):
    camera = run.cameras[5].camera
    renderer = RunRenderer(run)
    pictures = {n: picture_of(renderer.render(camera, round=n)) for n in (2, 0, 1, 2)}
    for number, picture in pictures.items():
        memory = SpatialMemory.load(small_run / "memory.npz")
        for later in range(2, number, -1):
            memory.forget(round=later)
        np.testing.assert_array_equal(picture, picture_of(memory.project(camera)))
    assert (pictures[0] != pictures[2]).any()
    assert len(run.memory) == len(SpatialMemory.load(small_run / "memory.npz"))
    tinted = picture_of(renderer.render(camera, round=2, mode="source"))
    assert (tinted != pictures[2]).any()


def room(rng):
    """Points on the floor, two walls and a table, z up."""
    at = rng.uniform(0, 1, (4, 5000, 3))
    at[0] *= (5, 4, 0)
    at[1] *= (5, 0, 2.5)
    at[2] *= (0, 4, 2.5)
    at[3] = at[3] * (1.5, 1.0, 0) + (2.0, 2.0, 0.7)
    return at.reshape(-1, 3) + rng.normal(0, 0.01, (20000, 3))


def degrees(one, other):
    return np.degrees(np.arccos(np.clip(one @ other, -1, 1)))


@pytest.mark.parametrize("tilt", [(0, 0, 0), (12, 0, 0), (8, -10, 70), (0, 30, 20)])
def test_the_floor_is_level_though_the_scenes_frame_is_tilted(tilt):
    turn = Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
    points = room(np.random.default_rng(0))
    expected = turn @ [0, 0, 1]
    assert degrees(guess_up(points @ turn.T), expected) < 1
    # The same in the frame of a camera, whose y runs downwards; seen steeply from above, as well.
    for pitch in (0, 15):
        camera = Rotation.from_euler("x", 90 + pitch, degrees=True).as_matrix() @ turn
        seen = points @ camera.T + (0, 0, 40)
        assert degrees(guess_up(seen), camera @ [0, 0, 1]) < 1


@pytest.mark.parametrize(("size", "up"), [((4, 5, 2), (0, 0, 1)), ((4, 2, 5), (0, -1, 0))])
def test_without_surfaces_it_is_an_axis(size, up):
    points = np.random.default_rng(1).uniform(0, 1, (20000, 3)) * size
    np.testing.assert_array_equal(guess_up(points), up)
    np.testing.assert_array_equal(guess_up(points[:5]), up)


def test_a_wall_is_no_floor():
    rng = np.random.default_rng(2)
    wall = rng.uniform(0, 1, (20000, 3)) * (0, 5, 2) + rng.normal(0, 0.005, (20000, 3))
    np.testing.assert_array_equal(guess_up(wall), (0, 0, 1))
