"""The program ``gvtools``; ``python -m gvtools`` is the same."""

from __future__ import annotations

import sys
from importlib import import_module

from gvtools.packages import hidden


def main() -> int:
    """Run the command line; status 2 and one line where a package of gvtools is hidden."""
    problem = hidden()
    if problem is not None:
        print(f"gvtools: {problem}", file=sys.stderr)
        return 2
    status: int = import_module("pipelines.cli").main()
    return status


if __name__ == "__main__":
    sys.exit(main())
