from __future__ import annotations

import json
from dataclasses import replace

import pytest

from gvtools.errors import OptionError
from pipelines.config import (
    PROFILES,
    RunConfig,
    changed_settings,
    with_file,
    with_profile,
    with_setting,
    with_settings,
)


def test_settings_are_converted_to_the_fields_type():
    config = with_settings(
        RunConfig(),
        ["splat.depth_band=0.03", "views_per_round=4", "voxel=auto", "splat.occluders=false"],
    )
    assert config.splat.depth_band == 0.03
    assert config.views_per_round == 4
    assert config.voxel is None
    assert config.splat.occluders is False


def test_completer_options_go_by_their_prefix():
    config = with_settings(RunConfig(), ["completer.sweeps=3", "completer=none"])
    assert config.completer == "none"
    assert config.completer_options == {"sweeps": "3"}


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("splat.depth_bnad=1", "splat.depth_band"),
        ("viewsperround=1", "views_per_round"),
        ("memory.merge_angle_de=1", "memory.merge_angle_deg"),
    ],
)
def test_an_unknown_key_names_the_nearest(text, named):
    with pytest.raises(OptionError, match=named):
        with_settings(RunConfig(), [text])


@pytest.mark.parametrize(
    "text",
    [
        "views_per_round=two",
        "views_per_round=1.5",
        "splat.depth_band=x",
        "splat.depth_band",
        "seed=",
    ],
)
def test_a_value_of_the_wrong_type_is_refused(text):
    with pytest.raises(OptionError):
        with_settings(RunConfig(), [text])


def test_a_saved_configuration_reads_back_equal(tmp_path):
    config = with_profile(RunConfig(), "fast")
    config = with_settings(config, ["seed=7", "completer.sweeps=3", "voxel=0.01"])
    path = tmp_path / "run.json"
    path.write_text(json.dumps(config.to_dict()))
    assert with_file(RunConfig(), path) == config


def test_the_file_s_own_settings_win_over_its_profile(tmp_path):
    path = tmp_path / "c.json"
    path.write_text(json.dumps({"memory": {"merge_angle_deg": 3.5}, "profile": "accurate"}))
    config = with_file(RunConfig(), path)
    assert config.memory.merge_angle_deg == 3.5
    assert config.memory.observations_per_voxel == 64


def test_a_profile_named_beside_a_file_stands_below_the_file(tmp_path):
    path = tmp_path / "c.json"
    path.write_text(json.dumps({"memory.merge_angle_deg": 8.0, "profile": "fast"}))
    config = with_file(RunConfig(), path, profile="accurate")
    assert (config.profile, config.memory.merge_angle_deg) == ("accurate", 8.0)
    assert config.memory.observations_per_voxel == 64


def test_no_options_of_the_completer_are_options(tmp_path):
    path = tmp_path / "c.json"
    path.write_text(json.dumps({"completer_options": None}))
    assert with_file(RunConfig(), path) == RunConfig()


@pytest.mark.parametrize("text", ["[1]", "{", '{"nosuch": 1}'])
def test_a_bad_file_is_refused(tmp_path, text):
    path = tmp_path / "c.json"
    path.write_text(text)
    with pytest.raises(OptionError):
        with_file(RunConfig(), path)


def test_profiles_only_hold_known_settings():
    for name in PROFILES:
        assert with_profile(RunConfig(), name).profile == name
    with pytest.raises(OptionError, match="balanced"):
        with_profile(RunConfig(), "quick")


def test_a_section_cannot_be_set_as_a_whole():
    with pytest.raises(OptionError):
        with_setting(RunConfig(), "splat", "1")


def test_settings_that_depend_on_each_other_may_come_in_any_order():
    for texts in (["stereo.sources=1", "stereo.best=1"], ["stereo.best=1", "stereo.sources=1"]):
        config = with_settings(RunConfig(), texts)
        assert (config.stereo.sources, config.stereo.best) == (1, 1)
    assert with_settings(RunConfig(), ["stereo.sources=1"]).stereo.sources == 1


def test_changed_settings_are_those_that_a_file_needs(tmp_path):
    texts = ["voxel=0.02", "splat.depth_band=0.03", "completer=geoverse", "completer.steps=2"]
    texts.append("seed=0")
    config = with_settings(RunConfig(), [*texts, "profile=fast"])
    changed = changed_settings(config)
    assert changed["splat.depth_band"] == 0.03 and changed["completer.steps"] == "2"
    assert "seed" not in changed and "profile" not in changed and "splat.support" not in changed
    (tmp_path / "profile.json").write_text(json.dumps(changed))
    again = with_file(RunConfig(), tmp_path / "profile.json")
    assert replace(again, profile="fast") == config
    assert changed_settings(RunConfig()) == {}
