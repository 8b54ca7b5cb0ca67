from __future__ import annotations

import ast
import doctest
import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import gvtools

ROOT = Path(gvtools.__file__).parent
# Modules whose docstrings hold examples.
DOCTESTED = sorted(
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")
    for package in ("gvtools", "pipelines", "viz")
    for path in (ROOT.parent / package).rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


def test_the_lazy_table_says_what_the_type_checker_sees() -> None:
    tree = ast.parse((ROOT / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.asname or alias.name: f"{node.module}:{alias.name}"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == gvtools._SOURCES
    assert sorted(gvtools.__all__) == sorted({*gvtools._SOURCES, "__version__"})


@pytest.mark.parametrize("name", sorted(gvtools._SOURCES))
def test_every_public_name_loads_and_is_documented(name: str) -> None:
    value = getattr(gvtools, name)
    assert inspect.getdoc(value)
    assert name in dir(gvtools)
    if inspect.isfunction(value):
        kinds = [each.kind for each in inspect.signature(value).parameters.values()]
        assert kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD) <= 3
    with pytest.raises(AttributeError, match="no attribute 'Camera'"):
        gvtools.Camera  # noqa: B018


def test_the_import_loads_nothing_heavy() -> None:
    script = "import sys, gvtools; dir(gvtools); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT.parent, capture_output=True, text=True, check=True
    )
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert "gvtools" in loaded
    assert not loaded & {"numpy", "torch", "open3d", "pydantic", "pipelines", "viz"}


def test_only_the_front_points_upwards_and_nothing_imports_it() -> None:
    """import-linter sees neither imports by name nor those for type checkers: this test does."""
    upward, users = set(), []
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            text = node.value if isinstance(node, ast.Constant) else None
            if isinstance(text, str) and re.match(r"(pipelines|viz)\.\w+[\w.]*(:|$)", text):
                upward.add((path.relative_to(ROOT).as_posix(), text.partition(":")[0]))
            if isinstance(node, ast.ImportFrom) and node.module == "gvtools":
                users += [str(path) for alias in node.names if alias.name in gvtools._SOURCES]
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                front = node.value.id == "gvtools" and node.attr in gvtools._SOURCES
                users += [str(path)] * front
    assert upward == {("__init__.py", "pipelines.api"), ("__main__.py", "pipelines.cli")}
    assert users == []


@pytest.mark.parametrize("module", DOCTESTED)
def test_the_examples_in_docstrings_run(module: str) -> None:
    options = doctest.NORMALIZE_WHITESPACE | doctest.IGNORE_EXCEPTION_DETAIL
    failed, tried = doctest.testmod(import_module(module), optionflags=options)
    assert tried > 0
    assert failed == 0
