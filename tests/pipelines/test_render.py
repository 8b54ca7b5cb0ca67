from __future__ import annotations

import json

import numpy as np
import pytest
from box_project import HEIGHT, SIZE, WIDTH, fused, write_box
from command_line import run_command
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from skimage.metrics import structural_similarity
from trajectory_writers import write_tum

from gvtools.cameras import concatenate
from gvtools.errors import OptionError, ProjectError
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.runs.layout import file_stems
from pipelines.bench.procedural_cloud import inside_camera, photograph


def run(*words: object) -> None:
    run_command("render", *words, quiet=True)


def rendered(folder, stem):
    rgb = np.asarray(Image.open(folder / f"{stem}.rgb.png"))
    depth = np.load(folder / f"{stem}.depth.npz")["depth"]
    valid = np.asarray(Image.open(folder / f"{stem}.valid.png"))
    confidence = np.asarray(Image.open(folder / f"{stem}.confidence.png"))
    return rgb, depth, valid, confidence


def test_the_files_hold_the_projection(box, tmp_path):
    run(box / "run", "--cameras", box / "project", "--views", "every:2+1", "--out", tmp_path)
    assert len(list(tmp_path.iterdir())) == 3 * 4
    rgb, depth, valid, confidence = rendered(tmp_path, "view_3")
    camera = inside_camera(SIZE, turn=0.36, width=WIDTH, height=HEIGHT)
    guidance = SpatialMemory.load(box / "run" / "memory.npz").project(camera)
    np.testing.assert_array_equal(rgb, np.round(guidance.rgb[0] * 255))
    np.testing.assert_array_equal(depth, guidance.depth[0])
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(valid == 255, guidance.valid[0])
    assert set(np.unique(valid)) <= {0, 255}
    grey = confidence / 255
    np.testing.assert_allclose(
        (grey / (1 - grey))[valid > 0], guidance.confidence[0][valid > 0], rtol=0.03, atol=0.01
    )
    # And the projection shows the box: exact depth, but for the voxels' averaging.
    _, truth = photograph(SIZE, camera)
    assert np.median(np.abs(depth / truth - 1)[valid > 0]) < 0.01


def test_figures_against_pictures_are_skimages(box, tmp_path):
    file = tmp_path / "figures.json"
    run(
        box / "run" / "memory.npz", "--cameras", box / "project", "--views", "view_1.png",
        "--against-images", "--out", tmp_path / "out", "--json", file,
    )  # fmt: skip
    data = json.loads(file.read_text())
    camera = inside_camera(SIZE, turn=0.12, width=WIDTH, height=HEIGHT)
    guidance = SpatialMemory.load(box / "run" / "memory.npz").project(camera)
    truth = photograph(SIZE, camera)[0] / 255
    rgb, valid = guidance.rgb[0].astype(np.float64), guidance.valid[0]
    assert data["psnr"] == pytest.approx(-10 * np.log10(((rgb - truth) ** 2).mean()))
    assert data["psnr_valid"] == pytest.approx(-10 * np.log10(((rgb - truth)[valid] ** 2).mean()))
    expected = structural_similarity(
        rgb, truth, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=-1,
    )  # fmt: skip
    assert data["ssim"] == pytest.approx(expected)
    assert data["coverage"] == pytest.approx(valid.mean())
    assert data["depth_rel_valid"] < 0.01
    assert data["views"] == 1 and data["seconds_per_view"] > 0
    assert data["lpips"] is None and "LPIPS" in data["notes"]["lpips"]
    assert data["psnr_generated"] is None and "no generated" in data["notes"]["psnr_generated"]
    assert data["per_view"][0]["view"] == "view_1.png"


def test_generated_pixels_have_their_own_figures(box, tmp_path):
    scene = write_box(tmp_path / "project", views=14)
    memory = fused(scene, [0, 12], generated=(12,))
    memory.save(tmp_path / "memory.npz")
    run(
        tmp_path / "memory.npz", "--cameras", tmp_path / "project", "--views", "view_12.png",
        "--against-images", "--out", tmp_path / "out", "--json", tmp_path / "figures.json",
    )  # fmt: skip
    data = json.loads((tmp_path / "figures.json").read_text())
    # The view's own pixels, averaged in voxels of about two of them.
    assert data["psnr_generated"] > 20
    assert data["depth_rel_generated"] < 0.01


def test_without_comparing_the_figures_are_null_with_a_reason(box, tmp_path):
    run(
        box / "run", "--cameras", box / "project", "--views", "first:2", "--out", tmp_path / "out",
        "--json", tmp_path / "figures.json",
    )  # fmt: skip
    data = json.loads((tmp_path / "figures.json").read_text())
    assert data["psnr"] is None and "--against-images" in data["notes"]["psnr"]
    assert data["coverage"] > 0.5


def test_a_trajectory_gives_cameras(box, tmp_path):
    cameras = concatenate(
        [inside_camera(SIZE, turn=t, width=WIDTH, height=HEIGHT) for t in (0.1, 0.3)]
    )
    write_tum(tmp_path / "path.txt", cameras)
    run(box / "run", "--cameras", tmp_path / "path.txt", "--out", tmp_path / "out")
    first = rendered(tmp_path / "out", "0")
    guidance = SpatialMemory.load(box / "run" / "memory.npz").project(cameras[0])
    np.testing.assert_allclose(first[1], guidance.depth[0], atol=1e-5)
    with pytest.raises(OptionError, match="without pictures"):
        run(
            box / "run", "--cameras", tmp_path / "path.txt", "--out", tmp_path / "out",
            "--against-images",
        )  # fmt: skip


