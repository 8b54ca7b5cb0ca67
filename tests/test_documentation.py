from __future__ import annotations

import re
import shlex
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from tiny_scan import write_scan

import gvtools

ROOT = Path(gvtools.__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    pytest.importorskip("mkdocs")
    from importlib.util import module_from_spec, spec_from_file_location

    spec = spec_from_file_location("documentation_hooks", ROOT / "docs" / "hooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def test_the_generated_pages_hold_every_command_and_public_name(hooks: ModuleType) -> None:
    from pipelines.cli import COMMANDS

    commands, python = hooks.commands_page(), hooks.python_page()
    assert [name for name in COMMANDS if f"\n## gvtools {name}\n" not in commands] == []
    assert [name for name in gvtools._SOURCES if f"\n## {name}\n" not in python] == []


def test_the_gallery_shows_what_its_commands_write(
    hooks: ModuleType, monkeypatch: pytest.MonkeyPatch
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


def test_every_setting_has_a_row_with_its_meaning(hooks: ModuleType) -> None:
    rows = [line.split(" | ") for line in hooks.settings_page().splitlines() if "| `" in line]
    names = [row[0].strip("| `") for row in rows]
    assert {"voxel", "seed", "memory.weight_cap"} <= set(names)
    assert [row[0] for row in rows if len(row[-1].strip(" |")) < 3] == []


def test_every_data_set_has_a_row_and_its_facts(hooks: ModuleType) -> None:
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
