"""The generative core in a process whose memory the system limits."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import geoverse_models as micro
import numpy as np
import pytest

from gvtools.completers import create
from gvtools.completers.base import run_completer
from gvtools.errors import OptionError

ROOT = Path(__file__).resolve().parents[2]
VIEWS, SIZE = 6, (480, 640)


def _completed(weights: str, spare: int | None) -> dict:
    """What becomes of ``VIEWS`` views while the process may take ``spare`` bytes more."""
    import resource

    completer = create("geoverse", weights=weights, alignment="hint", device="cpu")
    context, known = micro.context_views(2), micro.guidance(VIEWS, size=SIZE)
    # Libraries allocate what they work in once, and end the process where that fails.
    run_completer(completer, context, micro.guidance(1))
    complete, counts = completer.complete, []

    def counted(context, guidance, *, seed=0):
        counts.append(len(guidance))
        return complete(context, guidance, seed=seed)

    completer.complete = counted  # type: ignore[method-assign]
    if spare is not None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + spare
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    try:
        result = run_completer(completer, context, known)
    except OptionError as error:
        return {"counts": counts, "said": str(error)}
    finite = bool(np.isfinite(result.rgb).all() and np.isfinite(result.depth).all())
    return {"counts": counts, "views": len(result.rgb), "finite": finite}


def completed(weights: Path, spare: int | None) -> dict:
    """The same in a process of its own."""
    words = [sys.executable, __file__, str(weights), json.dumps(spare)]
    paths = os.pathsep.join((str(ROOT), str(ROOT / "tests" / "fixtures")))
    # Threads take address space of their own, which then would decide.
    one = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    one["MALLOC_ARENA_MAX"] = "1"
    done = subprocess.run(
        words, env={**os.environ, **one, "PYTHONPATH": paths}, cwd=ROOT,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space are Linux's")
def test_a_core_that_runs_out_of_memory_takes_fewer_views_then_says_one_line(tmp_path):
    weights = micro.weights_folder(
        tmp_path / "micro", micro.config(hints={"cameras": True, "fill": "push-pull", "mask": 0.0})
    )
    assert completed(weights, None)["counts"] == [VIEWS]
    kinds = set()
    for megabytes in (16, 192, 256, 384, 512, 768):
        found = completed(weights, megabytes << 20)
        if "said" in found:
            kinds.add("refused")
            assert "memory does not suffice for " in found["said"]
            assert "of 640x480 (" in found["said"]
            assert "\n" not in found["said"]
        else:
            kinds.add("whole" if found["counts"] == [VIEWS] else "parts")
            assert (found["views"], found["finite"]) == (VIEWS, True)
        if kinds >= {"refused", "parts"}:
            break
    assert kinds >= {"refused", "parts"}, kinds


if __name__ == "__main__":
    given = sys.argv[1], json.loads(sys.argv[2])
    print(json.dumps(_completed(*given)))
