"""gvtools render with the cameras' lens and others, and panoramas of film and reconstruct."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from box_project import HEIGHT, SIZE, WIDTH, fused, write_box
from command_line import refused, run_command
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageSequence
from skimage.metrics import structural_similarity
from tiny_scan import write_scan
from trajectory_writers import write_tum

from gvtools.cameras import concatenate
from gvtools.capture.panoramas import lens_of
from gvtools.capture.photographs import CapturedPhotograph
from gvtools.errors import OptionError, ProjectError
from gvtools.memory.panoramas import LensOptions
from gvtools.memory.ply import export_memory_ply
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.runs.layout import file_stems
from gvtools.runs.poses import RunPoses
from gvtools.runs.run import load_memory
from gvtools.scenes.project import open_project
from pipelines.bench.procedural_cloud import inside_camera, photograph
from pipelines.cli import main
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.settings import RunSettings
from pipelines.rendering import FilmRenderer, film_cameras, write_film
from pipelines.spherical_metadata import mark_mp4


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A project of six views and a run whose memory holds three of them."""
    root = tmp_path_factory.mktemp("box")
    scene = write_box(root / "project")
    (root / "run").mkdir()
    fused(scene, [0, 2, 4]).save(root / "run" / "memory.npz")
    return root


def run(*words: object) -> None:
    run_command("render", *words, quiet=True)


def of_box(box: Path, *words: object) -> None:
    """The box's run in cameras of its project."""
    run(box / "run", "--cameras", box / "project", *words)


def rendered(folder, stem):
    rgb = np.asarray(Image.open(folder / f"{stem}.rgb.png"))
    depth = np.load(folder / f"{stem}.depth.npz")["depth"]
    valid = np.asarray(Image.open(folder / f"{stem}.valid.png"))
    confidence = np.asarray(Image.open(folder / f"{stem}.confidence.png"))
    return rgb, depth, valid, confidence


def test_the_files_hold_the_projection(box, tmp_path):
    of_box(box, "--views", "every:2+1", "--out", tmp_path)
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
    words = ("--views", "view_1.png", "--against-images", "--json", file)
    run(box / "run" / "memory.npz", "--cameras", box / "project", *words)
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
    file = tmp_path / "figures.json"
    words = ("--views", "view_12.png", "--against-images", "--json", file)
    run(tmp_path / "memory.npz", "--cameras", tmp_path / "project", *words)
    data = json.loads(file.read_text())
    # The view's own pixels, averaged in voxels of about two of them.
    assert data["psnr_generated"] > 20
    assert data["depth_rel_generated"] < 0.01


def test_pictures_that_are_others_are_warned_of(box, tmp_path, capsys):
    files = sorted((box / "project").rglob("view_*.png"))
    renumbered = "renumbered: what is shown is nearer to the picture after"
    for said in ("", renumbered, "mirrored", "of another scene"):
        project = shutil.copytree(box / "project", tmp_path / (said[:4] or "own"))
        for file, after in pairwise(files):
            there = project / file.relative_to(box / "project")
            picture = np.asarray(Image.open(file))
            if said == renumbered:
                shutil.copy(file, there.with_name(after.name))
            elif said:
                changed = picture[:, ::-1] if said == "mirrored" else 255 - picture
                Image.fromarray(changed).save(there)
        few = ("--views", "first:2") if said == "of another scene" else ()
        run(box / "run", "--cameras", project, "--against-images", *few)
        warned = capsys.readouterr().err
        assert said in warned and bool(said) == ("seem to be" in warned)


def test_without_comparing_the_figures_are_null_with_a_reason(box, tmp_path):
    file = tmp_path / "figures.json"
    of_box(box, "--views", "first:2", "--out", tmp_path / "out", "--json", file)
    data = json.loads(file.read_text())
    assert data["psnr"] is None and "--against-images" in data["notes"]["psnr"]
    assert data["coverage"] > 0.5


