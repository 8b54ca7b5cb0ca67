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
DOCTESTED = (
    "gvtools",
    "gvtools.appearance.appearance",
    "gvtools.appearance.camera_corrections",
    "gvtools.appearance.fit_options",
    "gvtools.appearance.gaussians",
    "gvtools.appearance.splat.splat",
    "gvtools.splats",
    "gvtools.cameras",
    "gvtools.capture.mapping",
    "gvtools.completers.base",
    "gvtools.errors",
    "gvtools.evaluation.splits",
    "gvtools.evaluation.picture_sets",
    "gvtools.evaluation.trajectories",
    "gvtools.memory.store.store",
    "gvtools.memory.spatial_memory",
    "gvtools.notebook",
    "gvtools.optional",
    "gvtools.scans.fuse",
    "gvtools.scans.registration",
    "pipelines.blocks.split",
    "gvtools.scenes.calibration",
    "gvtools.scenes.data_sets.catalogue",
    "gvtools.scenes.data_sets.mvs",
    "gvtools.scenes.data_sets.synthetic",
    "gvtools.scenes.faces",
    "gvtools.scenes.inspection",
    "gvtools.scenes.layout",
    "gvtools.scenes.matching",
    "gvtools.settings.base",
    "gvtools.system_libraries",
    "gvtools.scenes.shards",
    "gvtools.training.data",
    "pipelines.tuning.options",
    "gvtools.trajectory_files",
    "gvtools.untrusted",
    "pipelines.blocks.merge",
    "pipelines.options",
    "pipelines.data_sets.downloads",
)


def _type_checking_imports() -> dict[str, str]:
    """The public names as the type checker sees them: name -> "module:attribute"."""
    tree = ast.parse((ROOT / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.asname or alias.name: f"{node.module}:{alias.name}"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def test_the_lazy_table_says_what_the_type_checker_sees() -> None:
    assert _type_checking_imports() == gvtools._SOURCES
    assert sorted(gvtools.__all__) == sorted({*gvtools._SOURCES, "__version__"})


@pytest.mark.parametrize("name", sorted(gvtools._SOURCES))
def test_every_public_name_loads_and_is_documented(name: str) -> None:
    value = getattr(gvtools, name)
    assert inspect.getdoc(value)
    assert name in dir(gvtools)
    if inspect.isfunction(value):
        positional = [
            parameter
            for parameter in inspect.signature(value).parameters.values()
            if parameter.kind is parameter.POSITIONAL_OR_KEYWORD
        ]
        assert len(positional) <= 3


def test_an_unknown_name_is_an_attribute_error() -> None:
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
