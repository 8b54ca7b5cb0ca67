from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import gvtools
from gvtools.notebook import WIDTH, path_sketch
from gvtools.procedural.room_sample import write_room

FOLDER = Path(gvtools.__file__).parent.parent / "examples"
SCRIPTS = sorted(FOLDER.glob("0*.py"))
# Of each script: a file that it leaves, and a figure that it prints with its bounds. Holes that
# stay black give 10 to 15 dB, a projection through a wrong camera about as much.
PROMISES = {
    "01_colmap_project": ("colmap/memory.ply", r"PSNR (\S+) dB", 20, 45),
    "02_scan": ("memory.npz", r"context_01.png: .* (\S+) dB", 22, 45),
    "03_own_completer": ("completer_nearest/run.json", r"nearest: PSNR (\S+) dB", 20, 45),
    "04_open3d": ("cloud.ply", r"largest plane .*: (\d+)%", 8, 80),
    "05_trajectory_errors": ("", r"ATE: .* scale (\S+)", 2.45, 2.55),
    "06_figure": ("figure/target.png", r"written: .*, .*target.png()", None, None),
    "07_core_alone": ("core.png", r"depth afterwards (\S+)%", 90, 100),
    "08_memory_notebook": ("notebook.npz", r"completed: (\S+)%", 90, 100),
}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room") / "room"
    return write_room(folder, views=12, width=160, height=120).folder


def test_there_are_eight_short_scripts() -> None:
    assert [path.stem for path in SCRIPTS] == list(PROMISES)
    for path in SCRIPTS:
        assert len(path.read_text(encoding="utf-8").splitlines()) < 50, path.name


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_an_example_runs(script, room, tmp_path, monkeypatch, capsys):
    arguments = [] if script.stem.startswith("05") else [str(room), str(tmp_path)]
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setattr(sys, "argv", [str(script), *arguments])
    monkeypatch.syspath_prepend(str(FOLDER))
    runpy.run_path(str(script), run_name="__main__")
    file, pattern, least, most = PROMISES[script.stem]
    assert (tmp_path / file).stat().st_size > 0
    found = re.search(pattern, capsys.readouterr().out)
    assert found
    assert least is None or most is None or least <= float(found[1]) <= most


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "promises"),
    [
        ("colmap_project", (r"known \d\d", "<b>Run</b>", "<b>SpatialMemory</b>", "image/png")),
        ("trajectory_errors", (r"ATE 0\.0\d+", r"scale 2\.0", "<b>Trajectory</b>", "<svg")),
    ],
)
def test_a_notebook_runs(name, promises, tmp_path, monkeypatch):
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient")
    monkeypatch.setenv("OUT", str(tmp_path))
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    for _ in range(2):  # As people run all of its cells again.
        client.NotebookClient(notebook, timeout=300).execute()
    text = str([cell.get("outputs") for cell in notebook.cells])
    for promise in promises:
        assert re.search(promise, text), text[:2000]


def test_objects_are_tables_in_a_notebook(small_run: Path) -> None:
    run = gvtools.load_run(small_run)
    page = run._repr_html_()
    assert "<b>Run</b>" in page and "data:image/png;base64," in page
    assert f"{len(run.memory):,}" in page and f"{len(run.memory):,}" in run.memory._repr_html_()


def test_a_path_is_sketched_in_the_plane_that_it_spreads_in() -> None:
    """A circle in a plane that is upright: as high as it is wide."""
    turn = np.linspace(0, 2 * np.pi, 100)
    circle = np.stack([np.cos(turn), 5 + 0 * turn, np.sin(turn)], axis=1)
    sketch = path_sketch(circle)
    # Where a tracker was lost it has no place; a scene may be in any unit.
    assert path_sketch(np.vstack([1e-15 * circle, [[np.nan] * 3]])) == path_sketch(1e-15 * circle)
    assert path_sketch(2.0**-50 * circle) == sketch
    places = np.array(re.findall(r"([\d.]+),([\d.]+)", sketch), float)
    assert np.ptp(places, axis=0) == pytest.approx(WIDTH - 8, abs=3)
    assert path_sketch(places[:1]) == ""
