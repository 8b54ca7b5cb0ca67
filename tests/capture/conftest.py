"""Photographs of one room, for all captures of photographs."""

from __future__ import annotations

import pytest

from gvtools.procedural.room_sample import write_room


@pytest.fixture(scope="session")
def room(tmp_path_factory):
    """The project of ten photographs with true cameras; not to be changed."""
    return write_room(
        tmp_path_factory.mktemp("capture") / "room", views=10, width=360, height=270
    ).folder
