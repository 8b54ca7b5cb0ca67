# mypy: no-check-untyped-defs
from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from rgbd_folders import redwood, scannet, tum
from scenes_workspace import PINHOLE, frame, ramp, save, sevenscenes, transforms, workspace

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.images import ALPHA
from gvtools.scenes.project import open_project
from gvtools.scenes.rgbd import RgbdOptions
from gvtools.scenes.selection import check_disjoint, select


def make_transforms(root):
    save(root / "images" / "a.png", ramp())
    transforms(root, [frame()], **PINHOLE)


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (workspace, "colmap"),
        (sevenscenes, "rgbd"),
        (tum, "rgbd"),
        (redwood, "rgbd"),
        (scannet, "rgbd"),
        (make_transforms, "transforms"),
    ],
)
def test_kinds_are_found_out(tmp_path, make, kind):
    make(tmp_path / "project")
    scene = open_project(tmp_path / "project")
    assert scene.kind == kind
    assert scene.views[0].load().rgb.dtype == np.uint8
    form = "gztar" if kind == "colmap" else "zip"
    packed = Path(shutil.make_archive(str(tmp_path / "packed"), form, tmp_path, "project"))
    unpacked = open_project(packed)
    assert (unpacked.kind, unpacked.names, unpacked.address) == (kind, scene.names, str(packed))
    assert np.array_equal(unpacked.views[0].load().rgb, scene.views[0].load().rgb)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("../a.txt", b"a", "names the file '../a.txt', which lies outside"),
        ("a.txt", bytes(300 << 20), "members claim 314572800 bytes"),
        ("a.txt", b"", "holds a.txt; expected one of"),
    ],
)
def test_archives_that_hold_no_project(tmp_path, name, content, told):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    with pytest.raises(ProjectError, match=told):
        open_project(tmp_path / "a.zip")


def test_colmap_goes_before_transforms_and_says_so(tmp_path):
    workspace(tmp_path)
    make_transforms(tmp_path)
    scene = open_project(tmp_path)
    assert scene.kind == "colmap"
    assert any("transforms.json is not" in finding.message for finding in scene.findings)
    assert open_project(tmp_path / "transforms.json").kind == "transforms"


def test_nothing_there(tmp_path):
    sevenscenes(tmp_path / "kitchen")
    with pytest.raises(ProjectError, match=r"kitchn: no such folder; did you mean .*kitchen"):
        open_project(tmp_path / "kitchn")
    with pytest.raises(ProjectError, match=r"expected one of: .*did you mean .*kitchen"):
        open_project(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ProjectError, match="is empty; expected one of: a COLMAP model"):
        open_project(tmp_path / "empty")


def test_options_of_another_kind(tmp_path):
    workspace(tmp_path / "colmap")
    sevenscenes(tmp_path / "scan")
    with pytest.raises(OptionError, match="no RGB-D options"):
        open_project(tmp_path / "colmap", rgbd=RgbdOptions())
    with pytest.raises(OptionError, match="expected no images"):
        open_project(tmp_path / "scan", images=tmp_path)


def test_pictures_without_cameras_are_told_from_unknown_folders(tmp_path):
    for index in range(3):
        save(tmp_path / f"{index}.jpg", ramp())
    with pytest.raises(ProjectError, match=r"3 pictures without cameras; .* gvtools capture"):
        open_project(tmp_path)
    save(tmp_path / "mav0/cam0/data/1403715273262142976.png", ramp())
    (tmp_path / "mav0/cam0/sensor.yaml").write_text("sensor_type: camera")
    with pytest.raises(ProjectError, match=r"EuRoC recording.* gvtools capture .*/cam0/data"):
        open_project(tmp_path)
    video = tmp_path / "walk.mp4"
    video.touch()
    with pytest.raises(ProjectError, match=r"a video without cameras; .* gvtools capture"):
        open_project(video)


