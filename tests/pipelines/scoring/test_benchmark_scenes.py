from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gvtools.cameras import Cameras
from gvtools.errors import ProjectError
from gvtools.evaluation.published import load_benchmark
from gvtools.runs.run import Run
from gvtools.scenes.colmap_writer import write_colmap
from gvtools.scenes.data_sets import catalogue
from pipelines.scoring import benchmark_scenes as scenes
from pipelines.scoring.benchmark_scenes import (
    at_benchmark_size,
    open_benchmark_scene,
    picture_size,
    reading_of,
    split_of_scene,
)

VIEWS, FULL = 16, (160, 120)


def write_pictures(folder: Path, divided_by: int) -> None:
    folder.mkdir(parents=True)
    for i in range(VIEWS):
        size = FULL[0] // divided_by, FULL[1] // divided_by
        Image.new("RGB", size, (i, divided_by, 0)).save(folder / f"view_{i:02d}.png")


def cameras() -> Cameras:
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    poses[:, 0, 3] = -0.1 * np.arange(VIEWS)
    K = np.array([[150.0, 0, FULL[0] / 2], [0, 150, FULL[1] / 2], [0, 0, 1]])
    names = tuple(f"view_{i:02d}.png" for i in range(VIEWS))
    width, height = (np.full(VIEWS, side) for side in FULL)
    return Cameras(np.tile(K, (VIEWS, 1, 1)), poses, width, height, names)


def write_mipnerf360(root: Path, *copies: int) -> Path:
    scene = root / "garden"
    for copy in copies:
        write_pictures(scene / ("images" if copy == 1 else f"images_{copy}"), copy)
    write_colmap(scene / "sparse" / "0", cameras())
    return root


def write_llff(root: Path, *copies: int) -> Path:
    scene = root / "fern"
    for copy in copies:
        write_pictures(scene / ("images" if copy == 1 else f"images_{copy}"), copy)
    rows = []
    for pose in cameras().world_from_cam:
        right, down, forward = pose[:3, :3].T
        axes = np.stack([down, right, -forward, pose[:3, 3], [FULL[1], FULL[0], 150.0]])
        rows.append(np.concatenate([axes.T.ravel(), [0.5, 9.0]]))
    np.save(scene / "poses_bounds.npy", np.array(rows))
    return root


def size_of(camera: Cameras) -> tuple[int, int]:
    return int(camera.width[0]), int(camera.height[0])


@pytest.mark.parametrize(("copies", "read"), [((1, 8), 8), ((1, 2, 8), 8), ((8,), 8), ((1, 2), 1)])
def test_the_data_sets_own_reduced_pictures_are_read_where_they_are_there(tmp_path, copies, read):
    benchmark = load_benchmark("mipnerf360-few").at(12)
    scene = open_benchmark_scene(benchmark, "garden", write_mipnerf360(tmp_path, *copies))
    assert scene.views[3].load().rgb[0, 0].tolist() == [3, read, 0]
    split = split_of_scene(benchmark, scene)
    # 14 of 16 views are no targets, of which 12 at equal steps.
    assert [int(name[5:7]) for name in split.targets] == [0, 8]
    assert len(split.context) == 12
    size = picture_size(benchmark, scene)
    assert size == (None if read == 8 else (20, 15))
    assert size_of(at_benchmark_size(scene, split, size=size).views[0].camera) == (20, 15)


def test_copies_that_do_not_tell_the_recorded_size_are_refused(tmp_path):
    benchmark = load_benchmark("mipnerf360-few").at(12)
    with pytest.raises(ProjectError, match="neither images_8 nor images"):
        open_benchmark_scene(benchmark, "garden", write_mipnerf360(tmp_path, 2))


@pytest.mark.parametrize(("copies", "read"), [((1, 8), 8), ((1,), 1), ((4,), 4)])
def test_llff_has_one_size_and_its_runs_are_opened_again_with_it(tmp_path, copies, read):
    benchmark = load_benchmark("llff").at(3)
    root = write_llff(tmp_path, *copies)
    scene = open_benchmark_scene(benchmark, "fern", root)
    assert scene.views[3].load().rgb[0, 0].tolist() == [3, read, 0]
    split = split_of_scene(benchmark, scene)
    assert [int(name[5:7]) for name in split.context] == [1, 7, 15]
    size = picture_size(benchmark, scene)
    found = at_benchmark_size(scene, split, size=size)
    assert {size_of(view.camera) for view in found} == {(504, 378)}
    assert found.views[5].load().rgb.shape == (378, 504, 3)
    assert scene.origin is not None
    record: dict[str, Any] = {
        "project": scene.address,
        "reading": reading_of(scene, size),
        "settings": {}, "derived": {}, "targets": [], "targets_kind": "hold-out",
        "targets_project": None,
    }  # fmt: skip
    again, truths = Run(tmp_path, record, ()).scenes
    assert truths is again
    np.testing.assert_allclose(again.cameras.K, found.cameras.K)
    np.testing.assert_array_equal(again.views[5].load().rgb, found.views[5].load().rgb)


def test_scenes_are_found_in_whichever_folder_of_the_download_they_lie(monkeypatch, tmp_path):
    names = ("Rectified/scan8", "Rectified/scan80", "scan9")
    monkeypatch.setattr(catalogue, "scenes_of", lambda name, root: names)
    monkeypatch.setattr(
        catalogue,
        "layout_of",
        lambda spec: catalogue.Layout("", "", lambda _: names, None),  # type: ignore[arg-type]
    )
    benchmark = load_benchmark("dtu").at(3)
    found = [scenes._name_there(benchmark, name, tmp_path) for name in ("scan8", "scan9", "scan1")]
    assert found == ["Rectified/scan8", "scan9", "scan1"]


def test_scenes_that_a_benchmark_lists_are_its_scenes_also_where_they_are_absent(tmp_path):
    assert len(scenes.scene_names(load_benchmark("llff"), tmp_path)) == 8
    with pytest.raises(ProjectError, match="no such folder"):
        scenes.scene_names(load_benchmark("llff"), tmp_path / "gone")
    assert scenes.scene_names(load_benchmark("mipnerf360"), write_mipnerf360(tmp_path, 1)) == (
        "garden",
    )
