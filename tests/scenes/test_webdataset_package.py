"""The webdataset package reads the shards: every sample once, whatever the workers and ranks."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from shard_rooms import small_collection

from gvtools.scenes.shard_writer import ShardOptions, write_shards
from gvtools.scenes.shards import read_index

wds = pytest.importorskip("webdataset")
torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("shards")
    write_shards(small_collection(), out, options=ShardOptions(megabytes=0.08))
    return out


def tars(folder: Path) -> list[str]:
    return [str(folder / shard.file) for shard in read_index(folder).shards]


def expected() -> set[tuple[str, str]]:
    collection = small_collection()
    return {(name, view) for name in collection.names for view in collection.read(name).names}


def place(sample: dict[str, bytes]) -> tuple[str, str]:
    camera = json.loads(sample["json"])
    return camera["scene"], camera["name"]


def test_pixels_and_cameras_are_those_of_the_scenes(folder):
    collection = small_collection()
    seen = []
    for sample in wds.WebDataset(tars(folder), shardshuffle=False):
        scene, name = place(sample)
        view = collection.read(scene)[name]
        frame, camera = view.load(), json.loads(sample["json"])
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


@pytest.mark.slow  # torch waits 5 s for workers that webdataset has kept
def test_two_workers_see_every_sample_once(folder):
    data = wds.WebDataset(tars(folder), shardshuffle=False, workersplitter=wds.split_by_worker)
    loader = torch.utils.data.DataLoader(data.map(place), batch_size=None, num_workers=2)
    seen = list(loader)
    assert len(seen) == 21 and {tuple(each) for each in seen} == expected()


def test_two_ranks_see_every_sample_once_between_them(folder, monkeypatch):
    seen = []
    for rank in (0, 1):
        # How the package learns of its rank without a process group.
        monkeypatch.setenv("RANK", str(rank))
        monkeypatch.setenv("WORLD_SIZE", "2")
        data = wds.WebDataset(tars(folder), shardshuffle=False, nodesplitter=wds.split_by_node)
        own = [place(sample) for sample in data]
        assert 0 < len(own) < 21
        seen += own
    assert len(seen) == 21 and set(seen) == expected()