def test_a_trajectory_gives_cameras(box, tmp_path):
    cameras = concatenate(
        [inside_camera(SIZE, turn=t, width=WIDTH, height=HEIGHT) for t in (0.1, 0.3)]
    )
    write_tum(tmp_path / "path.txt", cameras)
    words = (box / "run", "--cameras", tmp_path / "path.txt", "--out", tmp_path / "out")
    run(*words)
    first = rendered(tmp_path / "out", "0")
    guidance = SpatialMemory.load(box / "run" / "memory.npz").project(cameras[0])
    np.testing.assert_allclose(first[1], guidance.depth[0], atol=1e-5)
    with pytest.raises(OptionError, match="without pictures"):
        run(*words, "--against-images")


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
    words = ("--views", "first:1", "--out")
    of_box(box, *words, tmp_path / "a")
    changed = ("--set", "splat.max_splat_px=0.1", "--set", "splat.support=2")
    of_box(box, *words, tmp_path / "b", *changed)
    covered = [rendered(tmp_path / name, "view_0")[2].mean() for name in "ab"]
    assert covered[1] < covered[0]
    for option, value, said in (
        ("--set", "seed=2", r"takes splat\.KEY=VALUE"),
        ("--set", "splat.bnd=2", "did you mean"),
        ("--backend", "gpu", "backend 'gpu'"),
    ):
        with pytest.raises(OptionError, match=said):
            of_box(box, *words, tmp_path / "c", option, value)


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
    of_box(box, "--views", "view_1.png", "--against-images", "--json", file)
    assert json.loads(file.read_text())["psnr"] > 0
    assert [path.name for path in tmp_path.iterdir()] == ["figures.json"]
    with pytest.raises(OptionError, match="--against-images"):
        of_box(box, "--views", "view_1.png")


def test_a_panorama_is_a_picture_that_viewers_know(box, tmp_path):
    lens = ("--lens", "equirectangular", "--width", 258)
    of_box(box, "--views", "first:1", *lens, "--out", tmp_path)
    for name in ("view_0.rgb.png", "view_0.jpg"):
        with Image.open(tmp_path / name) as image:
            assert image.size == (256, 128)
            xmp = image.info["xmp"]
        for stated in (b'ProjectionType="equirectangular"', b'FullPanoWidthPixels="256"'):
            assert stated in xmp
        nothing = np.zeros(0, np.uint8)
        item = CapturedPhotograph(tmp_path / name, name, (256, 128), "", False, 0.0, nothing)
        assert lens_of([item], "auto") == "equirectangular"
    depth = np.load(tmp_path / "view_0.depth.npz")["depth"]
    valid = np.asarray(Image.open(tmp_path / "view_0.valid.png")) > 0
    assert 0.05 < valid.mean() < 1
    # Along the rays inside a box: never farther than its diagonal.
    assert (depth[valid] > 0).all()
    assert depth.max() < np.linalg.norm(SIZE)


def test_a_completed_panorama_has_no_holes_and_keeps_what_is_known(box, tmp_path):
    words = ("--views", "first:1", "--lens", "equirectangular", "--width", 128, "--out")
    of_box(box, *words, tmp_path / "known")
    of_box(box, *words, tmp_path / "whole", "--complete")
    known, whole = (
        {kind: np.asarray(Image.open(tmp_path / name / f"view_0.{kind}.png")).astype(int)
         for kind in ("rgb", "valid")} for name in ("known", "whole")
    )  # fmt: skip
    assert (whole["valid"] == 255).all()
    assert (np.load(tmp_path / "whole" / "view_0.depth.npz")["depth"] > 0).all()
    inner = cv2.erode((known["valid"] > 0).astype(np.uint8), np.ones((3, 3))) > 0
    assert 0.02 < inner.mean() < 0.9
    assert np.abs(known["rgb"] - whole["rgb"])[inner].mean() < 2


