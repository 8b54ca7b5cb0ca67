"""The box and its saved runs, which the tests of exports share and leave as they are."""

from __future__ import annotations

import pytest
from box_project import write_box
from export_runs import SavedRun, saved_run
from figures import unpainted_figures

import gvtools
from gvtools.runs.run import Run
from gvtools.scenes.scene import Scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A box that six cameras see."""
    return write_box(tmp_path_factory.mktemp("box"))


@pytest.fixture(scope="session")
def fitted_run(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> SavedRun:
    """A run of it with Gaussians."""
    return saved_run(scene, tmp_path_factory.mktemp("fitted") / "run", fitted=True)


@pytest.fixture(scope="session")
def bare_run(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> SavedRun:
    """And one without."""
    return saved_run(scene, tmp_path_factory.mktemp("bare") / "run", fitted=False)


@pytest.fixture(scope="session")
def reconstructed_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of two rounds after the context's, with its project."""
    folder = tmp_path_factory.mktemp("reconstructed")
    write_box(folder)
    settings = {"rounds": 2, "views_per_round": 1, "voxel": 0.03, "refine.seconds": 0}
    settings["refine.poses"] = False
    with unpainted_figures():
        return gvtools.reconstruct(
            folder, folder / "run", context="every:3", targets="every:3+1", settings=settings
        )
