"""Compilation of kernels, and their execution in threads."""

from __future__ import annotations

import atexit
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numba
from numba import get_num_threads, njit, threading_layer


# error_model="numpy": division by zero gives infinity instead of raising; the check that raising
# needs keeps loops from being vectorised (measured: projection ten times slower with it).
# nogil=True: other Python threads (file I/O, kernels on other memories) run during a kernel.
def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Numba's ``njit`` with what all kernels share."""
    shared: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True}
    compile_function = njit(**(shared | options))

    def kernel(function: Callable[..., Any]) -> Any:
        dispatcher = compile_function(function)
        index = _index_of(dispatcher)
        if index is not None:
            index._load_index = partial(_fresh, index._load_index)
        return dispatcher

    return kernel


def _index_of(dispatcher: Any) -> Any:
    """Numba's index of what it has cached of a kernel; None where its compiler is switched off."""
    return getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)


def _fresh(load: Callable[[], dict[Any, Any]]) -> dict[Any, Any]:
    """A kernel's cache; empty where an earlier version took types that are gone or elsewhere.

    numba unpickles such types before it compares the times of the sources.
    """
    try:
        return load()
    except (AttributeError, ImportError):
        return {}


# What is compiled stays for this process and its children alone.
cached_here_alone = False


def _cache_somewhere() -> None:
    """Cache in a folder that goes at exit where neither the package nor the home can be written."""
    global cached_here_alone
    try:
        njit(cache=True)(_cache_somewhere)
    except RuntimeError:  # numba has no place for its cache
        folder = tempfile.mkdtemp(prefix="gvtools-kernels-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ["NUMBA_CACHE_DIR"] = folder
        # Where one has changed, numba reads all its variables again (see gvtools.memory).
        os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
        numba.config.CACHE_DIR = folder  # type: ignore[attr-defined]
        cached_here_alone = True


_cache_somewhere()

# LLVM's fast-math flags but "nnan" and "ninf": rounding may differ, NaN and infinity still hold.
FAST = {"nsz", "arcp", "contract", "reassoc"}


def in_threads(kernel: Callable[..., Any], count: int, *args: Any) -> list[Any]:
    """``kernel(first, last, *args)`` for parts of ``range(count)``, each in a thread of its own.

    For kernels that run for milliseconds: numba's ``parallel=True`` starts sooner, and doubles the
    time that a kernel takes to compile. What parts return comes in their order.
    """
    parts = max(1, min(get_num_threads(), count))
    ends = [count * part // parts for part in range(parts + 1)]
    if parts == 1:
        return [kernel(0, count, *args)]
    pool = _pool(os.getpid())
    jobs = [pool.submit(kernel, a, b, *args) for a, b in pairwise(ends)]
    return [job.result() for job in jobs]


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """The thread pool of this process.

    ``process`` is only the cache's key: after a fork the parent's pool has no live threads.
    """
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="kernel")


class KernelSet(NamedTuple):
    """Kernels that are compiled together."""

    name: str  # as users are told of it
    # a module's function without arguments that calls each kernel once on small arrays, since
    # numba compiles at the first call; pickled for another process
    compile: Callable[[], object]
    last: Any  # the last kernel that it calls; if this one is cached, so are the others

    @property
    def cached(self) -> bool:
        """Whether numba will find the last of them in its cache: compiled from this very source."""
        index = _index_of(self.last)
        return index is None or bool(index._load_index())


def compile_side_by_side(sets: Sequence[KernelSet]) -> None:
    """Compile sets of kernels in processes of their own, which leave the code in numba's cache.

    Numba compiles one kernel of a process at a time. A process that fails leaves its kernels to be
    compiled where they are called first.
    """
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    command = [sys.executable, "-c", "import pickle, sys; pickle.load(sys.stdin.buffer)()"]

    def compile_set(kernels: KernelSet) -> None:
        subprocess.run(
            command,
            input=pickle.dumps(kernels.compile),
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            check=False,
        )

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(compile_set, sets))


def parallel_kernels_may_overlap() -> bool:
    """Whether two Python threads may each run a ``parallel=True`` kernel at the same time.

    True for numba's OpenMP and TBB layers; its own "workqueue" layer is not thread-safe. False
    also before the first such kernel has run, when the layer is not chosen yet.
    """
    try:
        return str(threading_layer()) in ("omp", "tbb")
    except ValueError:  # no such kernel has run yet
        return False
