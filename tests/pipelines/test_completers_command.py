"""``gvtools completers``: every figure stands in the page of benchmarks/ that it names."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from gvtools.completers import base
from gvtools.completers.base import Completer, available, completer_type
from pipelines.cli import main

ROOT = Path(__file__).parents[2]
FACTS = [(name, facts) for name in available() for facts in completer_type(name).facts]
# Rows of the table "Four domains", by the completer that they are of; seconds of the core alone.
ROWS = {"inpaint": ("inpaint", "inpaint"), "geoverse": ("geoverse", "without its refiner")}


@pytest.mark.parametrize(("name", "facts"), FACTS, ids=[f"{n} {f.of}" for n, f in FACTS])
def test_figures_are_those_of_their_page(name, facts):
    if not facts.source:
        assert not re.search(r"\d", facts.cost + facts.gives)
        return
    file, section = facts.source.partition(" (")[0].split(", ")
    text = (ROOT / file).read_text(encoding="utf-8").split(f"## {section}\n")[1].split("\n## ")[0]
    if section != "Four domains":
        assert "1,034" in facts.cost and "**1,034**" in text and "Peak memory 20.4 GiB" in text
        return
    lines = [line for line in text.split("\nDifferences")[0].splitlines() if line[:2] == "| "]
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    judged, timed = ROWS[name]
    sets = ("procedural rooms", "hand-made levels", "recorded depth", "photographs: fern")
    found = [
        next(row for row in rows if row[0].startswith(one) and row[1] == judged) for one in sets
    ]
    time = [
        next(row for row in rows if row[0].startswith(sets[at]) and row[1] == timed)
        for at in (0, 2)
    ]
    assert re.findall(r"(\d\.\d+) s", facts.cost) == [row[9].strip(" |") for row in time]
    psnr, depth = facts.gives.split(";")
    assert re.findall(r"\d+\.\d+", psnr) == [row[3] for row in found]
    assert re.findall(r"\d+\.\d+", depth) == [row[5] for row in found[:3]]


def test_the_list_has_each_completer_and_ones_own(capsys, monkeypatch, tmp_path):
    class Mine(Completer):
        name = "mine"

    monkeypatch.setattr(base, "_REGISTRY", {**base._REGISTRY, "mine": Mine})
    assert main(["completers", "--json", str(tmp_path / "list.json")]) == 0
    said = capsys.readouterr().out
    for name in ("none: ", "inpaint: ", "geoverse, the model that ships: ", "mine: of your own"):
        assert f"\n{name}" in f"\n{said}"
    written = json.loads((tmp_path / "list.json").read_text())
    assert [entry["name"] for entry in written["completers"]] == [name for name, _ in FACTS]
    assert written["without_figures"] == ["mine"]
