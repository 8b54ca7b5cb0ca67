"""The paper's protocol: what it sets, and a run by it."""

from __future__ import annotations

import json

import pytest
from run_files import report_of, untimed
from tiny_scan import write_scan

from gvtools.settings import dotted, with_values
from pipelines.cli import main
from pipelines.reconstruction.settings import PAPER, RunSettings

pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.mark.parametrize("profile", RunSettings.presets["profile"])
def test_every_setting_of_the_protocol_holds_with_every_profile(profile):
    for names in (("profile", "protocol"), ("protocol", "profile")):
        values = {"profile": profile, "protocol": "paper"}
        config = with_values(RunSettings(), {name: values[name] for name in names})
        assert config.protocol == "paper" and not config.refine.wanted
        found = dotted(config.to_dict())
        for key, value in PAPER.items():
            assert found[key.replace("completer.", "completer_options.")] == value, key


def test_a_setting_of_ones_own_stands_above_the_protocol():
    config = with_values(RunSettings(), {"fusion.pixels": "holes", "protocol": "paper"})
    assert config.fusion.pixels == "holes" and config.fusion.generated_as_observed


@pytest.mark.usefixtures("one_thread")
def test_a_run_by_it_shows_whole_views_and_resumes(tmp_path, capsys):
    scan = write_scan(tmp_path / "scan", views=8)
    words = ["reconstruct", str(scan), "--protocol", "paper", "--quiet", "--views-per-round", "1"]
    words += ["--context", "first:6", "--targets", "range:6-7", "--out", str(tmp_path / "run")]
    assert main([*words, "--completer", "inpaint"]) == 2
    said = capsys.readouterr().err
    assert "protocol paper with completer 'inpaint'; expected geoverse" in said
    assert not (tmp_path / "run").exists()
    assert main([*words, "--rounds", "1"]) == 0
    report = report_of(tmp_path / "run", 1)
    (view,) = report["views"]
    # Pixels with depth are fused wherever they are, those that the memory knew, too.
    pixels = view["camera"]["width"] * view["camera"]["height"]
    assert view["fused_pixels"] > (1.3 - view["observed"]) * pixels
    assert report["generated"] == 0 and report["added"] > 0
    settings = json.loads((tmp_path / "run" / "run.json").read_text())["settings"]
    assert settings["protocol"] == "paper" and settings["completer"] == "geoverse"
    before = untimed(tmp_path / "run")
    assert main([*words, "--rounds", "1", "--resume"]) == 0
    assert untimed(tmp_path / "run") == before
