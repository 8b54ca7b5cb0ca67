from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from box_project import VOXEL, fused
from command_line import run_command
from export_runs import export_run
from PIL import Image

from gvtools.cameras import rigid_poses
from gvtools.errors import OptionError, ProjectError
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.store.views import SourceView
from gvtools.scenes.project import open_project
from pipelines.export import source

ORIGIN = (431_000.0, 5_650_000.0, 120.0)


@pytest.fixture
def saved(scene, tmp_path):
    """A run's folder with a memory of two observed views and a generated one."""
    folder = tmp_path / "run"
    (folder / "round_002").mkdir(parents=True)
    fused(scene, [0, 2, 4], generated=(4,)).save(folder / "memory.npz")
    return folder


def add_view(memory, camera, name, *, number, generated):
    """A fused view that left no observation."""
    named = replace(camera, names=(name,))
    memory.views.append(SourceView(named, number, generated, np.zeros((0, 0), np.float32)))


def exported(folder):
    """The model's poses by name, and the lines of generated.txt by name."""
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    poses = {i.name: np.vstack([i.cam_from_world().matrix(), [0, 0, 0, 1]]) for i in
             model.images.values()}  # fmt: skip
    lines = (folder / "sparse/0/generated.txt").read_text().splitlines()[1:]
    return poses, dict([*line.split("\t"), ""][:2] for line in lines)


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_two_observed_cameras_of_one_name_are_refused(scene, tmp_path, kind):
    memory = fused(scene, [0, 2])
    add_view(memory, memory.views[1].camera, "view_0.png", number=1, generated=False)
    memory.save(tmp_path / "memory.npz")
    with pytest.raises(ProjectError, match="two different observed cameras"):
        export_run(tmp_path / "memory.npz", kind, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_generated_views_give_way_to_names_that_are_taken(scene, tmp_path):
    camera = [view.camera for view in scene]
    memory = fused(scene, [0, 2])
    for number, row, name in (
        (2, 1, "view_0.png"),  # another camera than the observed one
        (2, 3, "VIEW_2.png"),  # the same file where case is ignored
        (2, 4, "other/view_0.png"),
        (2, 5, "own.png"),
        (3, 1, "view_0.png"),  # the first one's camera again
        (3, 4, "view_0.png"),
    ):
        add_view(memory, camera[row], name, number=number, generated=True)
    run_folder = tmp_path / "run"
    for number, stem in ((2, "view_0"), (2, "own"), (3, "view_0")):
        picture = run_folder / f"round_{number:03d}" / f"generated_{stem}.png"
        picture.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (96, 72)).save(picture)
    memory.save(run_folder / "memory.npz")
    expected = {
        "view_0.png": 0,
        "view_2.png": 2,
        "generated/view_0.png": 1,
        "generated/VIEW_2.png": 3,
        "generated/other/view_0.png": 4,
        "generated/own.png": 5,
        "generated_2/view_0.png": 4,
    }
    export_run(run_folder, "colmap", tmp_path / "out")
    poses, generated = exported(tmp_path / "out")
    assert set(poses) == set(expected)
    for name, row in expected.items():
        np.testing.assert_allclose(poses[name], camera[row].cam_from_world[0], atol=1e-12)
    assert set(generated) == set(expected) - {"view_0.png", "view_2.png"}
    pictures = {name: path.removeprefix(f"{run_folder}/") for name, path in generated.items()}
    assert pictures == {
        "generated/view_0.png": "round_003/generated_view_0.png",
        "generated/VIEW_2.png": "",
        "generated/other/view_0.png": "",
        "generated/own.png": "round_002/generated_own.png",
        "generated_2/view_0.png": "round_003/generated_view_0.png",
    }


def test_track_elements_follow_the_renamed_views(scene, tmp_path):
    memory = fused(scene, [0, 2])
    other = scene.views[5]
    frame = other.load()
    namesake = replace(other.camera, names=("view_0.png",))
    memory.observe(frame.rgb, frame.depth, namesake, round=2, generated=True)
    count = int(memory.generated.sum())
    assert count
    memory.save(tmp_path / "memory.npz")
    export_run(tmp_path / "memory.npz", "colmap", tmp_path / "out")
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    (image,) = (i for i in model.images.values() if i.name == "generated/view_0.png")
    errors = [
        np.linalg.norm(image.project_point(model.points3D[p.point3D_id].xyz) - p.xy)
        for p in image.points2D
        if p.has_point3D()
    ]
    # Points that this view alone saw lie exactly where it saw them.
    assert 0 < len(errors) <= count
    assert np.median(errors) < 1e-6


def test_cameras_far_from_the_origin_are_told_apart(scene, tmp_path):
    """Five million units out, the camera next door is within a relative tolerance of the pose."""
    memory = SpatialMemory(VOXEL, origin=ORIGIN)
    shift = rigid_poses(np.eye(3), -np.array(ORIGIN))
    camera = scene.views[0].camera
    far = replace(camera, cam_from_world=camera.cam_from_world @ shift, names=("a.png",))
    beside = far.cam_from_world.copy()
    beside[0, 0, 3] += 0.5
    near = replace(far, cam_from_world=beside)
    frame = scene.views[0].load()
    memory.observe(frame.rgb, frame.depth, far, round=0)
    add_view(memory, near, "a.png", number=1, generated=True)
    memory.save(tmp_path / "memory.npz")
    export_run(tmp_path / "memory.npz", "colmap", tmp_path / "out")
    poses, _ = exported(tmp_path / "out")
    assert set(poses) == {"a.png", "generated/a.png"}


