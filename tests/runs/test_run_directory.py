from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError
from tiny_scan import write_colmap_scan, write_scan

import gvtools
from gvtools.errors import ProjectError
from gvtools.files import write_json
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.runs.folder import RunDirectory
from gvtools.runs.run import _View, load_growing_run, load_run
from pipelines.cli import main

pytestmark = pytest.mark.usefixtures("unpainted")

RUN = ("--context", "first:2", "--targets", "range:2-5", "--views-per-round", "2", "--quiet",
       "--refine", "0", "--set", "refine.poses=false")  # fmt: skip


@pytest.fixture
def scan(tmp_path):
    return write_scan(tmp_path / "scan")


def reconstruct(scan, out, *options: object) -> int:
    return main(["reconstruct", str(scan), "--out", str(out), *RUN, *map(str, options)])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A scan and a finished run of it, not to be changed."""
    root = tmp_path_factory.mktemp("whole")
    scan, out = write_scan(root / "scan"), root / "run"
    assert reconstruct(scan, out) == 0
    return scan, out


@pytest.fixture
def finished(whole, tmp_path):
    """The scan and a copy of the finished run."""
    shutil.copytree(whole[1], tmp_path / "run")
    return whole[0], tmp_path / "run"


@pytest.fixture
def own(finished, tmp_path):
    """A copy of the scan, too, and the run as if it were of that."""
    scan, out = finished
    record = json.loads((out / "run.json").read_text())
    shutil.copytree(scan, tmp_path / "scan")
    write_json(out / "run.json", {**record, "project": str(tmp_path / "scan")})
    return tmp_path / "scan", out


def differing(scan, out, capsys, *options: object) -> str:
    """What differs from the run that is to be resumed."""
    assert reconstruct(scan, out, "--resume", *options) == 2
    return capsys.readouterr().err


def test_a_first_attempt_that_failed_does_not_bind_the_next(scan, tmp_path):
    out = tmp_path / "run"
    broken = scan / "frame-000001.color.png"
    whole = broken.read_bytes()
    # Its header is right, so that it is found out in round 0, with run.json written.
    broken.write_bytes(whole[: len(whole) // 2])
    assert reconstruct(scan, out, "--voxel", "0.02") == 2
    broken.write_bytes(whole)
    assert reconstruct(scan, out, "--voxel", "0.03", "--rounds", "0") == 0
    assert json.loads((out / "run.json").read_text())["settings"]["voxel"] == 0.03


def test_the_settings_of_a_run_with_rounds_bind(finished, capsys):
    shutil.rmtree(finished[1] / "round_002")
    assert "settings, derived differ" in differing(*finished, capsys, "--voxel", "0.3")


def test_a_changed_reading_of_the_project_is_another_run(own, capsys):
    assert "reading" in differing(*own, capsys, "--depth-max", "2.6")
    # The same through the folder's own file, which no option tells of.
    (own[0] / "rgbd.json").write_text(json.dumps({"depth_unit": 0.002}))
    assert "pixels" in differing(*own, capsys)


def test_changed_sparse_points_are_another_run(tmp_path, capsys):
    """Computed depth stands on them."""
    project = write_colmap_scan(tmp_path / "colmap")
    out = tmp_path / "run"
    words = ("--completer", "none", "--context", "first:3", "--targets", "last:1",
             "--voxel", "0.03", "--set", "stereo.max_side=64")  # fmt: skip
    assert reconstruct(project, out, *words) == 0
    assert reconstruct(project, out, *words, "--resume") == 0
    other = write_colmap_scan(tmp_path / "other", points=70)
    shutil.rmtree(project / "sparse")
    shutil.copytree(other / "sparse", project / "sparse")
    assert "(points differ)" in differing(project, out, capsys, *words)


def test_removing_a_round_forgets_it_and_what_came_after(finished):
    scan, again = finished
    memory = (again / "memory.npz").read_bytes()
    shutil.rmtree(again / "round_001")
    directory = RunDirectory(again)
    record = json.loads((again / "run.json").read_text())
    record.pop("versions")
    with directory.open_or_resume(record, resume=True) as done:
        assert done == 1
    assert reconstruct(scan, again, "--resume") == 0
    assert SpatialMemory.load(again / "memory.npz").rounds == (0, 1, 2)
    assert (again / "memory.npz").read_bytes() == memory


def test_a_folder_in_use_is_refused(tmp_path):
    first = RunDirectory(tmp_path / "run")
    with first.open_or_resume({"a": 1}, resume=False):
        second = RunDirectory(tmp_path / "run")
        with (
            pytest.raises(ProjectError, match="another process"),
            second.open_or_resume({"a": 1}, resume=True),
        ):
            pass
    with second.open_or_resume({"a": 1}, resume=True) as done:
        assert done == 0


def test_a_file_in_the_folders_place_is_refused_untouched(tmp_path):
    (tmp_path / "run").write_text("mine")
    with (
        pytest.raises(ProjectError, match="is a file"),
        RunDirectory(tmp_path / "run").open_or_resume({}, resume=False),
    ):
        pass
    assert (tmp_path / "run").read_text() == "mine"


def test_cuda_without_a_device_is_refused_before_anything_is_written(
    scan, tmp_path, capsys, monkeypatch
):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for more in ((), ("--dry-run",)):
        assert reconstruct(scan, tmp_path / "run", "--device", "cuda", *more) == 2
        assert "no CUDA device" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_demo_in_a_folder_with_files_is_refused_before_its_sample(tmp_path, capsys, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    write_json(tmp_path / "here" / "mine.json", {})
    assert main(["demo", "--out", ".", "--quiet"]) == 2
    assert "no run.json" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


def test_figures_split_the_picture_by_what_observations_support(finished):
    """A target's support keeps observed and generated apart, also within a round."""
    _, out = finished
    metrics = json.loads((out / "metrics.json").read_text())
    for number in (1, 2):
        report = json.loads((out / f"round_00{number}" / "report.json").read_text())
        shares = [view["coverage"] for view in report["views"]]
        # The round's line, the table and the report tell one coverage.
        assert np.isclose(np.mean(shares), report["coverage_before"])
        told = [view["coverage"] for view in metrics["views"] if view["round"] == number]
        assert told == shares
        for view in report["views"]:
            with Image.open(out / f"round_00{number}" / f"valid_{view['stem']}.png") as image:
                support = np.asarray(image)
            assert set(np.unique(support)) <= {0, 128, 255}
            assert np.isclose((support == 255).mean(), view["observed"])
    # Both context views and the walk's ends differ enough that later targets meet generated pixels.
    assert any(
        (np.asarray(Image.open(path)) == 128).any() for path in out.glob("round_*/valid_*.png")
    )


