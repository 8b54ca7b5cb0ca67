"""``spec:NAME:SCENE``: a scene of a data set as a project is named, beside folders and files."""

from __future__ import annotations

from pathlib import Path

SPEC = "spec:"
FORM = f"{SPEC}NAME:SCENE"


def is_address(path: Path | str) -> bool:
    """Whether it names a scene of a data set rather than a file or folder.

    >>> is_address("spec:7-Scenes:chess/seq-01"), is_address("scans/kitchen")
    (True, False)
    """
    return str(path).startswith(SPEC)
