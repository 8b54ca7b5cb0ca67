"""The packages that gvtools installs, and packages of the same name that hide them.

Uses nothing but Python's own library, as it has to work where nothing else does.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

# Beside gvtools itself.
NAMES = ("pipelines", "viz", "data_specs")


def hidden() -> str | None:
    """One line of the first of gvtools's packages that somebody else's hides; None without any.

    >>> hidden()
    """
    home = Path(__file__).resolve().parent.parent
    for name in NAMES:
        spec = importlib.util.find_spec(name)
        places = [] if spec is None else [*(spec.submodule_search_locations or ()), spec.origin]
        found = [Path(place).resolve() for place in places if place]
        if home / name not in found[:1]:
            where = found[0] if found else "nowhere"
            return (
                f"package {name!r} is found at {where}; expected gvtools's own at {home / name}; "
                "take the other one off PYTHONPATH, start from another folder, or install gvtools "
                "into an environment of its own"
            )
    return None
