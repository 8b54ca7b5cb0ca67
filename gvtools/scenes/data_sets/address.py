"""``spec:NAME:SCENE``: a scene of a data set as a project is named, beside folders and files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gvtools.errors import OptionError

if TYPE_CHECKING:
    from gvtools.scenes.scene import Scene

SPEC = "spec:"
FORM = f"{SPEC}NAME:SCENE"


def is_address(path: Path | str) -> bool:
    """Whether it names a scene of a data set rather than a file or folder.

    >>> is_address("spec:7-Scenes:chess/seq-01"), is_address("scans/kitchen")
    (True, False)
    """
    return str(path).startswith(SPEC)


def open_address(address: Path | str, root: Path | None) -> Scene:
    """The scene of a data set that an address names.

    Args:
        address: see FORM; the scene may be left out where the folder holds one alone.
        root: the folder of the data set's download.

    Raises:
        OptionError: no such data set, or no root.
        ProjectError: no such scene in the folder, or nothing of it can be read.
    """
    from gvtools.scenes.data_sets.layouts import open_data_set
    from gvtools.scenes.data_sets.spec import load_spec

    name, _, scene = str(address).removeprefix(SPEC).partition(":")
    if not name:
        raise OptionError(f"{address}: names no data set; expected {FORM}")
    spec = load_spec(name)
    if root is None:
        raise OptionError(
            f"{address}: where {spec.name} lies is not said; give the folder of its download by "
            "--root DIR (root= in Python)"
        )
    return open_data_set(name, scene, Path(root))
