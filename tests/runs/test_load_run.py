from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

import gvtools
from gvtools.errors import ProjectError
from gvtools.runs.run import load_growing_run, load_run


def test_a_run_has_its_settings_rounds_views_and_memory(small_run):
    run = gvtools.load_run(small_run)
    assert run.complete and run.planned == len(run.rounds) == 3
    # What was derived stands in its place.
    assert run.settings["voxel"] == run.record["derived"]["voxel"] > 0
    assert run.context == tuple(f"frame-{i:06d}.color.png" for i in range(3))
    assert [(view.round, view.name[:12]) for view in run.views] == [
        (1, "frame-000004"),
        (1, "frame-000005"),
        (2, "frame-000006"),
        (2, "frame-000007"),
    ]
    assert len(run.memory) == run.rounds[-1]["points"]
    for view, files, truth in run.targets():
        assert truth is not None and truth.name == view.name == files.name
        assert files.picture.shape == truth.load().rgb.shape
        np.testing.assert_allclose(view.camera.cam_from_world, truth.camera.cam_from_world)


@pytest.mark.parametrize("load", [load_run, load_growing_run])
def test_an_unfinished_run_has_its_complete_rounds(small_run, tmp_path, load):
    folder = tmp_path / "run"
    shutil.copytree(small_run, folder)
    (folder / "round_002").rename(folder / ".round_002.part")
    run = load(folder)
    assert not run.complete and len(run.rounds) == 2 and len(run.views) == 2


def test_a_project_that_moved_is_read_where_it_lies_now(small_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(small_run, folder)
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**record, "project": str(tmp_path / "gone")}))
    with pytest.raises(ProjectError, match="gone"):
        _ = load_run(folder).scenes
    assert load_run(folder, project=small_run.parent / "scan").scenes[0].names


@pytest.mark.parametrize("change", [{"settings": None}, {"schedule": [1]}, {"context": [2]}])
def test_a_record_of_another_version_is_refused(small_run, tmp_path, change):
    record = json.loads((small_run / "run.json").read_text())
    (tmp_path / "run.json").write_text(json.dumps({**record, **change}))
    with pytest.raises(ProjectError, match="no record of a run of this version"):
        load_run(tmp_path)
