from __future__ import annotations

import importlib
import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from gvtools.kernels import KernelSet, compile_side_by_side, in_threads

MODULE = """
from gvtools.kernels import compiled

@compiled()
def {name}(x):
    return 2 * x

def compile_it():
    {name}(3)
"""


@pytest.mark.parametrize("count", [0, 1, 7, 1000])
def test_threads_share_the_work(count):
    seen = np.zeros(count, np.int64)

    def part(first: int, last: int, step: int) -> int:
        seen[first:last] += step
        return last - first

    sizes = in_threads(part, count, 2)
    assert (seen == 2).all() and sum(sizes) == count
    assert len(sizes) <= max(1, min(count, numba.get_num_threads()))


def test_what_fails_in_a_thread_fails_in_the_caller():
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda first, last: 1 // 0, 8)


def test_other_processes_leave_kernels_in_the_cache(tmp_path, monkeypatch, capfd):
    monkeypatch.syspath_prepend(tmp_path)
    sets = []
    for name in ("double_once", "double_twice"):
        (tmp_path / f"module_{name}.py").write_text(MODULE.format(name=name), encoding="utf-8")
        module = importlib.import_module(f"module_{name}")
        sets.append(KernelSet(name, module.compile_it, getattr(module, name)))
    # One that fails stops no other, and is compiled where it is called.
    broken = KernelSet("broken", os.wait, sets[0].last)
    assert not any(kernels.cached for kernels in sets)
    compile_side_by_side([broken, *sets])
    assert all(kernels.cached for kernels in sets)
    assert capfd.readouterr() == ("", "")
    # A file that is newer, and the same, is not compiled again; one that changed is.
    os.utime(tmp_path / "module_double_once.py", (2**31, 2**31))
    (tmp_path / "module_double_twice.py").write_text(
        MODULE.format(name="double_twice") + "# changed\n", encoding="utf-8"
    )
    module = importlib.reload(importlib.import_module("module_double_twice"))
    changed = KernelSet("changed", module.compile_it, module.double_twice)
    assert sets[0].cached and not changed.cached
    for kernels in sets:
        assert kernels.last(3) == 6
        assert kernels.last.stats.cache_hits.total() == 1


def test_where_nothing_can_be_written_the_cache_is_a_folder_that_goes(tmp_path):
    code = (
        "from gvtools import kernels; import os; from pathlib import Path;"
        "from gvtools.memory.store import voxel_index;"
        "assert kernels.cached_here_alone and Path(os.environ['NUMBA_CACHE_DIR']).is_dir();"
        # An older TBB is warned of where it comes first.
        "import numba; numba.config.reload_config();"
        "assert numba.config.THREADING_LAYER_PRIORITY[0] == 'omp'"
    )
    # As numba finds no place beside the sources and none in the home.
    alone = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **alone}, check=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_cache_of_types_that_moved_is_compiled_again(tmp_path, monkeypatch):
    source = """
from typing import NamedTuple
from gvtools.kernels import compiled

class {name}(NamedTuple):
    x: float

Pair = {name}

@compiled()
def double(pair):
    return 2 * pair.x
"""
    call = "import moved; print(moved.double(moved.Pair(1.5)))"
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    for name in ("Before", "Beyond"):
        (tmp_path / "moved.py").write_text(source.format(name=name))
        run = subprocess.run(
            [sys.executable, "-c", call], capture_output=True, text=True, check=False
        )
        assert run.stdout == "3.0\n", run.stderr
