from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import pytest
from command_line import refused
from data_sets import mini_synthetic
from data_sets.miniature import Miniature

from gvtools.scenes.data_sets.catalogue import load_spec, spec_names
from gvtools.training.data import TrainingSamples
from gvtools.training.mixture import MIXTURE, with_data
from gvtools.training.options import TrainingSettings, shipped_or_read


def test_the_file_has_the_fifteen_by_the_roots_of_their_frames():
    data = json.loads(MIXTURE.read_text())["data"]
    weights = {entry["root"]: entry["weight"] for entry in data["scenes"]}
    training = {name: load_spec(name) for name in spec_names()}
    training = {name: spec for name, spec in training.items() if "training" in spec.roles}
    assert set(weights) == set(training) and len(weights) == 15 and data["scene_share"] == 1
    for name, spec in training.items():
        assert weights[name] == pytest.approx(math.sqrt(spec.counts.images or 0), abs=1e-3)
        assert spec.geometry is not None
        own = 0 if name in ("realestate10k", "waymo") else 2 / 3
        assert spec.geometry.own_share == pytest.approx(own)


@pytest.fixture
def downloads(tmp_path: Path) -> Path:
    by_layout: dict[str, Miniature] = {m.layout: m for m in mini_synthetic.MINIATURES[::-1]}
    for name in ("gtasfm", "virtualkitti"):
        by_layout[load_spec(name).layout].write(tmp_path / "data" / name)
    (tmp_path / "data" / "spring").mkdir()
    return tmp_path / "data"


def test_what_is_there_is_trained_on_by_its_share(downloads):
    config, found = with_data(shipped_or_read("base")[0], downloads)
    shares = {one.name: one.share for one in found}
    roots = [math.sqrt(load_spec(name).counts.images or 0) for name in ("gtasfm", "virtualkitti")]
    assert shares["gtasfm"] == pytest.approx(roots[0] / sum(roots), abs=1e-4)
    assert sum(shares.values()) == pytest.approx(1) and sum(map(bool, shares.values())) == 2
    notes = {one.name: one.note for one in found}
    assert "no scene of Spring" in notes["spring"] and "no folder" in notes["waymo"]
    assert "own geometry alone" in notes["gtasfm"] and len(found) == 15
    assert config.data.scene_share == 1 and len(config.data.scenes) == 2
    sources = TrainingSamples(config, config.network()).sources
    assert sources is not None and sources["rooms"]["share"] == 0
    assert sources["GTA-SfM"]["share"] == pytest.approx(shares["gtasfm"])


def test_it_does_not_begin_without_scenes(downloads, tmp_path, capsys):
    words = ["train", "base", "--out", str(tmp_path / "out")]
    assert "--rooms for drawn rooms alone" in refused(capsys, *words)
    assert "no such folder" in refused(capsys, *words, "--data", str(tmp_path / "absent"))
    both = refused(capsys, *words, "--data", str(downloads), "--rooms")
    assert "--data and --rooms: expected one" in both
    for name in ("gtasfm", "virtualkitti"):
        shutil.rmtree(downloads / name)
    assert "none of the 15 data sets can be used" in refused(
        capsys, *words, "--data", str(downloads)
    )
    assert not (tmp_path / "out").exists()
    assert TrainingSettings().data.scene_share == 0