def test_a_fisheye_is_black_outside_of_its_circle(box, tmp_path):
    lens = ("--lens", "fisheye", "--field-of-view", 60, "--width", 64)
    of_box(box, "--views", "first:1", *lens, "--out", tmp_path)
    rgb = np.asarray(Image.open(tmp_path / "view_0.rgb.png"))
    y, x = np.mgrid[:64, :64] - 31.5
    assert rgb.shape == (64, 64, 3)
    assert (rgb[np.hypot(x, y) > 32] == 0).all()
    assert (rgb[np.hypot(x, y) < 12] > 0).any(axis=-1).all()
    assert not (tmp_path / "view_0.jpg").exists()


def test_a_width_resizes_pictures_of_the_cameras_own_lens(box, tmp_path):
    of_box(box, "--views", "first:1", "--out", tmp_path / "own")
    of_box(box, "--views", "first:1", "--out", tmp_path / "half", "--width", WIDTH // 2)
    own, half = (Image.open(tmp_path / name / "view_0.rgb.png") for name in ("own", "half"))
    assert half.size == (WIDTH // 2, HEIGHT // 2)
    apart = np.asarray(own.resize(half.size, Image.Resampling.BOX)).astype(int) - np.asarray(half)
    assert np.abs(apart).mean() < 8


def test_a_film_of_panoramas_says_so_and_plays(box, tmp_path):
    av = pytest.importorskip("av")
    out = tmp_path / "film.mp4"
    run_command(
        "film", box / "run", "--path", "interpolate:3", "--lens", "equirectangular",
        "--width", 128, "--complete", "--out", out, quiet=True,
    )  # fmt: skip
    with av.open(str(out)) as film:
        frames = list(film.decode(video=0))
    assert len(frames) == 3
    for frame in frames:
        assert (frame.width, frame.height) == (128, 64)
        sides = {side.type.name: bytes(side) for side in frame.side_data}
        # libavutil's AVSphericalMapping: projection 0 is equirectangular, no turn, no border.
        assert not any(sides["SPHERICAL"])
        assert frame.to_ndarray(format="rgb24").std() > 5


def test_marking_moves_no_picture(tmp_path):
    av = pytest.importorskip("av")
    frames = [np.full((32, 64, 3), 20 * number, np.uint8) for number in range(9)]
    plain, marked = tmp_path / "plain.mp4", tmp_path / "marked.mp4"
    write_film(plain, frames, fps=24)
    write_film(marked, frames, fps=24, panorama=True)
    shown = []
    for path in (plain, marked):
        with av.open(str(path)) as film:
            shown.append([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)])
    np.testing.assert_array_equal(shown[0], shown[1])
    # With the index at the end its chunks stay where they are.
    with av.open(str(tmp_path / "last.mp4"), "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 64, 32, "yuv420p"
        for frame in frames:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        film.mux(stream.encode())
    mark_mp4(tmp_path / "last.mp4")
    with av.open(str(tmp_path / "last.mp4")) as film:
        assert len(list(film.decode(video=0))) == 9


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--field-of-view", "90"), "--field-of-view: belongs to --lens fisheye"),
        (("--lens", "fisheye", "--against-images"), "leave --lens and --width out"),
        (("--lens", "fisheye", "--field-of-view", "400"), "at most 360"),
    ],
)
def test_options_that_do_not_fit(box, tmp_path, capsys, words, said):
    out = tmp_path / "out"
    line = refused(
        capsys, "render", box / "run", "--cameras", box / "project", "--out", out, *words
    )
    assert said in line
    assert not out.exists()


