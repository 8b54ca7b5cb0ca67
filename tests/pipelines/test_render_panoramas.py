"""gvtools render, film and reconstruct with another lens: files, and what viewers read in them."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from box_project import HEIGHT, SIZE, WIDTH
from command_line import refused, run_command
from PIL import Image
from tiny_scan import write_scan

from gvtools.capture.panoramas import lens_of
from gvtools.capture.photographs import CapturedPhotograph
from gvtools.memory.panoramas import LensOptions
from gvtools.scenes.project import open_project
from pipelines.reconstruction.prepare import make_plan
from pipelines.reconstruction.settings import RunSettings
from pipelines.spherical_metadata import mark_mp4

pytestmark = pytest.mark.usefixtures("unpainted")


def test_a_panorama_is_a_picture_that_viewers_know(box, tmp_path):
    run_command(
        "render", box / "run", "--cameras", box / "project", "--views", "first:1",
        "--lens", "equirectangular", "--width", 258, "--out", tmp_path, quiet=True,
    )  # fmt: skip
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
    words = ("render", box / "run", "--cameras", box / "project", "--views", "first:1",
             "--lens", "equirectangular", "--width", 128, "--out")  # fmt: skip
    run_command(*words, tmp_path / "known", quiet=True)
    run_command(*words, tmp_path / "whole", "--complete", quiet=True)
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
    run_command(
        "render", box / "run", "--cameras", box / "project", "--views", "first:1",
        "--lens", "fisheye", "--field-of-view", 60, "--width", 64, "--out", tmp_path,
    )  # fmt: skip
    rgb = np.asarray(Image.open(tmp_path / "view_0.rgb.png"))
    y, x = np.mgrid[:64, :64] - 31.5
    assert rgb.shape == (64, 64, 3)
    assert (rgb[np.hypot(x, y) > 32] == 0).all()
    assert (rgb[np.hypot(x, y) < 12] > 0).any(axis=-1).all()
    assert not (tmp_path / "view_0.jpg").exists()


def test_a_width_resizes_pictures_of_the_cameras_own_lens(box, tmp_path):
    words = ("render", box / "run", "--cameras", box / "project", "--views", "first:1", "--out")
    run_command(*words, tmp_path / "own", quiet=True)
    run_command(*words, tmp_path / "half", "--width", WIDTH // 2, quiet=True)
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
    from pipelines.rendering import write_film

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
    from gvtools.runs.poses import RunPoses

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
