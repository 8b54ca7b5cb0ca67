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
