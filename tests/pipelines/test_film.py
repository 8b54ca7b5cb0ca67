from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import refused
from PIL import Image, ImageSequence
from tiny_scan import write_scan

from pipelines.cli import main
from pipelines.rendering import FilmRenderer, film_cameras, write_film

pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two rounds over a tiny recording."""
    folder = tmp_path_factory.mktemp("film")
    scan = write_scan(folder / "scan")
    status = main(
        ["reconstruct", str(scan), "--context", "every:2", "--targets", "interpolate:4",
         "--set", "views_per_round=4", "--refine", "0", "--set", "refine.poses=false",
         "--out", str(folder / "run"), "--quiet"]
    )  # fmt: skip
    assert status == 0
    return folder / "run"


def frames_of(path: Path) -> list[np.ndarray]:
    if path.suffix == ".mp4":
        av = pytest.importorskip("av")
        with av.open(str(path)) as film:
            return [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    with Image.open(path) as film:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]


@pytest.mark.parametrize("suffix", ["mp4", "gif", "webp"])
def test_a_path_becomes_a_film_of_the_memorys_pictures(run, tmp_path, suffix):
    out = tmp_path / f"film.{suffix}"
    assert main(["film", str(run), "--path", "interpolate:5", "--out", str(out)]) == 0
    frames = frames_of(out)
    renderer = FilmRenderer(run, film_cameras(_memory(run), "interpolate:5"))
    assert len(frames) == 5
    for index in (0, 4):
        drawn = renderer.frame(index, ("memory",))
        assert frames[index].shape == drawn.shape == (72, 96, 3)
        # What coding costs: a film of another place differs by 30 and more.
        assert np.abs(frames[index].astype(int) - drawn).mean() < 6
    assert np.abs(frames[0].astype(int) - renderer.frame(4, ("memory",))).mean() > 12
    assert not list(tmp_path.glob(".*"))


def test_panels_stand_side_by_side_and_completed_has_no_holes(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "film.gif"
    # To the left of all captured views: the left of these frames was seen by none.
    path = tmp_path / "path.txt"
    path.write_text("0 -1.5 0 0 0 0 0 1\n1 -1.2 0 0 0 0 0 1\n")
    arguments = ["--path", str(path), "--compare", "observed,completed", "--out", str(out)]
    assert main(["film", str(run), *arguments, "--width", "64"]) == 0
    assert frames_of(out)[0].shape == (48, 128, 3)
    cameras = film_cameras(_memory(run), str(path), width=64)
    renderer = FilmRenderer(run, cameras, up_to=0)
    observed, completed = (renderer.frame(1, (panel,)) for panel in ("observed", "completed"))
    holes = (observed == 255).all(-1)
    assert holes.any()
    assert not (completed == 255).all(-1).any()
    assert np.abs(observed[~holes].astype(int) - completed[~holes]).max() <= 1


def test_depth_is_red_where_it_is_near(run: Path) -> None:
    cameras = film_cameras(_memory(run), "cameras")
    frame = FilmRenderer(run, cameras).frame(len(cameras) // 2, ("depth",))
    middle, wall = frame[36, 48].astype(int), frame[5, 5].astype(int)
    assert middle[0] > middle[2]  # the square, in front
    assert wall[2] > wall[0]  # the wall behind it


def test_growth_draws_the_path_once_for_each_round(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "growth.webp"
    assert main(["film", str(run), "--path", "interpolate:2", "--growth", "--out", str(out)]) == 0
    assert len(frames_of(out)) == 2 * len(_memory(run).rounds) > 2


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
    run, tmp_path, capsys, monkeypatch, arguments, said
):
    monkeypatch.chdir(tmp_path)
    assert said in refused(capsys, "film", run, *arguments)
    assert not list(tmp_path.iterdir())


def _memory(run: Path):
    from gvtools.runs.run import load_memory

    return load_memory(run)


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
