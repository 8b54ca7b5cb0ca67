"""A project of six views with a memory, shared by tests of rendering."""

from __future__ import annotations

import pytest
from box_project import fused, write_box


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A project of six views and a run whose memory holds three of them."""
    root = tmp_path_factory.mktemp("box")
    scene = write_box(root / "project")
    (root / "run").mkdir()
    fused(scene, [0, 2, 4]).save(root / "run" / "memory.npz")
    return root
