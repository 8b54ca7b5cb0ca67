"""``python -m benchmarks.experiments NAME``: one experiment on scenes that no training saw."""

from __future__ import annotations

import sys

from pipelines.cli import main

if __name__ == "__main__":
    modules = {"experiment": "benchmarks.experiments.command"}
    sys.exit(main(["experiment", *sys.argv[1:]], modules=modules))
