from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from tiny_scan import write_colmap_scan, write_scan
from trajectory_writers import write_tum

from gvtools.errors import OptionError
from gvtools.runs.layout import target_stems
from gvtools.scenes.project import open_project
from gvtools.scenes.transforms import read_camera_path, write_transforms
from pipelines.reconstruction.plan import make_schedule, resolve_targets
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.settings import RunSettings


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return open_project(write_scan(tmp_path_factory.mktemp("scan")))


def test_hold_outs_come_with_their_truth_and_are_no_context(scene):
    targets = resolve_targets(scene, scene.names[::2], "every:2+1")
    assert targets.kind == "hold-out"
    assert targets.cameras.names == scene.names[1::2]
    assert [view.name for view in targets.truth if view] == list(scene.names[1::2])
    with pytest.raises(OptionError, match="allow-overlap"):
        resolve_targets(scene, scene.names, "first:2")
    assert len(resolve_targets(scene, scene.names, "first:2", allow_overlap=True).cameras) == 2


@pytest.mark.parametrize("name", ["interpolate", "orbit", "spiral"])
def test_paths_have_as_many_cameras_as_asked(scene, name):
    targets = resolve_targets(scene, scene.names, f"{name}:5")
    assert len(targets.cameras) == 5
    assert targets.truth == (None,) * 5
    assert len(set(targets.cameras.names)) == 5


@pytest.mark.parametrize("spec", ["orbit", "orbit:0", "orbit:x", "nosuchview", "evry:2"])
def test_bad_specifications_are_refused(scene, spec):
    with pytest.raises(OptionError):
        resolve_targets(scene, scene.names, spec)


def test_a_file_of_cameras_without_pictures_gives_them_all_or_some(scene, tmp_path):
    """As the viewer saves paths; a project's own file stays a project."""
    path = tmp_path / "path.json"
    cameras = scene.cameras[:3]
    write_transforms(path, cameras, image_paths=[tmp_path / name for name in cameras.names])
    targets = resolve_targets(scene, scene.names, f"{path}@last:2")
    assert (targets.kind, targets.truth, targets.project) == ("trajectory", (None, None), None)
    np.testing.assert_allclose(targets.cameras.cam_from_world, cameras.cam_from_world[1:])
    (tmp_path / cameras.names[1]).write_bytes(b"a picture")
    assert read_camera_path(path, scene.cameras) is None
    write_tum(tmp_path / "path.txt", cameras)
    chosen = resolve_targets(scene, scene.names, f"{tmp_path / 'path.txt'}@first:1")
    pose = chosen.cameras.cam_from_world
    np.testing.assert_allclose(pose, cameras.cam_from_world[:1], atol=1e-6)


def test_a_second_project_gives_cameras_and_truth(scene, tmp_path):
    other = write_scan(tmp_path / "other", views=3)
    targets = resolve_targets(scene, scene.names[2:], f"{other}@first:2")
    assert len(targets.cameras) == 2
    assert targets.truth[0] is not None


def test_a_second_project_with_the_contexts_pictures_is_refused(scene, tmp_path):
    copied = write_scan(tmp_path / "other", views=3)
    for spec in (str(scene.root), f"{copied}@first:2"):
        with pytest.raises(OptionError, match="overlap"):
            resolve_targets(scene, scene.names, spec)
        assert len(resolve_targets(scene, scene.names, spec, allow_overlap=True).cameras) >= 2


def test_a_list_longer_than_a_files_name_is_a_selection(tmp_path):
    wide = open_project(write_scan(tmp_path / "wide", views=14))
    spec = ",".join(wide.names[2:])
    assert len(spec) > 255
    assert len(resolve_targets(wide, wide.names[:2], spec).cameras) == 12


def test_a_second_project_with_smaller_copies_of_the_pictures_is_refused(scene, tmp_path):
    """Other files, sizes and intrinsics, but the same shots."""
    cameras = scene.cameras.resized(48, 36)
    for name in cameras.names:
        Image.new("RGB", (48, 36)).save(tmp_path / f"{name}.png")
    write_transforms(
        tmp_path / "transforms.json", cameras, image_paths=[f"{name}.png" for name in cameras.names]
    )
    with pytest.raises(OptionError, match="overlap"):
        resolve_targets(scene, scene.names[:2], str(tmp_path))
    others = resolve_targets(scene, scene.names[:2], f"{tmp_path}@range:2-5")
    assert len(others.cameras) == 4


@pytest.mark.parametrize(
    ("targets", "size", "rounds", "expected"),
    [
        (5, 6, 3, (1, 2, 2)),
        (7, 3, None, (2, 2, 3)),
        (12, 3, 2, (3, 3)),
        (2, 6, 5, (1, 1)),
        (4, 2, 0, ()),
    ],
)
def test_the_schedule_takes_targets_in_order(targets, size, rounds, expected):
    schedule = make_schedule(targets, size, rounds)
    assert tuple(len(rows) for rows in schedule) == expected
    assert [row for rows in schedule for row in rows] == list(range(sum(expected)))
    assert all(len(rows) <= size for rows in schedule)


def test_targets_with_alike_names_have_files_of_their_own():
    names = ("a.png", "a.jpg", "sub/a.png", "sub__a.png", "b.png", "interpolate_0001")
    stems = target_stems(names)
    assert len({stem.lower() for stem in stems}) == len(names)
    assert not any("/" in stem for stem in stems)
    assert stems[4:] == ("b", "interpolate_0001")


def test_points_of_held_out_views_are_used_and_said_so_or_left_out(tmp_path):
    scan = write_colmap_scan(tmp_path / "scan", views=4, points=10)
    scene = open_project(scan)
    said: list[str] = []
    settings = {"context": "first:3", "targets": "last:1", "depth": "plane-sweep"}
    plan = make_plan(scene, RunSettings(**settings), say=said.append)
    assert plan.scene.points is not None
    assert len(plan.scene.points.positions) == 40
    assert any("40 of 40 sparse points" in line and "points=context" in line for line in said)
    # Each point is detected by one view here; the context would have to detect it twice.
    strict = make_plan(scene, RunSettings(**settings, points="context", voxel=0.1))
    assert strict.scene.points is not None
    assert len(strict.scene.points.positions) == 0