def test_another_programs_record_is_refused_untouched(scan, tmp_path, capsys):
    out = tmp_path / "run"
    out.mkdir()
    (out / "run.json").write_text('{"experiment": "mine"}')
    (out / "memory.ply").write_text("precious")
    for more in ((), ("--resume",)):
        assert reconstruct(scan, out, *more) == 2
        assert "another run" in capsys.readouterr().err
    assert (out / "memory.ply").read_text() == "precious"
    (out / "memory.ply").unlink()
    assert reconstruct(scan, out) == 2
    assert json.loads((out / "run.json").read_text()) == {"experiment": "mine"}


def test_a_run_whose_rounds_were_deleted_is_not_overwritten(finished, capsys):
    scan, out = finished
    memory = (out / "memory.npz").read_bytes()
    for folder in out.glob("round_*"):
        shutil.rmtree(folder)
    assert reconstruct(scan, out, "--voxel", "0.3") == 2
    assert "another run" in capsys.readouterr().err
    assert reconstruct(scan, out) == 2
    assert "--resume" in capsys.readouterr().err
    assert (out / "memory.npz").read_bytes() == memory
    assert reconstruct(scan, out, "--resume") == 0
    assert (out / "memory.npz").read_bytes() == memory


def test_a_memory_that_went_with_a_removed_round_is_said(finished, capsys):
    scan, out = finished
    shutil.move(out / "memory.npz", out / "round_002" / "memory.npz")
    shutil.rmtree(out / "round_002")
    assert reconstruct(scan, out, "--resume") == 2
    assert "another --out" in capsys.readouterr().err


def test_a_dry_run_tells_what_a_run_would_be_refused_for(finished, capsys):
    scan, out = finished
    assert reconstruct(scan, out, "--dry-run") == 2
    assert reconstruct(scan, out, "--dry-run", "--resume") == 0
    assert reconstruct(scan, out, "--dry-run", "--resume", "--voxel", "0.3") == 2
    assert "another run" in capsys.readouterr().err


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


@pytest.mark.parametrize(
    "change",
    [{"width": 2**31}, {"width": [4]}, {"width": 0}, {"K": [np.eye(3).tolist()]},
     {"cam_from_world": [np.eye(4).tolist()]}, {"cam_from_world": (2 * np.eye(4)).tolist()}],
)  # fmt: skip
def test_a_view_of_a_report_has_one_usable_camera(change):
    pose = {"K": np.eye(3).tolist(), "cam_from_world": np.eye(4).tolist()}
    camera = {**pose, "width": 4, "height": 3}
    view = {"name": "a", "stem": "a", "coverage": 1, "coverage_after": 1, "scale": {}}
    _View.model_validate({**view, "camera": camera})
    with pytest.raises(ValidationError):
        _View.model_validate({**view, "camera": {**camera, **change}})