def test_targets_of_another_lens_are_completed_face_by_face_and_written_whole(tmp_path):
    out = tmp_path / "run"
    run_command(
        "reconstruct", write_scan(tmp_path / "scan"), "--context", "every:2", "--targets",
        "first:2", "--lens", "equirectangular", "--set", "lens.width=128", "--refine", 0,
        "--out", out, quiet=True,
    )  # fmt: skip
    record = json.loads((out / "run.json").read_text())
    assert record["targets_kind"] == "equirectangular"
    assert len(record["targets"]) == 12
    # Views that are context may be looked around from, and a round takes whole panoramas.
    assert record["schedule"] == [list(range(6)), list(range(6, 12))]
    wholes = sorted(out.glob("round_*/panorama_*.png"))
    assert [path.parent.name for path in wholes] == ["round_001", "round_002"]
    first = record["targets"][0]
    assert first.endswith("@front.png")
    with Image.open(wholes[0]) as image:
        assert image.size == (128, 64)
        assert b"equirectangular" in image.info["xmp"]
        middle = np.asarray(image)[28:36, 60:68].astype(int)
    stem = first.replace(".png", "").replace("/", "__")
    front = np.asarray(Image.open(out / "round_001" / f"generated_{stem}.png")).astype(int)
    row, column = front.shape[0] // 2, front.shape[1] // 2
    near = front[row - 4 : row + 4, column - 4 : column + 4]
    assert np.abs(near - middle).mean() < 3 < near.std()
    # The run is read back, faces and all.
    run_command("report", out, quiet=True)


