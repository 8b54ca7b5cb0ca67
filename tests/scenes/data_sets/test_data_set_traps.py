"""What readers of public data sets get wrong, one by one: pictures of benchmarks and of videos."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from data_sets import mini_captures, mini_mvs, mini_reconstructed
from data_sets.miniature import compare, layout_named
from data_sets.miniature import read_miniature as read
from data_sets.room_frames import room_frames
from PIL import Image

from gvtools.errors import ProjectError
from gvtools.scenes.data_sets.mvs import decomposed
from gvtools.scenes.scene import Scene
from gvtools.scenes.video import read_frame


def messages(scene: Scene) -> str:
    return "\n".join(finding.message for finding in scene.findings)


# --- RealEstate10K ----------------------------------------------------------------------------


def test_realestate10k_intrinsics_are_shares_of_whatever_size_frames_have(tmp_path: Path) -> None:
    expected = mini_captures.write_frames(tmp_path)
    for path in tmp_path.glob("frames/*/*/*.png"):
        Image.open(path).resize((32, 24)).save(path)
    scene = read("realestate10k", tmp_path, expected.scene)
    np.testing.assert_allclose(
        scene.cameras.K, expected.cameras.resized(32, 24).K, rtol=0, atol=1e-12
    )


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
    with pytest.raises(ProjectError, match=r"no frame at .* copy the video again"):
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
    with pytest.raises(ProjectError, match="no readable video"):
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


def test_mipnerf360_detections_move_with_the_intrinsics(tmp_path: Path) -> None:
    mini_reconstructed.write_mipnerf360(tmp_path)
    scene = read("mipnerf360", tmp_path, "garden")
    assert scene.points is not None
    assert len(scene.points.xy) > 100
    xy, _ = scene.cameras.project(scene.points.positions)
    seen = xy[scene.points.view_index, scene.points.point_index]
    np.testing.assert_allclose(scene.points.xy, seen, rtol=0, atol=1e-3)


@pytest.mark.parametrize("share", [0, 0.5])
def test_arrays_that_were_cut_off_are_named(tmp_path: Path, share: float) -> None:
    writers = {"llff": mini_reconstructed.write_llff, "dtu": mini_mvs.write_dtu_idr}
    for layout, write in writers.items():
        expected = write(tmp_path / layout)
        path = next((tmp_path / layout).rglob("*.np[yz]"))
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(ProjectError, match=f"{path.name}: "):
            read(layout, tmp_path / layout, expected.scene)


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


def test_dl3dv_copies_of_another_size_scale_the_files_intrinsics(tmp_path: Path) -> None:
    expected = mini_reconstructed.write_dl3dv_960p(tmp_path)
    home = tmp_path / expected.scene
    shutil.move(home / "images_4", home / "images_8")
    for path in (home / "images_8").iterdir():
        Image.open(path).resize((32, 24)).save(path)
    scene = read("dl3dv", tmp_path, expected.scene)
    np.testing.assert_allclose(
        scene.cameras.K, expected.cameras.resized(32, 24).K, rtol=0, atol=1e-9
    )
    for path in (home / "images_8").iterdir():
        Image.open(path).resize((32, 32)).save(path)  # a crop or a stretch: no camera fits
    with pytest.raises(ProjectError, match="another aspect than their camera"):
        read("dl3dv", tmp_path, expected.scene)


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


def test_dtu_projection_matrices_of_any_factor_are_split() -> None:
    rng = np.random.default_rng(3)
    K = np.array([[2892.33, 0, 823.2], [0, 2883.18, 619.07], [0, 0, 1]])
    pose = room_frames().cameras.cam_from_world[1]
    for factor in (1.0, -3.0, 1e-3, *rng.normal(size=3)):
        camera = decomposed(factor * K @ pose[:3])
        np.testing.assert_allclose(camera.K, K, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(camera.cam_from_world, pose, atol=1e-9)


def test_tanks_trajectory_without_intrinsics_is_refused(tmp_path: Path) -> None:
    expected = mini_mvs.write_tanks_official(tmp_path)
    (tmp_path / expected.scene / "intrinsics.txt").unlink()
    with pytest.raises(ProjectError, match="which the data set does not publish"):
        read("tanks_and_temples", tmp_path, expected.scene)


def test_eth3d_depth_needs_the_original_calibration(tmp_path: Path) -> None:
    expected = mini_reconstructed.write_eth3d_undistorted(tmp_path)
    shutil.rmtree(tmp_path / expected.scene / "dslr_calibration_jpg")
    scene = read("eth3d", tmp_path, expected.scene)
    assert not any(view.has_depth for view in scene)
    assert "depth is of the original pictures and needs dslr_calibration_jpg" in messages(scene)


def test_eth3d_depth_is_not_that_of_the_same_pixel(tmp_path: Path) -> None:
    """Taken without the lens, the original picture's map would be another scene's."""
    expected = mini_reconstructed.write_eth3d_undistorted(tmp_path)
    raw = np.fromfile(next(tmp_path.glob("courtyard/ground_truth_depth/*/*")), "<f4")
    naive = np.asarray(
        Image.fromarray(raw.reshape(60, 80)).resize((64, 48), Image.Resampling.NEAREST)
    )
    assert expected.depth is not None
    assert (np.abs(naive - expected.depth[0]) < 0.1).mean() < 0.6
