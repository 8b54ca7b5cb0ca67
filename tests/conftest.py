"""What all tests share: options, what is skipped and why, and the real scenes."""

from __future__ import annotations

import gc
import os
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from figures import unpainted_figures
from hypothesis import settings
from shared_data import shared_folder

if TYPE_CHECKING:
    from gvtools.evaluation.posed_picture import PosedPicture

# As the command line has it: threads that spin while they wait are slow where others work, too.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# How long an example takes is the machine's matter.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")

# Begun first, so that workers compile kernels of different rooms and no long file is left for last.
FIRST = (
    "test_splat.py",
    "test_room_sample.py",
    "test_inpaint.py",
    "test_stereo_depth.py",
    "test_training_run.py",
    "test_bench_complete.py",
    "test_experiments.py",
    "test_geoverse_weights.py",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--runslow", action="store_true", help="run the tests marked slow as well")
    parser.addoption(
        "--posed-cuda",
        action="store_true",
        help="run the tests marked gpu on CPU tensors that pose as CUDA's (posed_cuda.py)",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile kernels before workers begin: each would compile what others are at, too."""
    if not getattr(session.config.option, "numprocesses", None) or hasattr(
        session.config, "workerinput"
    ):
        return
    from gvtools import kernels
    from gvtools.appearance.compile_kernels import kernel_sets
    from gvtools.completers.inpaint import InpaintCompleter
    from gvtools.depth import source
    from gvtools.memory import spatial_memory as memory
    from gvtools.procedural import room_sample

    sets = [*kernel_sets(), memory.KERNELS, room_sample.KERNELS, *InpaintCompleter.kernels]
    kernels.compile_side_by_side([each for each in (*sets, source.KERNELS) if not each.cached])


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--runslow"):
        slow = pytest.mark.skip(reason="slow; run with --runslow")
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(slow)
    items.sort(
        key=lambda item: FIRST.index(item.path.name) if item.path.name in FIRST else len(FIRST)
    )
    gpu_items = [item for item in items if "gpu" in item.keywords]
    if gpu_items and not _cuda() and not config.getoption("--posed-cuda"):
        gpu = pytest.mark.skip(reason="needs a CUDA device; torch sees none")
        for item in gpu_items:
            item.add_marker(gpu)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Garbage is sought in what tests make, not in the million objects that imports have made.

    To look through those costs seconds while files are collected, and then the better part of a
    second every few dozen tests; what tests import themselves is why it is done less often, too.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(10_000, 10, 10)
        gc.enable()


def _cuda() -> bool:
    import torch

    return torch.cuda.is_available()


@pytest.fixture(autouse=True)
def _posed_where_asked_for(request: pytest.FixtureRequest) -> Iterator[None]:
    if not (request.config.getoption("--posed-cuda") and "gpu" in request.keywords):
        yield
        return
    from posed_cuda import posed_cuda

    with posed_cuda():
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disk() -> Iterator[None]:
    """What is written is read again at once; that a disk holds it, too, no test looks at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real scenes and oracles; the test is skipped where it is absent."""
    folder = shared_folder()
    if not folder.is_dir():
        pytest.skip(f"no {folder}; set GVTOOLS_SHARED to the folder of shared scenes")
    return folder


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two rounds with two targets each, its project ``scan`` beside it; not to be changed.

    Context: views 0 to 2; targets: 4 to 7.
    """
    from tiny_scan import write_scan

    from pipelines.cli import main

    root = tmp_path_factory.mktemp("small")
    scan, run = write_scan(root / "scan", views=8), root / "run"
    options = ("--context", "first:3", "--targets", "range:4-7", "--views-per-round", "2")
    words = ["reconstruct", str(scan), "--refine", "0", "--out", str(run), *options, "--quiet"]
    with unpainted_figures():
        assert main(words) == 0
    return run


@pytest.fixture(scope="session")
def small_scan(small_run: Path) -> Path:
    """The project of ``small_run``."""
    return small_run.parent / "scan"


@pytest.fixture(scope="session")
def wall_walk() -> list[PosedPicture]:
    """Ten pictures of 160x120 of three textured walls, with exact depth."""
    from walls import walk

    return walk()


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Threads cost more than they give on a tiny network, most of all where others work, too."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def unpainted() -> Iterator[None]:
    """Figures of runs are neither drawn nor painted; reports are made of one pixel for each."""
    with unpainted_figures():
        yield