@pytest.mark.parametrize("name", ["../x.png", "/x.png", "a/../../x.png"])
def test_names_that_lead_out_of_a_folder_are_refused(name):
    with pytest.raises(OptionError, match="leads out"):
        file_stems([name])


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("a/x.png", "b/x.png", "f.color.png"), ("a/x", "b/x", "f.color")),
        (("one.jpg", "one.png", "1305.175304"), ("one.jpg", "one.png", "1305.175304")),
        (("a.png", "a.jpg", "a.png.png"), ("a.png", "a.jpg", "a.png_2")),
        (("a.png", "A.png", "a.png_2"), ("a.png_2", "A.png", "a.png_2_2")),
        (("1", "1.png", "1.PNG"), ("1", "1.png_2", "1.PNG")),
    ],
)
def test_stems_are_the_names_without_endings_unless_they_collide(names, expected):
    assert tuple(str(stem) for stem in file_stems(names).values()) == expected


ENDINGS = ("", ".png", ".PNG", ".jpg", ".png.png", ".png_2")


@given(st.lists(st.builds(
    "a{}{}".format, st.text("aA/_2\\", max_size=3), st.sampled_from(ENDINGS)
), unique=True, max_size=12))  # fmt: skip
def test_stems_are_unique_whatever_the_names(names):
    names = [name for name in names if ".." not in name.replace("\\", "/").split("/")]
    stems = file_stems(names)
    assert list(stems) == names
    assert len({str(stem).lower() for stem in stems.values()}) == len(names)
    assert file_stems(names[::-1]) == stems


def test_sub_folders_are_made(tmp_path):
    scene = write_box(tmp_path / "project", names=["left/0.png", "right/0.png"])
    fused(scene, [0]).save(tmp_path / "memory.npz")
    run(tmp_path / "memory.npz", "--cameras", tmp_path / "project", "--out", tmp_path / "out")
    assert (tmp_path / "out" / "right" / "0.rgb.png").is_file()


def test_settings_of_the_projection(box, tmp_path):
    arguments = (box / "run", "--cameras", box / "project", "--views", "first:1")
    run(*arguments, "--out", tmp_path / "a")
    run(*arguments, "--out", tmp_path / "b", "--set", "splat.max_splat_px=0.1", "--set",
        "splat.support=2")  # fmt: skip
    covered = [rendered(tmp_path / name, "view_0")[2].mean() for name in "ab"]
    assert covered[1] < covered[0]
    with pytest.raises(OptionError, match=r"takes splat\.KEY=VALUE"):
        run(*arguments, "--out", tmp_path / "c", "--set", "seed=2")
    with pytest.raises(OptionError, match="did you mean"):
        run(*arguments, "--out", tmp_path / "c", "--set", "splat.bnd=2")
    with pytest.raises(OptionError, match="backend 'gpu'"):
        run(*arguments, "--out", tmp_path / "c", "--backend", "gpu")


def test_a_ply_has_no_camera_for_a_trajectory(box, tmp_path):
    export_memory_ply(SpatialMemory.load(box / "run" / "memory.npz"), tmp_path / "cloud.ply")
    camera = inside_camera(SIZE, turn=0.1, width=WIDTH, height=HEIGHT)
    write_tum(tmp_path / "path.txt", camera)
    with pytest.raises(OptionError, match="has none of a photograph"):
        run(tmp_path / "cloud.ply", "--cameras", tmp_path / "path.txt", "--out", tmp_path / "out")
    run(tmp_path / "cloud.ply", "--cameras", box / "project", "--views", "first:1", "--out",
        tmp_path / "out")  # fmt: skip
    assert rendered(tmp_path / "out", "view_0")[2].mean() > 0.8 * 255


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [("", ProjectError, r"holds no memory\.npz"), ("absent", ProjectError, "no such file"),
     ("empty.npz", OptionError, "empty memory")],
)  # fmt: skip
def test_what_is_no_memory(box, tmp_path, name, error, said):
    SpatialMemory(0.1).save(tmp_path / "empty.npz")
    with pytest.raises(error, match=said):
        run(tmp_path / name, "--cameras", box / "project", "--out", tmp_path / "out")


def test_an_unfinished_run_gives_its_last_round(box, tmp_path):
    for number in (0, 1):
        (tmp_path / f"round_{number:03d}").mkdir()
    target = tmp_path / "round_001" / "memory.npz"
    target.write_bytes((box / "run" / "memory.npz").read_bytes())
    run(tmp_path, "--cameras", box / "project", "--views", "first:1", "--out", tmp_path / "out")
    assert (tmp_path / "out" / "view_0.rgb.png").is_file()


def test_figures_alone_need_no_folder(box, tmp_path):
    file = tmp_path / "figures.json"
    words = (box / "run", "--cameras", box / "project", "--views", "view_1.png")
    run(*words, "--against-images", "--json", file)
    assert json.loads(file.read_text())["psnr"] > 0
    assert [path.name for path in tmp_path.iterdir()] == ["figures.json"]
    with pytest.raises(OptionError, match="--against-images"):
        run(*words)
