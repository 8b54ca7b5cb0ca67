"""Photographs of one room, for all captures of photographs."""

from __future__ import annotations

import pytest
from walls import write_project


@pytest.fixture(scope="session")
def room(wall_walk, tmp_path_factory):
    """The project of ten photographs with true cameras; not to be changed."""
    return write_project(tmp_path_factory.mktemp("capture") / "room", wall_walk).parent