def test_a_view_observed_and_generated_shows_its_photograph(scene, saved, tmp_path):
    memory = fused(scene, [0, 2])
    add_view(memory, scene.views[0].camera, "view_0.png", number=2, generated=True)
    memory.save(saved / "memory.npz")
    Image.new("RGB", (96, 72)).save(saved / "round_002" / "generated_view_0.png")
    export_run(saved, "transforms", tmp_path / "out")
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["images/view_0.png", "images/view_2.png"]
    assert not any("generated" in frame for frame in frames)


def test_absent_pictures_are_taken_from_the_runs_project_or_said(
    scene, saved, tmp_path, monkeypatch, capsys
):
    run_command("export", saved, "--format", "transforms", "--out", tmp_path / "without")
    assert "pictures are not there (view_0.png" in capsys.readouterr().out
    frame = replace(scene["view_2.png"].load(), rgb=np.full((72, 96, 3), 7, np.uint8))
    changed = replace(scene["view_2.png"], load=lambda: frame)
    project = replace(scene, views=(scene["view_0.png"], changed))
    monkeypatch.setattr(source, "load_run", lambda path: SimpleNamespace(scenes=(project, None)))
    export_run(saved, "transforms", tmp_path / "out")
    again = open_project(tmp_path / "out")
    by_name = {view.name.split("/")[-1]: view.load().rgb for view in again}
    np.testing.assert_array_equal(by_name["view_0.png"], scene["view_0.png"].load().rgb)
    np.testing.assert_array_equal(by_name["view_2.png"], frame.rgb)


def test_pictures_are_named_from_anywhere(saved, tmp_path, monkeypatch):
    (saved / "round_002").mkdir(exist_ok=True)
    picture = saved / "round_002" / "generated_view_4.png"
    Image.new("RGB", (96, 72)).save(picture)
    monkeypatch.chdir(tmp_path)
    export_run(saved.relative_to(tmp_path), "colmap", "out")
    assert exported(tmp_path / "out")[1] == {"generated/view_4.png": str(picture.resolve())}


@pytest.mark.parametrize("stem", ["x/../../../secret", "link"])
def test_no_picture_outside_the_run_is_named(saved, tmp_path, stem):
    folder = saved / "round_002"
    (folder / "generated_x").mkdir(parents=True)
    Image.new("RGB", (96, 72)).save(tmp_path / "secret.png")
    (folder / "generated_link.png").symlink_to(tmp_path / "secret.png")
    report = {"views": [{"name": "view_4.png", "stem": stem}]}
    (folder / "report.json").write_text(json.dumps(report))
    with pytest.raises(ProjectError, match="lies outside"):
        export_run(saved, "transforms", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def put(path, text="mine"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize(
    ("kind", "out", "files"),
    [
        ("colmap", "", ["sparse/0/cameras.bin"]),
        ("colmap", "", ["sparse/0/cameras.txt", "sparse/0/generated.txt"]),
        ("colmap", "", ["cameras.bin", "images.bin"]),
        ("transforms", "", ["transforms.json"]),
        ("transforms", "mine.JSON", ["mine.JSON"]),
    ],
)
def test_models_of_others_are_kept(saved, tmp_path, kind, out, files):
    folder = tmp_path / "project"
    for name in files:
        put(folder / name)
    before = contents(folder)
    with pytest.raises(OptionError, match=r"was not written by gvtools export") as error:
        export_run(saved, kind, folder / out)
    assert str(folder / files[0].split("/")[0]) in str(error.value)
    assert "\n" not in str(error.value)
    assert contents(folder) == before
    # Another export beside it does not make it ours.
    other = ("transforms", "other.json") if kind == "colmap" else ("colmap", "")
    export_run(saved, other[0], folder / other[1])
    with pytest.raises(OptionError, match=r"not written by gvtools export"):
        export_run(saved, kind, folder / out)


def test_pictures_of_others_are_kept(saved, tmp_path):
    folder, name = tmp_path / "project", "view_0.png"
    put(folder / "images" / name)
    put(tmp_path / "elsewhere" / name, "another")
    with pytest.raises(OptionError, match=r"view_0.png: is there already"):
        export_run(saved, "transforms", folder, "--images", str(tmp_path / "elsewhere"))
    assert list(contents(folder).values()) == [b"mine"]
    export_run(saved, "transforms", folder)
    assert contents(folder)[folder / "images" / name] == b"mine"


def test_an_export_replaces_an_earlier_one(scene, saved, tmp_path):
    folder = tmp_path / "out"
    (folder / "sparse" / "0").mkdir(parents=True)  # empty folders hold no model
    exports = (("colmap", ""), ("transforms", ""), ("transforms", "a.json"))
    for _ in range(2):
        for kind, out in exports:
            export_run(saved, kind, folder / out)
        before = contents(folder)
    for kind, out in exports:
        export_run(saved, kind, folder / out)
    assert contents(folder) == before
    fused(scene, [0]).save(saved / "memory.npz")
    for kind, out in exports:
        export_run(saved, kind, folder / out)
    assert set(contents(folder)) == set(before)
    assert not exported(folder)[1]
