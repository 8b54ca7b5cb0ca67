"""Traps of rendered data sets: axes, codes for the sky, half pixels, resolutions."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from data_sets import mini_synthetic
from data_sets.miniature import Expected, layout_named, read_miniature
from data_sets.room_frames import rendered_frames
from PIL import Image

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.synthetic import CAMERAS, buffer_depth, halved
from gvtools.scenes.images import exr_depth, hdf5_array
from gvtools.scenes.scene import Scene

WRITERS = {item.layout: item.write for item in mini_synthetic.MINIATURES if not item.variant}


@dataclass(frozen=True)
class Written:
    """A miniature on disk."""

    layout: str
    root: Path
    expected: Expected

    def read(self) -> Scene:
        return read_miniature(self.layout, self.root, self.expected.scene)


@pytest.fixture
def written(request: pytest.FixtureRequest, tmp_path: Path) -> Written:
    """The miniature of the layout that a test names; it may be changed."""
    return Written(request.param, tmp_path, WRITERS[request.param](tmp_path))


def of(*layouts: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("written", layouts, indirect=True)


def warnings(scene: Scene) -> str:
    return "; ".join(item.message for item in scene.findings if item.level == "warning")


# Depth and poses that a partial download lacks.


@of("mvs_synth", "omniworld", "spring", "tartanair", "tartanair_v2", "virtual_kitti")
def test_depth_that_is_not_there_is_counted_and_its_frames_stay(written: Written) -> None:
    suffixes = (".exr", ".npy", ".dsp5", ".png")
    maps = sorted(
        file
        for file in written.root.rglob("*")
        if file.suffix in suffixes
        and any(n in file.parent.relative_to(written.root).as_posix() for n in ("depth", "disp1"))
    )
    maps[2].unlink()
    scene = written.read()
    assert len(scene) == 4
    assert [view.has_depth for view in scene] == [True, True, False, True]
    assert "1 of 4 frames have no depth map" in warnings(scene)
    assert scene.views[2].load().depth is None


@of("spring", "tartanair", "tartanair_v2", "virtual_kitti")
def test_rows_of_poses_that_are_missing_drop_their_frames(written: Written) -> None:
    names = ("pose_left.txt", "pose_lcam_front.txt", "extrinsic.txt", "extrinsics.txt")
    (path,) = (file for file in written.root.rglob("*.txt") if file.name in names)
    lines = path.read_text().splitlines()
    rows = len(lines) // 4 * 3 + len(lines) % 4
    path.write_text("\n".join(lines[:rows]) + "\n")
    scene = written.read()
    assert scene.names == written.expected.cameras.names[:3]
    assert "1 of 4 frames have no pose: dropped" in warnings(scene)
    path.write_text(lines[0] + " 7\n")
    with pytest.raises(ProjectError, match=rf"{path.name}.* numbers|none of 4 frames"):
        written.read()


@of("mvs_synth")
def test_a_damaged_pose_file_is_reported_and_drops_its_frame(written: Written) -> None:
    paths = sorted(written.root.rglob("*.json"))
    paths[0].write_text("{")
    paths[1].unlink()
    scene = written.read()
    assert scene.names == ("0002.png", "0003.png")
    assert "2 of 4 frames have no pose" in warnings(scene)
    assert "0000.json: unreadable (Expecting" in warnings(scene)


@of("gta_sfm")
def test_arrays_that_an_hdf5_file_lacks_drop_their_frames(written: Written) -> None:
    import h5py

    (path,) = written.root.rglob("*.hdf5")
    with h5py.File(path, "a") as file:
        del file["image_0"], file["pose_1"], file["depth_2"]
    scene = written.read()
    assert scene.names == ("image_2", "image_3")
    assert [view.has_depth for view in scene] == [False, True]
    assert "1 of 4 frames have no picture" in warnings(scene)
    assert "1 of 4 frames have no pose" in warnings(scene)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ProjectError, match="unreadable"):
        written.read()


# Traps of each layout.


@of("tartanair")
def test_tartanair_looks_along_x_of_a_north_east_down_frame(written: Written) -> None:
    """A camera at the origin that flies north and level sees what lies east on its right."""
    (path,) = written.root.rglob("pose_left.txt")
    path.write_text("1 2 3 0 0 0 1\n" + "0 0 0 0 0 0.7071067811865476 0.7071067811865476\n" * 3)
    scene = written.read()
    xy, z = scene.cameras.project([[11.0, 7.0, 1.0]])  # 10 m north, 5 m east, 2 m above camera 0
    assert z[0, 0] == pytest.approx(10.0)
    np.testing.assert_allclose(xy[0, 0], [32 + 32 * 5 / 10, 24 - 32 * 2 / 10], atol=1e-9)
    # Turned by 90 degrees about down, it looks east.
    assert z[1, 0] == pytest.approx(7.0)


@of("tartanair_v2")
def test_each_camera_of_tartanair_v2_is_a_scene_and_fisheyes_are_none(written: Written) -> None:
    folder = written.root / "AbandonedCable" / "Data_easy" / "P000"
    for name in ("image_rcam_top", "image_lcam_fish", "image_lcam_equirect", "depth_rcam_back"):
        (folder / name).mkdir()
    names = layout_named("tartanair_v2").scenes(written.root)
    stem = "AbandonedCable/Data_easy/P000"
    assert names == (f"{stem}/lcam_front", f"{stem}/rcam_top")
    assert len(CAMERAS) == 12


@of("virtual_kitti")
def test_virtual_kitti_takes_the_rows_of_the_camera_asked_for(written: Written) -> None:
    frames = written.root / "Scene01" / "clone" / "frames"
    for part in ("rgb", "depth"):
        shutil.copytree(frames / part / "Camera_0", frames / part / "Camera_1")
    names = layout_named("virtual_kitti").scenes(written.root)
    assert names == ("Scene01/clone/Camera_0", "Scene01/clone/Camera_1")
    left, right = (read_miniature("virtual_kitti", written.root, name) for name in names)
    between = right.cameras.cam_from_world[:, :3, 3] - left.cameras.cam_from_world[:, :3, 3]
    np.testing.assert_allclose(between, np.tile([-0.532725, 0, 0], (4, 1)), atol=1e-9)


@of("mvs_synth")
def test_a_right_handed_world_of_mvs_synth_is_left_as_it_is(written: Written) -> None:
    """Every pose has the determinant -1 as stored, and gives a rotation."""
    before = written.read().cameras.cam_from_world
    for path in written.root.rglob("*.json"):
        values = json.loads(path.read_text())
        stored = np.array(values["extrinsic"])
        assert np.linalg.det(stored[:3, :3]) == pytest.approx(-1)
        values["extrinsic"] = (stored @ np.diag([1.0, -1.0, 1.0, 1.0])).tolist()
        path.write_text(json.dumps(values))
    np.testing.assert_allclose(np.linalg.det(before[:, :3, :3]), 1)
    np.testing.assert_allclose(written.read().cameras.cam_from_world, before, atol=1e-12)


def test_omniworlds_depth_buffer_is_not_linear(tmp_path: Path) -> None:
    """Values of yangzhou24/OmniWorld's load_depth, worked out by hand from its formula."""
    raw = np.array([[0, 98, 99, 32768, 62258, 65500, 65501, 65535]], np.uint16)
    Image.fromarray(raw).save(tmp_path / "depth.png")
    depth = buffer_depth(tmp_path / "depth.png")[0]
    share = raw[0] / 65535
    expected = share / (1000 - 999 * share) / 0.004
    expected[[0, 1, 6, 7]] = 0  # less than 0.0015, more than 65500 / 65535
    np.testing.assert_allclose(depth, expected, rtol=1e-6)
    assert depth[3] == pytest.approx(0.24976, abs=1e-4)
    Image.fromarray(np.zeros((2, 2), np.uint8)).save(tmp_path / "depth.png")
    with pytest.raises(ProjectError, match="depth as L"):
        buffer_depth(tmp_path / "depth.png")


