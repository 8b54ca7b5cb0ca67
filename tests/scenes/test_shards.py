"""Shards hold what scenes hold, and their damage is found."""

from __future__ import annotations

import io
import json
import pickle
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from shard_rooms import small_collection, small_scene

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.collection import of_scenes
from gvtools.scenes.shard_writer import ShardOptions, write_shards
from gvtools.scenes.shards import is_shards, open_shards, read_index, verify

SMALL = ShardOptions(megabytes=0.08)
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("shards")
    write_shards(small_collection(), out, options=SMALL)
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_every_view_comes_back_bit_by_bit(whole):
    collection, opened = small_collection(), open_shards(whole)
    assert opened.names == collection.names and opened.counts == (12, 9)
    assert opened.title == "little rooms" and is_shards(whole)
    assert len(read_index(whole).shards) > 2
    for name in collection.names:
        before, after = collection.read(name), opened.read(name)
        assert after.names == before.names
        assert (after.kind, after.metric) == (before.kind, before.metric)
        for view, again in zip(before, after, strict=True):
            assert np.array_equal(view.camera.K, again.camera.K)
            assert np.array_equal(view.camera.cam_from_world, again.camera.cam_from_world)
            frame, found = view.load(), pickle.loads(pickle.dumps(again.load))()
            assert np.array_equal(frame.rgb, found.rgb)
            assert frame.depth is not None and found.depth is not None
            assert found.depth.dtype == np.float32 and np.array_equal(frame.depth, found.depth)
            assert (frame.mask is None) == (found.mask is None)
            assert frame.mask is None or np.array_equal(frame.mask, found.mask)


def test_millimetres_are_pictures_and_other_depth_is_not(whole):
    records = [json.loads(path.read_text())["views"] for path in sorted(whole.glob("shard-*.json"))]
    kinds = {(view["scene"], *sorted(view["members"])) for views in records for view in views}
    assert kinds == {(0, "depth.png", "json", "png"), (1, "depth.npz", "json", "mask.png", "png")}


def test_pictures_with_a_loss_stay_so_and_views_may_lack_depth(tmp_path):
    scene = small_scene("photographs", ["bare"] * 3, lossy=True)
    write_shards(of_scenes([scene]), tmp_path)
    opened = open_shards(tmp_path)
    again = opened.read("photographs")
    assert opened.counts == (0,) and not any(view.has_depth for view in again)
    for view, found in zip(scene, again, strict=True):
        error = np.abs(view.load().rgb.astype(int) - found.load().rgb)
        assert 0 < error.mean() < 2 and found.load().depth is None


def test_reduced_pictures_have_reduced_cameras(tmp_path):
    collection = small_collection()
    write_shards(collection, tmp_path, options=ShardOptions(max_side=64))
    view = next(iter(open_shards(tmp_path).read("one")))
    frame = view.load()
    assert frame.depth is not None and frame.depth.shape == (48, 64)
    assert frame.rgb.shape == (48, 64, 3)
    wanted = next(iter(collection.read("one"))).camera.resized(64, 48)
    assert np.array_equal(view.camera.K, wanted.K)


_KILLED = """
import os, signal, sys
from pathlib import Path
from shard_rooms import Pixels, small_collection
from gvtools.scenes.shard_writer import ShardOptions, write_shards

load = Pixels.__call__

def deadly(self):
    if self.index == 9:
        os.kill(os.getpid(), signal.SIGKILL)
    return load(self)

Pixels.__call__ = deadly
write_shards(small_collection(), Path(sys.argv[1]), options=ShardOptions(megabytes=0.08))
"""


def test_a_killed_conversion_ends_with_the_same_bytes(whole, tmp_path):
    out = tmp_path / "shards"
    paths = [str(ROOT), str(ROOT / "tests" / "fixtures")]
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {paths!r}\n{_KILLED}", str(out)]
    )
    assert done.returncode == -signal.SIGKILL
    left = [path.name for path in out.iterdir()]
    assert any(name.endswith(".part") for name in left) and not is_shards(out)
    with pytest.raises(ProjectError, match="to its end"):
        open_shards(out)
    kept: list[bool] = []
    write_shards(
        small_collection(), out, options=SMALL, progress=lambda done: kept.append(done.before)
    )
    assert kept[0] and not kept[-1]
    assert contents(out) == contents(whole)


