"""The project that the examples work on: the one named on the command line, or a small room."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from tempfile import gettempdir

from gvtools.errors import ProjectError
from gvtools.procedural.room_sample import write_room


def sample_project() -> Path:
    """The first argument of the script, or a drawn room with exact depth; nothing is downloaded."""
    if len(sys.argv) > 1:
        return Path(sys.argv[1])
    folder = Path(gettempdir()) / "gvtools-examples" / "room"
    try:
        return write_room(folder, views=12, width=240, height=180).folder
    except ProjectError:  # the room of an earlier version
        shutil.rmtree(folder)
        return sample_project()


def output_folder() -> Path:
    """The second argument of the script, or a folder beside the sample."""
    folder = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(gettempdir()) / "gvtools-examples"
    folder.mkdir(parents=True, exist_ok=True)
    return folder
