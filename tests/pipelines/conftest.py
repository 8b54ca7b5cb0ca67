"""What the tests of commands share: figures that are not painted, and those of the small run."""

from __future__ import annotations

from pathlib import Path

import pytest
from figures import unpainted_figures

from pipelines.cli import main


@pytest.fixture(scope="module", autouse=True)
def _unpainted(unpainted: None) -> None:
    pass


@pytest.fixture(scope="session")
def small_evaluation(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("figures")
    with unpainted_figures():
        assert main(["evaluate", str(small_run), "--out", str(out), "--quiet"]) == 0
    return out
