from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gvtools.memory.spatial_memory import SpatialMemory
from pipelines.viewing.source import ViewSource
from viz.plots.canvas import COLORS, GREY
from viz.viewer.colors import MODES, VIRIDIS, depth_errors, point_colors, view_counts
from viz.viewer.render import RunRenderer, picture_of
from viz.viewer.run_view import CONTEXT, TARGET, detail
from viz.viewer.standpoint import guess_up


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
