"""What the parity tests refuse to pass over: fixtures, cases and outputs that nothing compares."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from oracle import network_fixtures, oracle_folder, unclaimed, without_cases
from oracle_networks import Fixture


def write(
    folder: Path, name: str, values: dict[str, np.ndarray] | None = None, **data: Any
) -> Path:
    """A fixture of an official implementation, every array stored whole."""
    values = values or {}
    tensors = {
        key: {"shape": list(value.shape), "stored": "full", "absmax": float(np.abs(value).max())}
        for key, value in values.items()
    }
    folder.mkdir(exist_ok=True)
    arrays: dict[str, Any] = dict(values)
    np.savez(folder / f"{name}.npz", **arrays)
    said = {"upstream": "someone/network@0", "tensors": tensors, **data}
    path = folder / f"{name}.json"
    path.write_text(json.dumps(said), encoding="utf-8")
    return path


def test_a_named_folder_has_to_hold_reference_values(tmp_path):
    with pytest.raises(FileNotFoundError, match="GVTOOLS_ORACLE"):
        oracle_folder({"GVTOOLS_ORACLE": str(tmp_path / "absent")})
    with pytest.raises(FileNotFoundError, match="no reference values"):
        oracle_folder({"GVTOOLS_ORACLE": str(tmp_path)})
    write(tmp_path, "da3_other", cases=[{}])
    assert oracle_folder({"GVTOOLS_ORACLE": str(tmp_path)}) == tmp_path


@pytest.mark.parametrize("environment", [{}, {"GVTOOLS_ORACLE": ""}])
def test_the_default_folder_may_be_absent(tmp_path, monkeypatch, environment):
    monkeypatch.setenv("GVTOOLS_SHARED", str(tmp_path / "absent"))
    assert oracle_folder(environment) == tmp_path / "absent" / "oracle"


def test_a_fixture_that_no_test_claims_is_named(tmp_path):
    write(tmp_path, "da3_large", cases=[{}])
    write(tmp_path, "vggt_tiny", cases=[{}])
    write(tmp_path, "image_metrics", expected={"pair": {"psnr": 20.0}})
    (tmp_path / "notes.json").write_text('{"upstream": "of no arrays"}')
    assert list(network_fixtures(tmp_path)) == ["da3_large", "vggt_tiny"]
    assert unclaimed(tmp_path, {"da3_", "gld_time"}) == ["vggt_tiny"]
    assert network_fixtures(tmp_path / "absent") == {}


def test_a_fixture_without_cases_is_named(tmp_path):
    write(tmp_path, "da3_empty", cases=[])
    write(tmp_path, "da3_none")
    write(tmp_path, "da3_one", cases=[{}])
    write(tmp_path, "gld_time_empty", cases=[])
    write(tmp_path, "gld_time_none")
    assert without_cases(tmp_path, {"da3_"}) == ["da3_empty", "da3_none", "gld_time_empty"]


def test_every_stored_output_of_a_case_has_to_be_compared(tmp_path):
    values = {f"case0.out.{name}": np.ones(3, np.float32) for name in ("depth", "ray", "score")}
    fixture = Fixture(write(tmp_path, "da3_other", values, cases=[{}, {}]))
    with pytest.raises(AssertionError, match=r"depth.*ray.*score"):
        fixture.check_complete(0)
    fixture.check(0, "depth", torch.ones(3))
    with pytest.raises(AssertionError, match=r"case0: nothing was compared with \['ray'\]"):
        fixture.check_complete(0, beside=("score",))
    fixture.check(0, "ray", torch.ones(3))
    fixture.check_complete(0, beside=("score",))
    with pytest.raises(AssertionError, match="case1: no output"):
        fixture.check_complete(1)


def test_outputs_of_cases_that_nothing_runs_are_named(tmp_path):
    values = {f"{case}.out.depth": np.ones(3, np.float32) for case in ("case0", "case7", "extra")}
    fixture = Fixture(write(tmp_path, "da3_other", values, cases=[{}]))
    with pytest.raises(AssertionError, match=r"\['case7', 'extra'\]"):
        fixture.check_prefixes(["case0"])
    fixture.check_prefixes(["case0", "case7", "extra"])
