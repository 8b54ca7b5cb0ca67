"""A scan and a plain run of it, which the tests of faults share and leave as they are."""

from __future__ import annotations

from pathlib import Path

import pytest
from figures import unpainted_figures
from kill_commands import PLAIN
from tiny_scan import write_scan

from pipelines.cli import main


@pytest.fixture(scope="module", autouse=True)
def _unpainted(unpainted: None) -> None:
    pass


@pytest.fixture(scope="session")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames with depth and poses."""
    return write_scan(tmp_path_factory.mktemp("faults") / "scan", views=6)


@pytest.fixture(scope="session")
def run(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rounds of one view, without a fit."""
    out = tmp_path_factory.mktemp("runs") / "run"
    with unpainted_figures():
        assert main(["reconstruct", str(scan), "--out", str(out), *PLAIN, "--quiet"]) == 0
    return out
