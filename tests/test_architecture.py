from __future__ import annotations

import ast
import re
from graphlib import TopologicalSorter
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("gvtools", "pipelines", "viz")


def test_no_modules_import_each_other_in_a_circle():
    """import-linter holds this between packages; here it is of all modules."""
    grimp = pytest.importorskip("grimp", reason="import-linter asks for Python 3.11")
    graph = grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True)
    imports = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    assert sum(map(len, imports.values())) > 1000
    TopologicalSorter(imports).prepare()


def test_modules_open_with_the_name_of_the_thing():
    riddles = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            if re.match(r"(What|Which|Where|How|Whether)\b", text):
                riddles.append(str(path.relative_to(ROOT)))
    assert riddles == []


def test_the_table_of_rooms_says_what_their_packages_say():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    table = dict(re.findall(r"^\| `([\w/]+)/` \| (.+) \|$", text, re.MULTILINE))
    for folder in (ROOT, ROOT / "gvtools"):
        for package in sorted(folder.glob("*/__init__.py")):
            name = package.parent.relative_to(ROOT).as_posix()
            if name in ("gvtools", "data_specs"):
                continue
            doc = ast.get_docstring(ast.parse(package.read_text(encoding="utf-8"))) or ""
            assert " ".join(doc.split()).startswith(table[name]), name


# The device chooses the class of splatters.
CALLED_AS = {"Splat": "splatter"}
WAYS = re.split(r"\n## ", (ROOT / "docs/architecture.md").read_text(encoding="utf-8"))
STEPS = [
    re.findall(r"^\d\. `([\w/.]+)` `([\w.]+)`$", part, re.MULTILINE)
    for way in WAYS if way.startswith("Three ways")
    for part in re.split(r":\n\n(?=1\. )", way)[1:]
]  # fmt: skip


@pytest.mark.parametrize("steps", STEPS, ids=[steps[-1][1] for steps in STEPS])
def test_each_function_of_the_short_ways_calls_the_next(steps):
    assert len(STEPS) == 3 and 5 <= len(steps) <= 8
    for (file, name), (_, called) in pairwise(steps):
        calls = {
            getattr(node.func, "id", getattr(node.func, "attr", None))
            for node in ast.walk(_definition(file, name))
            if isinstance(node, ast.Call)
        }
        assert {called.split(".")[-1], CALLED_AS.get(called)} & calls
    _definition(*steps[-1])


def _definition(file: str, name: str) -> ast.AST:
    node: ast.AST = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    for part in name.split("."):
        (node,) = (
            each for each in ast.iter_child_nodes(node) if getattr(each, "name", None) == part
        )
    return node
