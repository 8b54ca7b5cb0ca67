"""One thread for all tests of the generative core; weights folders, and copies to be damaged."""

from __future__ import annotations

import shutil
from pathlib import Path

import geoverse_models as micro
import pytest
from geoverse_folders import PLAIN, write_source


@pytest.fixture(scope="module", autouse=True)
def _one_thread(one_thread: None) -> None:
    pass


@pytest.fixture(scope="session")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of published files."""
    return write_source(tmp_path_factory.mktemp("published"))


@pytest.fixture(scope="session")
def own_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of one's own."""
    return micro.weights_folder(tmp_path_factory.mktemp("own"), PLAIN)


@pytest.fixture
def folder(source: Path, tmp_path: Path) -> Path:
    """Published files to be damaged."""
    return Path(shutil.copytree(source, tmp_path / "published"))


@pytest.fixture
def own(own_source: Path, tmp_path: Path) -> Path:
    """A folder of one's own to be damaged."""
    return Path(shutil.copytree(own_source, tmp_path / "own"))
