from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from plain_gsplat import plain_gsplat
from posed_cuda import NAME, posed_cuda

from benchmarks import gpu

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_card_one_line_and_status_2():
    run = subprocess.run(
        [sys.executable, "-m", "benchmarks.gpu"], cwd=gpu.ROOT, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert run.returncode == 2 and run.stdout == ""
    assert "sees no CUDA device" in run.stderr and run.stderr.count("\n") == 1


def test_a_part_that_fails_is_a_row_and_the_others_go_on(capsys):
    def broken(sizes: gpu.Sizes) -> gpu.Figures:
        raise ValueError("no such\nkernel | here")

    parts = {"first": broken, "second": lambda sizes: {"a step": f"{sizes.repeat} ms"}}
    rows, good = gpu.measured(gpu.Sizes(repeat=3), parts)
    assert not good
    text = gpu.table({"card": "some card"}, rows)
    assert text.splitlines() == [
        "| part | what | figure |",
        "| --- | --- | --- |",
        "| conditions | card | some card |",
        r"| first | failed | ValueError: no such kernel \| here |",
        "| second | a step | 3 ms |",
    ]


@pytest.mark.slow
def test_every_part_runs_on_a_posed_device(monkeypatch, tmp_path, capsys):
    # The tests run in a process of their own, which sees no device.
    parts = {name: part for name, part in gpu.PARTS.items() if name != "tests"}
    monkeypatch.setattr(gpu, "measured", lambda sizes, of=gpu.measured: of(sizes, parts))
    with posed_cuda() as operations, plain_gsplat():
        status = gpu.main(["--small", "--out", str(tmp_path / "gpu.md")])
    text = (tmp_path / "gpu.md").read_text()
    assert text == capsys.readouterr().out
    assert status == 0, text
    assert sum(operations.values()) > 1000
    assert NAME in text and "| 8.0 |" in text
    for name in parts:
        assert f"| {name} |" in text
    assert "failed" not in text