@pytest.mark.parametrize(
    ("alpha", "masked", "value"),
    [("mask", True, 100), ("ignore", False, 100), ("white", False, 255), ("black", False, 0)],
)
def test_alpha_of_pictures(tmp_path, alpha, masked, value):
    picture = np.full((72, 96, 4), 100, np.uint8)
    picture[:, :48, 3], picture[:, 48:, 3] = 0, 255
    save(tmp_path / "images" / "a.png", picture)
    transforms(tmp_path, [frame()], **PINHOLE)
    scene = open_project(tmp_path, alpha=alpha)
    loaded = scene.views[0].load()
    assert (loaded.mask is not None and not loaded.mask[:, :40].any()) == masked
    assert loaded.rgb[10, 10].tolist() == [value] * 3 and loaded.rgb[10, 90].tolist() == [100] * 3
    assert any(f"alpha channel: {ALPHA[alpha]}" in item.message for item in scene.findings)
    save(tmp_path / "images" / "a.png", picture * np.uint8([1, 1, 1, 0]))
    levels = [item.level for item in open_project(tmp_path, alpha=alpha).findings]
    assert ("warning" in levels) == masked  # all of it is transparent


def test_a_device_is_not_called_absent() -> None:
    with pytest.raises(ProjectError, match="neither a folder nor a file"):
        open_project("/dev/null")


NAMES = tuple(f"img{i}.png" for i in range(10))


@pytest.mark.parametrize(
    ("spec", "indices"),
    [
        ("all", range(10)),
        ("every:3", [0, 3, 6, 9]),
        ("every:4+1", [1, 5, 9]),
        ("first:2", [0, 1]),
        ("last:3", [7, 8, 9]),
        ("range:2-4", [2, 3, 4]),
        ("not:every:2", [1, 3, 5, 7, 9]),
        ("not:not:first:1", [0]),
        ("not:img3.png, img1.png", [0, 2, 4, 5, 6, 7, 8, 9]),
        ("img7.png,img2.png", [2, 7]),
    ],
)
def test_forms(spec, indices):
    assert select(NAMES, spec) == tuple(NAMES[i] for i in indices)


def test_names_in_a_file_and_names_with_commas_and_colons(tmp_path):
    listed = tmp_path / "targets.txt"
    listed.write_text("# held out\nimg9.png\n\nimg0.png\n")
    assert select(NAMES, f"@{listed}") == ("img0.png", "img9.png")
    assert select(NAMES, f"not:@{listed}") == NAMES[1:9]
    odd = ("a,b.png", "first:2", "c.png")
    assert select(odd, "a,b.png") == ("a,b.png",)
    assert select(odd, "first:2") == ("first:2",)
    assert select(odd, "not:first:2,c.png") == ("a,b.png",)
    assert select(odd, "a,b.png,c.png") == ("a,b.png", "c.png")
    assert select(odd, "c.png, a,b.png") == ("a,b.png", "c.png")
    assert select(("a", "b", "a,b"), "a,b") == ("a,b",)
    with pytest.raises(OptionError, match=r"no view named 'd:oops' among 2; did you mean"):
        select(("d:1", "d:2"), "d:1,d:oops")
    with pytest.raises(OptionError, match=r"no view named 'b\.png'"):
        select(odd, "b.png,c.png")
    with pytest.raises(OptionError, match="unreadable"):
        select(NAMES, "@nowhere.txt")


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ("img33.png", "did you mean 'img3.png'"),
        ("evry:3", "did you mean 'every'"),
        ("every:x", "'x' after 'every'"),
        ("every:0", "steps of 1 or more"),
        ("every:50+20", "none of 10 views"),
        ("range:4-10", "0 <= A <= B <= 9"),
        ("first:11", "there are 10 views"),
        ("first:0", "none of 10"),
        ("not:all", "none of 10"),
        ("", "none of 10"),
        ("zzz:3", "expected all, every:K"),
    ],
)
def test_wrong_selections(spec, told):
    with pytest.raises(OptionError, match=told) as error:
        select(NAMES, spec)
    assert "\n" not in str(error.value)


def test_overlap_is_refused_with_counts():
    check_disjoint(NAMES[::2], NAMES[1::2])
    with pytest.raises(OptionError, match=r"overlap in 2 views .*'img2.png'.*--allow-overlap"):
        check_disjoint(NAMES[:4], NAMES[2:])
