from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tiny_scan import write_scan

import gvtools
from gvtools.notebook import WIDTH, path_sketch
from gvtools.procedural.room_sample import write_room

ROOT = Path(gvtools.__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def hooks() -> SimpleNamespace:
    pytest.importorskip("mkdocs")
    return SimpleNamespace(**runpy.run_path(str(ROOT / "docs/hooks.py")))


def test_the_readme_is_short_and_its_links_lead_somewhere() -> None:
    assert len(README.split()) < 700
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", README) if "://" not in link]
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []
    assert (ROOT / "docs/images/growth.png").stat().st_size <= 1_000_000


def test_the_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)[0]
    write_scan(tmp_path / "my" / "scan")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    assert names["completion"].depth.shape == names["guidance"].depth.shape  # type: ignore[attr-defined]
    assert len(names["cloud"].point.positions) == len(names["memory"]) > 0  # type: ignore[attr-defined, arg-type]


def test_the_completer_of_the_page_on_completers_works(monkeypatch: pytest.MonkeyPatch) -> None:
    from gvtools.completers import base

    monkeypatch.setattr(base, "_REGISTRY", dict(base._REGISTRY))
    page = (ROOT / "docs/concepts/completers.md").read_text(encoding="utf-8")
    exec(re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)[0], {})
    known = np.zeros((1, 4, 6), bool)
    zeros = known.astype(np.float32)
    camera = gvtools.Cameras.pinhole(6, 4, focal=5.0)
    guidance = gvtools.Guidance(
        camera, np.zeros((1, 4, 6, 3), np.float32), zeros, known, zeros, known
    )
    completion = base.create("grey", level="0.25").complete([], guidance)
    assert np.all(completion.rgb == 0.25)


def test_the_generated_pages_hold_every_command_name_and_setting(hooks: SimpleNamespace) -> None:
    from pipelines.cli import COMMANDS

    commands, python = hooks.commands_page(), hooks.python_page()
    assert [name for name in COMMANDS if f"\n## gvtools {name}\n" not in commands] == []
    assert [name for name in gvtools._SOURCES if f"\n## {name}\n" not in python] == []
    rows = [line.split(" | ") for line in hooks.settings_page().splitlines() if "| `" in line]
    assert {"voxel", "seed", "memory.weight_cap"} <= {row[0].strip("| `") for row in rows}
    assert [row[0] for row in rows if len(row[-1].strip(" |")) < 3] == []


def test_the_gallery_shows_what_its_commands_write(
    hooks: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ROOT / "docs")
    from gallery import EXHIBITS, SAMPLES, gallery_page

    from pipelines.cli import build_parser

    page = gallery_page()
    for command in (*SAMPLES, *(exhibit.command for exhibit in EXHIBITS)):
        assert f"\n{command}\n" in page
        told = vars(build_parser().parse_args(shlex.split(command)[1:]))
        outputs = {str(told.get(name)) for name in ("out", "screenshot")}
        file = next((e.file for e in EXHIBITS if e.command == command), None)
        assert file is None or file.split("/")[0] in outputs
    assert all(f"gallery/{exhibit.shown}" in page for exhibit in EXHIBITS)


def test_every_data_set_has_a_row_and_its_facts(hooks: SimpleNamespace) -> None:
    from gvtools.scenes.data_sets.catalogue import load_spec, spec_names

    page = hooks.data_sets_page()
    for spec in map(load_spec, spec_names()):
        assert page.count(f"\n| {spec.name} | {spec.kind} |") == 1
        _, _, facts = page.partition(f"\n### {spec.name}\n")
        assert f"\nlayout: {spec.layout}\n" in facts.partition("\n### ")[0]
    # The keys that the page explains are those of a spec.
    explained = re.findall(r"^- (.*?)(?=^- |^$)", page, flags=re.DOTALL | re.MULTILINE)
    names = set(re.findall(r"`(\w+)`", " ".join(explained)))
    assert set(type(spec).model_fields) <= names


FOLDER = ROOT / "examples"
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