@of("spring")
def test_springs_depth_is_that_of_the_frames_pixel_centres(written: Written) -> None:
    """Disparity is in pixels of the frame at twice its resolution; every second value is off."""
    scene = written.read()
    fine = rendered_frames((92.0, 92.0, 64.0, 48.0), 128, 96).depth
    errors = []
    for i, view in enumerate(scene):
        depth, true = view.load().depth, np.asarray(written.expected.depth)[i]
        assert depth is not None
        seen = true > 0
        ours = np.abs(depth / np.where(seen, true, 1) - 1)[seen]
        every_second = np.abs(fine[i, ::2, ::2] / np.where(seen, true, 1) - 1)[seen]
        errors.append([np.quantile(ours, 0.7), np.median(every_second)])
    most, every_second = np.max(errors, axis=0)
    assert most < 1e-5
    assert every_second > 1e-3


def test_an_edge_through_a_block_gives_one_of_its_surfaces() -> None:
    near, far = 10.0, 4.0
    blocks = [
        [near, far, near, far],
        [near, near, far, far],
        [near] * 3 + [far],
        [far] * 3 + [near],
    ]
    image = np.concatenate([np.reshape(block, (2, 2)) for block in blocks], axis=1)
    np.testing.assert_array_equal(halved(image), [[near, near, near, far]])
    np.testing.assert_array_equal(halved(np.array([[0, 0], [0, near]])), [[0]])


@of("spring")
def test_springs_sky_is_told_by_its_map_alone(written: Written) -> None:
    """Disparity says nothing of some of the sky; without the map, that stays far away."""
    shutil.rmtree(written.root / "spring/train/0011/maps")
    scene = written.read()
    assert any("4 frames have no map of the sky" in item.message for item in scene.findings)
    depth = scene.views[0].load().depth
    assert depth is not None
    assert (depth[2:4, :3] > 0).all()
    assert (depth[:2, :3] == 0).all()


def test_errors_of_array_files_say_what_is_there(tmp_path: Path) -> None:
    import h5py
    import OpenEXR

    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["image_0"] = np.zeros(3)
    with pytest.raises(ProjectError, match="holds image_0; expected 'depth'"):
        hdf5_array(tmp_path / "a.h5", "depth")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    path = tmp_path / "a.exr"
    for kind in (np.float16, np.float32):
        OpenEXR.File(header, {"R": np.array([[1.5, np.inf]], kind)}).write(str(path))
        read = exr_depth(path, channels=("Y", "R"))
        assert (read.tolist(), read.dtype) == ([[1.5, 0]], np.float32)
    with pytest.raises(ProjectError, match="channels R; expected Y or Z"):
        exr_depth(path, channels=("Y", "Z"))
