from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import run_command

from gvtools.errors import OptionError
from pipelines.bench import open3d_peers, procedural_cloud, side_by_side


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch):
    monkeypatch.setattr(side_by_side, "SETTLE_SECONDS", 0.0)


def run(*words: object) -> None:
    run_command("bench", *words)


@pytest.mark.slow
@pytest.mark.parametrize(("what", "rows"), [("fuse", 2), ("splat", 5)])
def test_table_and_json_have_both_times_and_their_ratio(tmp_path, capsys, what, rows):
    run(what, "--points", 2_000, "--repeat", 1)
    out = capsys.readouterr().out
    assert out.count("Open3D") >= rows and "ratio" in out
    file = tmp_path / "bench.json"
    run(what, "--points", 2_000, "--repeat", 1, "--json", file)
    data = json.loads(file.read_text())
    assert len(data["results"]) == rows
    for row in data["results"]:
        assert row["ours_s"] > 0 and row["peer_s"] > 0 and "Open3D" in row["peer"]
        assert row["ratio"] == pytest.approx(row["ours_s"] / row["peer_s"])
        assert row["ratio_of_minima"] == pytest.approx(row["ours_min_s"] / row["peer_min_s"])
        assert row["ours_min_s"] <= row["ours_s"]


def test_sizes_that_measure_nothing():
    with pytest.raises(OptionError, match="--points 10; expected at least 1000"):
        run("fuse", "--points", 10)
    with pytest.raises(OptionError, match="--repeat 0; expected at least 1"):
        run("splat", "--repeat", 0)


@pytest.mark.slow
def test_calls_take_turns_and_warm_ups_are_not_counted():
    seen: list[tuple[str, int]] = []
    seconds = side_by_side.alternate(
        [lambda turn: seen.append(("a", turn)), lambda turn: seen.append(("b", turn))], 2
    )
    assert seen == [(name, turn) for turn in range(3) for name in "ab"]
    assert [len(kept) for kept in seconds] == [2, 2]
    seen.clear()
    side_by_side.alternate([lambda turn: seen.append(("a", turn))], 1, steady=True)
    assert seen == [("a", 0), ("a", 0), ("a", 1), ("a", 1)]


def test_walls_fill_one_voxel_each():
    voxel = 0.1
    size = procedural_cloud.box_size(4000, voxel)
    sets = procedural_cloud.walls(size, voxel)
    points = np.concatenate([points.positions for points in sets]).astype(np.float64)
    cells = np.unique(np.floor(points / voxel).astype(int), axis=0)
    # Points keep half a voxel from the borders; neighbouring walls share their edges alone.
    assert np.abs(points / voxel - np.floor(points / voxel) - 0.5).max() < 1e-3
    assert len(cells) == pytest.approx(4000, rel=0.15)
    n = np.round(size / voxel).astype(int) + 1
    assert len(cells) == np.prod(n) - np.prod(n - 2)


def test_the_peers_see_the_same_scene():
    """Open3D's ray casting and point projection, called as here, give the exact depth."""
    size = np.array([3.0, 2.0, 2.4])
    volume = open3d_peers.TsdfVolume(0.02, blocks=4000)
    for turn in (0.0, 0.1, 0.2):
        camera = procedural_cloud.inside_camera(size, turn=turn, width=160, height=120)
        rgb, depth = procedural_cloud.photograph(size, camera)
        volume.integrate(*open3d_peers.images(rgb, depth), camera)
    camera = procedural_cloud.inside_camera(size, turn=0.1, width=160, height=120)
    rgb, depth = procedural_cloud.photograph(size, camera)
    cast_rgb, cast_depth = volume.ray_cast(camera)
    seen = cast_depth > 0
    assert seen.mean() > 0.7
    # Within a voxel, which is as exact as the volume gets.
    assert np.median(np.abs(cast_depth - depth)[seen]) < 0.02
    assert np.median(np.abs(cast_rgb * 255 - rgb)[seen]) < 6
    pose = camera.world_from_cam[0]
    points = (camera.rays() * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    cloud = open3d_peers.cloud(
        points.reshape(-1, 3).astype(np.float32), rgb.reshape(-1, 3).astype(np.float32) / 255
    )
    flat_rgb, flat_depth = open3d_peers.one_pixel(cloud, camera)
    # Every point comes back to the centre of its own pixel: the half pixel is right.
    np.testing.assert_allclose(flat_depth, depth, rtol=1e-5)
    np.testing.assert_allclose(flat_rgb * 255, rgb, atol=1e-3)


def test_one_pixel_winners_agree():
    rows = side_by_side.one_pixel_rows(30_000, repeat=1)
    share = float(rows[0].note.split("winner in ")[1].split("%")[0])
    assert share > 99.9