def test_damage_is_found_named_and_mended(whole, tmp_path):
    out = Path(shutil.copytree(whole, tmp_path / "shards"))
    assert verify(out) == []
    tar = out / "shard-000001.tar"
    content = bytearray(tar.read_bytes())
    record = json.loads(tar.with_suffix(".json").read_text())["views"][2]
    offset, size, _ = record["members"]["png"]
    content[offset + size // 2] ^= 1
    tar.write_bytes(content)
    (problem,) = verify(out)
    assert "shard-000001.tar: damaged" in problem and "\n" not in problem
    scene = open_shards(out).read(open_shards(out).names[record["scene"]])
    with pytest.raises(ProjectError, match=r"view\.\d+\.png: png is damaged; gvtools data verify"):
        scene[record["name"]].load()
    kept: list[bool] = []
    write_shards(
        small_collection(), out, options=SMALL, progress=lambda done: kept.append(done.before)
    )
    assert kept.count(False) == 1 and not kept[1]
    assert contents(out) == contents(whole)


def test_what_cannot_be_read_is_left_out_and_listed(tmp_path):
    good = small_scene("good", ["millimetres", "broken", "millimetres"])
    index = write_shards(of_scenes([good, small_scene("bad", ["broken"] * 2)]), tmp_path)
    assert [(item.scene, item.view) for item in index.skipped] == [
        ("good", "view.001.png"),
        ("bad", "view.000.png"),
        ("bad", "view.001.png"),
    ]
    assert index.skipped[0].reason == "view 1 cannot be read"
    opened = open_shards(tmp_path)
    assert opened.names == ("good",)
    assert opened.read("good").names == ("view.000.png", "view.002.png")
    with pytest.raises(ProjectError, match="no view could be converted; first: view 0"):
        write_shards(of_scenes([small_scene("bad", ["broken"])]), tmp_path / "none")


def test_another_conversion_and_foreign_files_are_refused(whole, tmp_path):
    out = Path(shutil.copytree(whole, tmp_path / "shards"))
    with pytest.raises(OptionError, match=r"other max_side lies there: None then, 64 now"):
        write_shards(small_collection(), out, options=ShardOptions(megabytes=0.08, max_side=64))
    with pytest.raises(OptionError, match="other title"):
        write_shards(of_scenes([small_scene("other", ["bare"])]), out, options=SMALL)
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(ProjectError, match=r"holds letter\.txt"):
        write_shards(small_collection(), tmp_path)
    with pytest.raises(OptionError, match="more than 0"):
        ShardOptions(megabytes=0)
    assert contents(out) == contents(whole)


wds = pytest.importorskip("webdataset")
torch = pytest.importorskip("torch")


def test_pixels_and_cameras_are_those_of_the_scenes(whole):
    collection = small_collection()
    seen = []
    tars = [str(whole / shard.file) for shard in read_index(whole).shards]
    for sample in wds.WebDataset(tars, shardshuffle=False):
        camera = json.loads(sample["json"])
        scene, name = camera["scene"], camera["name"]
        view = collection.read(scene)[name]
        frame = view.load()
        assert np.array_equal(np.array(Image.open(io.BytesIO(sample["png"]))), frame.rgb)
        if "depth.png" in sample:
            depth = np.asarray(Image.open(io.BytesIO(sample["depth.png"]))).astype(np.float32)
            depth *= np.float32(camera["depth_unit"])
        else:
            depth = np.load(io.BytesIO(sample["depth.npz"]))["depth"]
        assert frame.depth is not None and np.array_equal(depth, frame.depth)
        assert np.array_equal(camera["K"], view.camera.K[0])
        assert np.array_equal(camera["cam_from_world"], view.camera.cam_from_world[0])
        seen.append((scene, name))
    # Neighbouring views follow each other.
    assert seen == [(s, view) for s in collection.names for view in collection.read(s).names]
