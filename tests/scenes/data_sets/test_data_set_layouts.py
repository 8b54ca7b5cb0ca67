"""Every native layout: a miniature written in it is read back to the pixel and the pose."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from data_sets import (
    mini_aria,
    mini_captures,
    mini_hypersim,
    mini_mvs,
    mini_reconstructed,
    mini_waymo,
)
from data_sets.aria_stand_in import projectaria_tools
from data_sets.miniature import Expected, Miniature, compare, layout_named, miniatures
from data_sets.miniature import read_miniature as read
from data_sets.room_frames import room_frames
from PIL import Image
from scenes_workspace import messages

from gvtools.errors import OptionError, ProjectError
from gvtools.scenes.data_sets.aria import aria_lens
from gvtools.scenes.data_sets.catalogue import (
    DataSetSpec,
    load_spec,
    parse_spec,
    spec_names,
)
from gvtools.scenes.data_sets.hypersim import read_color, turned_pinhole
from gvtools.scenes.images import read_frame
from gvtools.scenes.scene import natural_key

ALL = miniatures()
PARTIAL = [miniature for miniature in ALL if miniature.pictures]


@pytest.fixture(scope="module", params=ALL, ids=lambda miniature: miniature.title)
def written(request, tmp_path_factory):
    """A miniature, where it lies, and what it holds; not to be changed."""
    root = tmp_path_factory.mktemp("miniature")
    return request.param, root, request.param.write(root)


def test_a_miniature_is_read_back(written: tuple[Miniature, Path, Expected]) -> None:
    miniature, root, expected = written
    assert layout_named(miniature.layout).scenes(root) == (expected.scene,)
    with miniature.within():
        scene = read(miniature.layout, root, expected.scene)
        compare(scene, expected, pose_error=miniature.pose_error)
    assert list(scene.names) == sorted(scene.names, key=natural_key)
    assert all(file.is_file() for view in scene for file in view.files)


@pytest.mark.parametrize("miniature", PARTIAL, ids=lambda miniature: miniature.title)
def test_what_a_partial_download_lacks_is_left_out_and_counted(miniature, tmp_path):
    expected = miniature.write(tmp_path)
    pictures = sorted(tmp_path.glob(miniature.pictures))
    pictures[1].unlink()
    pictures[2].write_bytes(b"")
    whole = len(expected.cameras)
    scene = read(miniature.layout, tmp_path, expected.scene)
    assert len(scene) == whole - 2
    assert set(scene.names) < set(expected.cameras.names)
    warnings = [finding.message for finding in scene.findings if finding.level == "warning"]
    assert any(line.startswith(f"2 of {whole} ") for line in warnings), warnings
    for view in scene:
        view.load()
    for picture in pictures:
        picture.unlink(missing_ok=True)
    with pytest.raises(ProjectError):
        read(miniature.layout, tmp_path, expected.scene)


def test_an_empty_folder_holds_no_scene(tmp_path: Path) -> None:
    for name in {miniature.layout for miniature in ALL}:
        assert layout_named(name).scenes(tmp_path) == ()


# --- real scenes, against the readers of projects ---------------------------------------------


FOLDER = Path(__file__).parents[3] / "data_specs" / "data_sets"
# Scenes and images of the paper's table of training data, in its order.
TRAINING = {
    "Aria Digital Twin": (188, 232_115),
    "ARKitScenes": (644, 125_134),
    "DL3DV": (10_475, 3_594_809),
    "MapFree": (460, 515_113),
    "ScanNet++ v2": (954, 1_032_198),
    "Waymo": (3_990, 790_405),
    "RealEstate10K": (66_033, 8_832_823),
    "GTA-SfM": (200, 17_649),
    "Hypersim": (107, 17_348),
    "MVSSynth": (120, 12_000),
    "OmniWorld": (4_486, 794_596),
    "TartanAir": (18, 613_274),
    "TartanAir v2": (74, 7_135_955),
    "Virtual KITTI": (100, 42_520),
    "Spring": (37, 5_000),
}
BENCHMARKS = {
    *("RealEstate10K", "DL3DV", "Mip-NeRF 360", "ScanNetV2"),
    *("LLFF", "DTU", "Tanks and Temples", "7-Scenes", "ETH3D"),
}


@pytest.fixture(scope="module")
def specs() -> dict[str, DataSetSpec]:
    """All of them by printed name."""
    return {load_spec(name).name: load_spec(name) for name in spec_names()}


def test_the_training_sets_have_the_papers_counts(specs: dict[str, DataSetSpec]) -> None:
    training = {name: spec for name, spec in specs.items() if "training" in spec.roles}
    counted = {name: (x.counts.scenes, x.counts.images) for name, x in training.items()}
    assert counted == TRAINING
    # The paper's own totals.
    assert sum(scenes for scenes, _ in TRAINING.values()) == 87_886
    assert sum(images for _, images in TRAINING.values()) == 23_760_939


def test_the_benchmarks_are_there(specs: dict[str, DataSetSpec]) -> None:
    assert {name for name, spec in specs.items() if "benchmark" in spec.roles} == BENCHMARKS
    assert len(specs) == 22


def test_geometry_is_the_papers_rule(specs: dict[str, DataSetSpec]) -> None:
    for name, spec in specs.items():
        if spec.geometry is None:
            assert spec.roles == ("benchmark",), name
        elif name in ("RealEstate10K", "Waymo"):
            assert (spec.geometry.source, spec.geometry.own_share) == ("estimated", 0), name
        else:
            assert (spec.geometry.source, spec.geometry.own_share) == ("mixed", 2 / 3), name


def test_a_wrong_spec_is_named() -> None:
    good = yaml.safe_load((FOLDER / "spring.yaml").read_text(encoding="utf-8"))
    wrong = {
        "camera.pose": {**good, "camera": {**good["camera"], "pose": "cam2world"}},
        "depth.unit_cm": {**good, "depth": {**good["depth"], "unit_cm": 1}},
        "licence": {key: value for key, value in good.items() if key != "licence"},
    }
    for place, content in wrong.items():
        with pytest.raises(OptionError, match=place):
            parse_spec(yaml.safe_dump(content), where="spring.yaml")


def test_an_unknown_name_has_a_hint() -> None:
    with pytest.raises(OptionError, match="did you mean 'scannetppv2'"):
        load_spec("ScanNet++")


# --- RealEstate10K ----------------------------------------------------------------------------


def test_realestate10k_takes_the_video_frame_nearest_to_a_time_stamp(tmp_path: Path) -> None:
    expected = mini_captures.write_video(tmp_path)
    video = next(tmp_path.glob("videos/*"))
    assert expected.rgb is not None
    for seconds, number in ((0.2, 0), (0.24, 0), (0.16, 0), (2.249, 2), (3.151, 3)):
        np.testing.assert_array_equal(read_frame(video, seconds=seconds).rgb, expected.rgb[number])
    for seconds in (0.26, 0.1, 3.26):  # black ones lie between them
        assert not read_frame(video, seconds=seconds).rgb.any()


def test_realestate10k_frames_that_a_cut_video_lacks_are_refused(tmp_path: Path) -> None:
    """Its head still tells the whole length; no other frame may stand for a missing one."""
    expected = mini_captures.write_video(tmp_path)
    video = next(tmp_path.glob("videos/*"))
    content = video.read_bytes()
    video.write_bytes(content[: len(content) // 2])
    views = read("realestate10k", tmp_path, expected.scene).views
    assert expected.rgb is not None
    np.testing.assert_array_equal(views[0].load().rgb, expected.rgb[0])
    with pytest.raises(ProjectError, match=r" s: unreadable \(no frame\); expected a whole video"):
        views[-1].load()


def test_realestate10k_frames_past_the_videos_end_are_left_out(tmp_path: Path) -> None:
    expected = mini_captures.write_video(tmp_path)
    path = next(tmp_path.glob("train/*.txt"))
    late = [line.split() for line in path.read_text().splitlines()[1:3]]
    for words in late:
        words[0] = str(int(words[0]) + 60_000_000)
    with path.open("a") as file:
        file.write("\n".join(" ".join(words) for words in late) + "\n")
    scene = read("realestate10k", tmp_path, expected.scene)
    assert scene.names == expected.cameras.names
    assert "2 of 6 frames lie past the video's end: dropped" in messages(scene)
    next(tmp_path.glob("videos/*")).write_bytes(b"no video")
    with pytest.raises(ProjectError, match="expected a whole video; copy it again"):
        read("realestate10k", tmp_path, expected.scene)


# --- folders of reduced pictures --------------------------------------------------------------


def test_mipnerf360_reads_the_largest_pictures_and_others_on_request(tmp_path: Path) -> None:
    expected = mini_reconstructed.write_mipnerf360(tmp_path)
    layout = layout_named("mipnerf360")
    tiny = tmp_path / "garden" / "images_8"
    tiny.mkdir()
    for path in (tmp_path / "garden" / "images_4").iterdir():
        # A folder of copies with another suffix, of a size that is no eighth.
        Image.open(path).resize((32, 24)).save(tiny / f"{path.stem}.png")
    assert layout.variants(tmp_path) == ("garden/images_4", "garden/images_8")
    compare(read("mipnerf360", tmp_path, "garden"), expected)
    compare(read("mipnerf360", tmp_path, "garden/images_4"), expected)
    small = read("mipnerf360", tmp_path, "garden/images_8")
    np.testing.assert_allclose(
        small.cameras.K, expected.cameras.resized(32, 24).K, rtol=0, atol=1e-9
    )
    assert "4 pictures of 32x24 for cameras of 259x195: intrinsics scaled" in messages(small)


def test_llff_does_not_guess_which_picture_a_row_is_of(tmp_path: Path) -> None:
    expected = mini_reconstructed.write_llff(tmp_path)
    folder = tmp_path / "fern" / "images_4"
    for i, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"IMG_{4026 + i}.JPG")
    whole = read("llff", tmp_path, "fern")
    np.testing.assert_allclose(
        whole.cameras.cam_from_world, expected.cameras.cam_from_world, atol=1e-12
    )
    (folder / "IMG_4027.JPG").unlink()
    with pytest.raises(ProjectError, match="3 pictures for 4 poses"):
        read("llff", tmp_path, "fern")
    # The model beside it names the pictures.
    full = mini_reconstructed.frames_with_copy()[0]
    names = tuple(f"IMG_{4026 + i}.JPG" for i in range(4))
    mini_reconstructed.write_colmap(
        tmp_path / "fern" / "sparse" / "0", mini_reconstructed.replace(full, names=names)
    )
    scene = read("llff", tmp_path, "fern")
    assert scene.names == (names[0], *names[2:])
    np.testing.assert_allclose(
        scene.cameras.cam_from_world, expected.cameras.cam_from_world[[0, 2, 3]], atol=1e-12
    )


# --- benchmarks of stereo ---------------------------------------------------------------------


def test_dtu_reads_one_light_and_prefers_the_fourth(tmp_path: Path) -> None:
    expected = mini_mvs.write_dtu_training(tmp_path)
    folder = tmp_path / expected.scene
    for path in list(folder.iterdir()):
        Image.fromarray(np.asarray(Image.open(path)) // 2).save(
            folder / path.name.replace("_3_", "_0_")
        )
    compare(read("dtu", tmp_path, expected.scene), expected)
    for path in folder.glob("*_3_*"):
        path.unlink()
    assert read("dtu", tmp_path, expected.scene).names[0] == "rect_001_0_r5000.png"


def test_tanks_trajectory_without_intrinsics_is_refused(tmp_path: Path) -> None:
    expected = mini_mvs.write_tanks_official(tmp_path)
    (tmp_path / expected.scene / "intrinsics.txt").unlink()
    with pytest.raises(ProjectError, match="which the data set does not publish"):
        read("tanks_and_temples", tmp_path, expected.scene)


def test_eth3d_depth_needs_the_original_calibration(tmp_path: Path) -> None:
    expected = mini_reconstructed.UNDISTORTED(tmp_path)
    shutil.rmtree(tmp_path / expected.scene / "dslr_calibration_jpg")
    scene = read("eth3d", tmp_path, expected.scene)
    assert not any(view.has_depth for view in scene)
    assert "depth is of the original pictures and needs dslr_calibration_jpg" in messages(scene)


# --- poses that are absent or damaged ---------------------------------------------------------


def test_mapfree_poses_that_are_withheld_are_left_out(tmp_path: Path) -> None:
    expected = mini_captures.write_mapfree(tmp_path)
    path = tmp_path / expected.scene / "poses.txt"
    lines = path.read_text().splitlines()
    lines[3] = f"{lines[3].split()[0]} 0 0 0 0 0 0 0"
    path.write_text("\n".join(lines))
    next(tmp_path.glob("train/*/seq0/*.npy")).unlink()
    scene = read("mapfree", tmp_path, expected.scene)
    assert len(scene) == 3
    assert "1 of 4 frames have no pose: dropped (seq1/frame_00000.jpg)" in messages(scene)
    assert "1 of 3 frames have no depth map (seq0/frame_00000.jpg)" in messages(scene)
    assert [view.has_depth for view in scene] == [False, True, True]


def test_hypersim_tables_that_were_cut_off_are_named(tmp_path: Path) -> None:
    expected = mini_hypersim.MINIATURES[0].write(tmp_path)
    table = tmp_path / "metadata_camera_parameters.csv"
    lines = table.read_text().splitlines()
    row = next(line for line in lines if line.startswith(expected.scene.partition("/")[0]))
    table.write_text("\n".join((lines[0], ",".join(row.split(",")[:4]))))
    with pytest.raises(ProjectError, match="copy the file again"):
        read("hypersim", tmp_path, expected.scene)
    next(tmp_path.glob("*/_detail/metadata_scene.csv")).write_text("meters_per_asset_unit,")
    table.unlink()
    with pytest.raises(ProjectError, match="no meters_per_asset_unit"):
        read("hypersim", tmp_path, expected.scene)


def test_scannet_stream_that_ends_early_gives_its_whole_frames(tmp_path: Path) -> None:
    expected = mini_captures.write_sens(tmp_path, keep=0.6)
    scene = read("scannet", tmp_path, expected.scene)
    assert scene.names == ("0", "1")
    assert "2 of 4 frames are past the end of scene0000_00.sens: dropped" in messages(scene)
    np.testing.assert_array_equal(scene.views[1].load().rgb, expected.rgb[1])  # type: ignore[index]


# --- ARKitScenes ------------------------------------------------------------------------------


def test_arkitscenes_high_resolution_pair_has_its_own_intrinsics(tmp_path: Path) -> None:
    expected = mini_captures.write_arkitscenes(tmp_path)
    layout = layout_named("arkitscenes")
    assert layout.variants(tmp_path) == (f"{expected.scene}/wide",)
    scene = read("arkitscenes", tmp_path, f"{expected.scene}/wide")
    large = room_frames(4, 128, 96)
    np.testing.assert_allclose(scene.cameras.K, large.cameras.K, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        scene.cameras.cam_from_world, expected.cameras.cam_from_world, rtol=0, atol=1e-9
    )
    frame = scene.views[2].load()
    assert frame.depth is not None
    np.testing.assert_array_equal(frame.rgb, large.rgb[2])
    np.testing.assert_allclose(frame.depth, large.depth[2], rtol=1e-6, atol=0.0005)


def test_arkitscenes_frames_between_poses_are_interpolated_and_others_left_out(tmp_path):
    expected = mini_captures.write_arkitscenes(tmp_path)
    folder = tmp_path / expected.scene
    for kind, suffix in (("lowres_wide", "png"), ("lowres_wide_intrinsics", "pincam")):
        for time in (6845.857, 6846.5):
            first = next(iter(sorted((folder / kind).iterdir())))
            shutil.copy(
                first, folder / kind / f"{mini_captures.ARKITSCENES_VIDEO}_{time:.3f}.{suffix}"
            )
    scene = read("arkitscenes", tmp_path, expected.scene)
    assert len(scene) == 5
    assert "1 of 6 frames have no pose: dropped" in messages(scene)
    assert "1 frames have an interpolated pose" in messages(scene)
    between = scene[f"{mini_captures.ARKITSCENES_VIDEO}_6845.857.png"].camera
    middle = expected.cameras.centers[:2].mean(axis=0)
    # Stamps in the trajectory are 0.4 ms late: a hundredth of the way to the middle.
    assert np.linalg.norm(between.centers[0] - middle) < 0.01 * np.linalg.norm(
        np.diff(expected.cameras.centers[:2], axis=0)
    )


def test_arkitscenes_tells_where_the_sky_is(tmp_path: Path) -> None:
    expected = mini_captures.write_arkitscenes(tmp_path)
    assert "sky" not in messages(read("arkitscenes", tmp_path, expected.scene))
    from scipy.spatial.transform import Rotation

    path = tmp_path / expected.scene / "lowres_wide.traj"
    rows = np.loadtxt(path)
    quarter = Rotation.from_euler("z", -90, degrees=True)  # the device held on its side
    rows[:, 1:4] = (quarter * Rotation.from_rotvec(rows[:, 1:4])).as_rotvec()
    np.savetxt(path, rows, fmt="%.17g")
    found = messages(read("arkitscenes", tmp_path, expected.scene))
    assert "the sky is to the left of pictures" in found


# --- Hypersim ---------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", sorted(mini_hypersim.PUBLISHED))
def test_hypersim_stored_pixels_are_found_along_published_rays(scene: str) -> None:
    """Pixels of the pinhole show what the published matrix says that their rays hit."""
    width, height = 1024, 768
    M = np.array(mini_hypersim.PUBLISHED[scene][0]).reshape(3, 3)
    camera = turned_pinhole(M, (width, height))
    y, x = np.mgrid[:height, :width].astype(np.float32) + 0.5
    stored = camera.straight(np.stack([x, y], axis=-1), nearest=False)
    fx, fy, cx, cy = camera.lens.values
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)
    opengl = np.diag([1.0, -1, -1]) @ camera.stored_from_turned
    uv = rays.reshape(-1, 3) @ (np.linalg.inv(M) @ opengl).T
    uv = uv[:, :2] / uv[:, 2:]
    expected = np.stack([(uv[:, 0] + 1) * width / 2, (1 - uv[:, 1]) * height / 2], axis=-1)
    inside = (expected > 1).all(axis=1) & (expected < [width - 1, height - 1]).all(axis=1)
    assert inside.mean() > 0.98
    off = np.abs(stored.reshape(-1, 2) - expected)[inside]
    assert off.max() < 0.05
    if scene == "ai_041_003":  # without the warp, rows would be off by pixels
        assert np.abs(np.stack([x, y], -1).reshape(-1, 2) - expected)[inside].max() > 3


def test_hypersim_without_the_file_of_parameters_says_so(tmp_path: Path) -> None:
    expected = mini_hypersim.write(tmp_path, scene="ai_038_009", linear=False)
    for path in tmp_path.glob("ai_038_009/images/*_final_preview/*.jpg"):
        Image.open(path).resize((1024, 768)).save(path, format="PNG")
    (tmp_path / "metadata_camera_parameters.csv").unlink()
    scene = read("hypersim", tmp_path, expected.scene)
    assert "60 degrees across are taken" in messages(scene)
    np.testing.assert_allclose(scene.cameras.K[0, 0, 0], 512 / np.tan(np.radians(30)))


def test_hypersim_tone_curve_is_that_of_the_data_sets_tools(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    light = rng.gamma(2.0, 3.0, (48, 64, 3)).astype(np.float32)
    ids = np.ones((48, 64), np.int32)
    ids[:8] = -1
    light[:8] *= 50  # windows, which show nothing
    home = tmp_path / "images"
    name = "scene_cam_00_final_hdf5/frame.0000.color.hdf5"
    mini_hypersim.save_hdf5(home / name, light)
    entities = "scene_cam_00_geometry_hdf5/frame.0000.render_entity_id.hdf5"
    mini_hypersim.save_hdf5(home / entities, ids)
    shown = read_color(home / name).rgb.astype(np.float64) / 255
    brightness = 0.3 * light[..., 0] + 0.59 * light[..., 1] + 0.11 * light[..., 2]
    current = np.percentile(brightness[8:], 90)
    scale = 0.8 ** (1 / (1 / 2.2)) / current
    expected = np.clip((scale * light) ** (1 / 2.2), 0, 1)
    np.testing.assert_allclose(shown, expected, rtol=0, atol=0.5 / 255 + 1e-6)


# --- ScanNet++, Waymo -------------------------------------------------------------------------


def test_scannetpp_masks_follow_the_undistortion(tmp_path: Path) -> None:
    expected = mini_reconstructed.write_fisheye(tmp_path)
    mask = read("scannetpp", tmp_path, expected.scene).views[0].load().mask
    assert mask is not None
    lens = mini_reconstructed.fisheye(
        mini_reconstructed.SCANNETPP_FISHEYE, mini_reconstructed.PARAMS
    )
    # The middle of the masked part of the fisheye picture, in the pinhole's pixels.
    ray = np.append(np.asarray(lens.cam_from_img(np.array([[34.5, 25.0]])))[0], 1)
    x, y, _ = expected.cameras.K[0] @ ray
    assert not mask[int(y), int(x)]
    assert mask.mean() > 0.9


def test_waymo_takes_the_frames_pose_where_pictures_have_none(tmp_path: Path) -> None:
    expected = mini_waymo.write(tmp_path, own_poses=False)
    scene = read("waymo", tmp_path, expected.scene)
    compare(scene, expected)
    assert "4 pictures have their frame's pose" in messages(scene)
    shutil.rmtree(tmp_path / "training" / "vehicle_pose")
    with pytest.raises(ProjectError, match="4 of 4 frames have no pose"):
        read("waymo", tmp_path, expected.scene)


# --- Aria Digital Twin ------------------------------------------------------------------------


def test_aria_lens_projects_as_the_official_tools() -> None:
    """Values that projectaria_tools 2.3.0 gives for a FISHEYE624 camera of these parameters."""
    values = (610.9, 711.2, 709.4, *mini_aria.PARAMS[3:])
    points = np.array([[0, 0, 1], [0.3, 0.2, 1], [-0.5, 0.4, 1], [0.9, -0.7, 1], [-1, 1, 1]])
    official = [
        [711.2, 709.4],
        [894.42369727, 831.59135017],
        [414.56037259, 946.80005992],
        [1197.46209743, 331.38097377],
        [205.24181961, 1215.57873122],
    ]
    found = aria_lens(values, (1408, 1408), 700.0).source.img_from_cam(points)
    np.testing.assert_allclose(found, np.array(official) + 0.5, rtol=0, atol=1e-7)


def test_aria_first_version_has_the_scalar_of_quaternions_first(tmp_path: Path) -> None:
    expected = mini_aria.write(tmp_path, version="1.0")
    with projectaria_tools():
        scene = read("aria_digital_twin", tmp_path, expected.scene)
        compare(scene, expected)
    assert "quaternions of version 1.0" in messages(scene)


def test_aria_recordings_need_the_official_package(tmp_path, monkeypatch):
    expected = mini_aria.write(tmp_path)
    monkeypatch.setitem(sys.modules, "projectaria_tools", None)
    with pytest.raises(OptionError, match=r"pip install 'gvtools\[aria\]'"):
        read("aria_digital_twin", tmp_path, expected.scene)
    (tmp_path / expected.scene / "video.vrs").write_bytes(b"none")
    monkeypatch.undo()
    with projectaria_tools(), pytest.raises(ProjectError, match="expected a VRS file; copy"):
        read("aria_digital_twin", tmp_path, expected.scene)


def test_aria_frames_beyond_the_trajectory_are_left_out(tmp_path: Path) -> None:
    expected = mini_aria.write(tmp_path)
    path = tmp_path / expected.scene / "aria_trajectory.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], *lines[3:4]]))  # without the second and the last pose
    with projectaria_tools():
        scene = read("aria_digital_twin", tmp_path, expected.scene)
    assert scene.names == expected.cameras.names[:3]
    assert "1 of 4 frames have no pose: dropped" in messages(scene)
    middle = expected.cameras.centers[[0, 2]].mean(axis=0)
    np.testing.assert_allclose(scene.cameras.centers[1], middle, atol=1e-3)
