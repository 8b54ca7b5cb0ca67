"""The structure of the code: imports without circles, short ways, sizes of rooms."""

from __future__ import annotations

from graphlib import TopologicalSorter
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
