from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from device_paths import ELSEWHERE, PATHS
from posed_cuda import posed_cuda

pytest.importorskip("diffusers", reason="the extra wan is not installed")
pytestmark = pytest.mark.usefixtures("one_thread", "unpainted")

ROOT = Path(__file__).parents[2]


# These take up to 22 seconds each, are part of a longer path or repeat others in bfloat16: too long
# for every run.
SLOW = {"depth plane-sweep, torch", "reconstruct", "bench complete", "generate"}
SLOW |= {name for name in PATHS if name[:5] == "train" or "bfloat16" in name}
NAMES = [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in PATHS]


@pytest.mark.parametrize("name", NAMES)
def test_a_path_gives_on_cuda_what_it_gives_on_the_cpu(name, tmp_path):
    path = PATHS[name]
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cuda").mkdir()
    wanted = path.run("cpu", tmp_path / "cpu")
    with posed_cuda() as operations:
        found = path.run("cuda", tmp_path / "cuda")
    count = sum(operations.values())
    half = sum(number for kind, number in operations.items() if kind.endswith("bfloat16"))
    print(f"{name}: {count} operations on the device, {half} of bfloat16 numbers")
    assert count > 20
    assert bool(half) == path.half
    assert found.keys() == wanted.keys()
    for key, array in wanted.items():
        assert np.isfinite(array).all(), key
        apart = np.abs(found[key] - array) > path.relative * np.abs(array).max()
        assert apart.mean() <= path.share, f"{key}: {np.abs(found[key] - array).max():g}"


def test_every_file_that_names_cuda_is_part_of_a_path():
    named = {
        str(file.relative_to(ROOT))
        for folder in ("gvtools", "pipelines")
        for file in (ROOT / folder).rglob("*.py")
        if re.search(r"[\"'.]cuda\b", file.read_text(encoding="utf-8"))
    }
    covered = {module for path in PATHS.values() for module in path.modules}
    assert named - covered - ELSEWHERE.keys() == set()
    assert {
        module for module in covered | ELSEWHERE.keys() if not (ROOT / module).is_file()
    } == set()