def test_faces_move_with_their_picture_when_poses_are_refined(tmp_path):
    scene = open_project(write_scan(tmp_path / "scan"))
    settings = RunSettings().replaced(
        context="every:2", targets="first:1", lens=LensOptions(kind="fisheye", width=64)
    )
    settings = settings.replaced(refine=settings.refine.replaced(steps=0, poses=False))
    plan = make_plan(scene, settings)
    cameras = plan.targets.cameras
    moved = cameras.cam_from_world.copy()
    moved[:, 0, 3] += np.linspace(0.1, 0.2, len(cameras))
    context = scene.subset(plan.context).cameras.cam_from_world
    at = plan.at(RunPoses(context, moved, False, 0.0)).targets.cameras
    np.testing.assert_allclose(at.cam_from_world[0], moved[0], atol=1e-12)
    assert np.ptp(at.centers, axis=0).max() < 1e-9 < np.ptp(moved[:, 0, 3])


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two rounds over a tiny recording."""
    folder = tmp_path_factory.mktemp("film")
    scan = write_scan(folder / "scan")
    run_command(
        "reconstruct", scan, "--context", "every:2", "--targets", "interpolate:4",
        "--set", "views_per_round=4", "--refine", "0", "--set", "refine.poses=false",
        "--out", folder / "run", quiet=True,
    )  # fmt: skip
    return folder / "run"


def frames_of(path: Path) -> list[np.ndarray]:
    if path.suffix == ".mp4":
        av = pytest.importorskip("av")
        with av.open(str(path)) as film:
            return [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    with Image.open(path) as film:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]


@pytest.mark.parametrize("suffix", ["mp4", "gif", "webp"])
def test_a_path_becomes_a_film_of_the_memorys_pictures(filmed, tmp_path, suffix):
    out = tmp_path / f"film.{suffix}"
    assert main(["film", str(filmed), "--path", "interpolate:5", "--out", str(out)]) == 0
    frames = frames_of(out)
    renderer = FilmRenderer(filmed, film_cameras(load_memory(filmed), "interpolate:5"))
    assert len(frames) == 5
    for index in (0, 4):
        drawn = renderer.frame(index, ("memory",))
        assert frames[index].shape == drawn.shape == (72, 96, 3)
        # What coding costs: a film of another place differs by 30 and more.
        assert np.abs(frames[index].astype(int) - drawn).mean() < 6
    assert np.abs(frames[0].astype(int) - renderer.frame(4, ("memory",))).mean() > 12
    assert not list(tmp_path.glob(".*"))


def test_panels_stand_side_by_side_and_completed_has_no_holes(filmed: Path, tmp_path: Path) -> None:
    out = tmp_path / "film.gif"
    # To the left of all captured views: the left of these frames was seen by none.
    path = tmp_path / "path.txt"
    path.write_text("0 -1.5 0 0 0 0 0 1\n1 -1.2 0 0 0 0 0 1\n")
    arguments = ["--path", str(path), "--compare", "observed,completed", "--out", str(out)]
    assert main(["film", str(filmed), *arguments, "--width", "64"]) == 0
    assert frames_of(out)[0].shape == (48, 128, 3)
    cameras = film_cameras(load_memory(filmed), str(path), width=64)
    renderer = FilmRenderer(filmed, cameras, up_to=0)
    observed, completed = (renderer.frame(1, (panel,)) for panel in ("observed", "completed"))
    holes = (observed == 255).all(-1)
    assert holes.any()
    assert not (completed == 255).all(-1).any()
    assert np.abs(observed[~holes].astype(int) - completed[~holes]).max() <= 1


def test_depth_is_red_where_it_is_near(filmed: Path) -> None:
    cameras = film_cameras(load_memory(filmed), "cameras")
    frame = FilmRenderer(filmed, cameras).frame(len(cameras) // 2, ("depth",))
    middle, wall = frame[36, 48].astype(int), frame[5, 5].astype(int)
    assert middle[0] > middle[2]  # the square, in front
    assert wall[2] > wall[0]  # the wall behind it


def test_growth_draws_the_path_once_for_each_round(filmed: Path, tmp_path: Path) -> None:
    out = tmp_path / "growth.webp"
    run_command("film", filmed, "--path", "interpolate:2", "--growth", "--out", out)
    assert len(frames_of(out)) == 2 * len(load_memory(filmed).rounds) > 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "film.avi"], "ends with .mp4, .gif, .webp"),
        (["--out", "f.gif", "--path", "orbit:0"], "N >= 1"),
        (["--out", "f.gif", "--path", "nowhere"], "expected orbit:N"),
        (["--out", "f.gif", "--compare", "memory,colour"], "expected two or more of"),
        (["--out", "f.gif", "--fps", "0.001"], "at least 0.01"),
        (["--out", "f.gif", "--width", "4"], "--width 4"),
        (["--out", "f.gif", "--growth", "--round", "0"], "--growth shows every one"),
    ],
)
def test_wrong_options_are_refused_and_nothing_is_written(
    filmed, tmp_path, capsys, monkeypatch, arguments, said
):
    monkeypatch.chdir(tmp_path)
    assert said in refused(capsys, "film", filmed, *arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("width", [640, 1280])
def test_an_mp4_says_its_colours_and_shows_them(tmp_path, width):
    av = pytest.importorskip("av")
    frame = np.full((width // 2, width, 3), (121, 29, 33), np.uint8)
    write_film(tmp_path / "film.mp4", [frame] * 3, fps=30)
    with av.open(str(tmp_path / "film.mp4")) as film:
        coder = film.streams.video[0].codec_context
        tags = (coder.color_primaries, coder.color_trc, coder.colorspace, coder.color_range)
        assert tags == (1, 1, 1, 1)
        decoded = next(film.decode(video=0))
    shown = decoded.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray()
    assert np.abs(shown.astype(int) - (121, 29, 33)).max() <= 3


@pytest.mark.parametrize(("suffix", "unit"), [("gif", 10), ("webp", 1)])
@pytest.mark.parametrize("fps", [12, 24, 60, 144])
def test_an_animation_lasts_as_long_as_its_frames_and_browsers_obey(tmp_path, suffix, unit, fps):
    frames = [np.full((16, 16, 3), 4 * number, np.uint8) for number in range(60)]
    left_out = write_film(tmp_path / f"film.{suffix}", frames, fps=fps)
    with Image.open(tmp_path / f"film.{suffix}") as film:
        times = []
        for frame in ImageSequence.Iterator(film):
            frame.load()
            times.append(frame.info["duration"])
    assert min(times) >= 20
    assert suffix == "webp" or len(times) == 60 - left_out  # WebP merges frames that look alike
    assert abs(sum(times) - 60_000 / fps) <= unit
