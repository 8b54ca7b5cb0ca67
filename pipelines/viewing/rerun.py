"""Recordings for rerun, handed over to its own viewer."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from gvtools.errors import OptionError, ProjectError
from viz.open3d.window import has_display

SUFFIX = ".rrd"


def open_recording(path: Path, *, host: str, port: int) -> None:
    """Show a recording in rerun's window, or without a display on its web page, until it ends.

    Args:
        path: the recording.
        host: address to serve at.
        port: of the web page.
    """
    if not path.is_file():
        raise ProjectError(f"{path}: no such file; expected a recording for rerun")
    # That of this Python before any other, which may be of another version.
    places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    program = shutil.which("rerun", path=places)
    if program is None:
        raise OptionError(
            f"{path}: a recording for rerun, which is not installed here; run 'pip install "
            '"gvtools[export]"\', or open the file at https://rerun.io/viewer'
        )
    command = [program, str(path.resolve()), "--bind", host]
    if not has_display():
        command += ["--web-viewer", "--web-viewer-port", str(port)]
    status = subprocess.run(command, check=False).returncode
    if status:
        raise OptionError(f"{path}: rerun ended with status {status}; it says more above")
