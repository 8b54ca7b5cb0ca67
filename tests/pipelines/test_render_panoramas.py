"""gvtools render and film with another lens: files, and what players and viewers read in them."""

from __future__ import annotations

import numpy as np
import pytest
from box_project import SIZE, fused, write_box
from command_line import refused, run_command
from PIL import Image

from gvtools.capture.panoramas import lens_of
from gvtools.capture.photographs import CapturedPhotograph
from pipelines.spherical_metadata import mark_mp4

pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    root = tmp_path_factory.mktemp("box")
    scene = write_box(root / "project")
    (root / "run").mkdir()
    fused(scene, [0, 2, 4]).save(root / "run" / "memory.npz")
    return root


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
