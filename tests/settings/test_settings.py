from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvtools.depth.options import StereoOptions
from gvtools.errors import OptionError
from gvtools.settings import changes, listing, markdown, with_file, with_texts, with_values
from gvtools.settings.base import keys
from gvtools.training.options import TrainingSettings
from pipelines.cli import main
from pipelines.reconstruction.settings import RunSettings

RUN = RunSettings()


def test_texts_are_converted_to_the_field_s_type():
    texts = ["splat.depth_band=0.03", "views_per_round=4", "voxel=auto", "max_side=NULL"]
    config = with_texts(RUN, [*texts, "splat.occluders=false", "completer=none"])
    assert (config.splat.depth_band, config.views_per_round, config.voxel) == (0.03, 4, None)
    assert (config.max_side, config.splat.occluders, config.completer) == (None, False, "none")


def test_options_of_the_completer_go_by_its_name(tmp_path):
    config = with_texts(RUN, ["completer.sweeps=3", "completer.name=none"])
    assert config.completer == "none" and config.completer_options == {"sweeps": "3"}
    path = tmp_path / "c.json"
    path.write_text('{"completer": {"name": "none", "sweeps": "3"}}')
    assert with_file(RUN, path) == config
    path.write_text('{"completer_options": null}')
    assert with_file(config, path).completer_options == {}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("splat.depth_bnad=1", "no setting 'splat.depth_bnad'; did you mean 'splat.depth_band'"),
        ("viewsperround=1", "did you mean 'views_per_round'"),
        ("zzzz=1", "known keys: context, "),
        ("voxel.edge=1", "voxel is a value without settings below it"),
        ("splat=1", "it is a section; set one of its own, such as splat."),
        ("views_per_round=two", "views_per_round 'two'; expected a valid integer"),
        ("views_per_round=0", "views_per_round 0; expected at least 1"),
        ("fusion.voxel_scale=nan", "fusion.voxel_scale nan; expected more than 0"),
        ("device=gpu", "device 'gpu'; expected 'auto', 'cpu' or 'cuda'"),
        ("splat.depth_band", "expected KEY=VALUE"),
        ("profile=quick", "profile 'quick'; expected one of fast, balanced, accurate, finest"),
        ("stereo.window=4", "stereo.window 4; expected an odd number"),
        ("stereo.views=5", "stereo.views 5 is more than stereo.sources 4"),
    ],
)
def test_a_wrong_text_is_one_line(text, complaint):
    with pytest.raises(OptionError) as error:
        with_texts(RUN, [text])
    assert complaint in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text", ["[1]", "{", '{"nosuch": 1}', '{"seed": true}', '{"context": 3}', '{"profile": {}}']
)
def test_a_bad_file_is_named(tmp_path, text):
    path = tmp_path / "c.json"
    path.write_text(text)
    with pytest.raises(OptionError, match=r"c\.json: "):
        with_file(RUN, path)


FIELDS = st.fixed_dictionaries(
    {},
    optional={
        "voxel": st.none() | st.floats(1e-6, 1e6),
        "seed": st.integers(0, 2**40),
        "context": st.text(min_size=1),
        "completer.sweeps": st.integers() | st.text(),
        "fusion.max_psnr_drop_db": st.none() | st.floats(0, 100),
        "savings.reuse": st.booleans(),
        "splat.depth_band": st.floats(1e-6, 1),
        "stereo.align": st.none() | st.booleans(),
    },
)


@given(FIELDS, st.sampled_from(list(RunSettings.presets["profile"])))
def test_what_changed_makes_the_same_settings_again(values, profile):
    config = with_values(with_values(RUN, {"profile": profile}), values)
    assert with_values(RUN, changes(RUN, config)) == config.replaced(profile="balanced")
    assert changes(config, config) == {}
    assert "profile" not in changes(RUN, config)
    plain = {key: value for key, value in values.items() if not key.startswith("co")}
    texts = with_texts(
        with_values(RUN, {"profile": profile}), [f"{k}={v}" for k, v in plain.items()]
    )
    left = {"context": config.context, "completer_options": config.completer_options}
    assert texts.replaced(**left) == config


def test_saved_settings_read_back_equal(tmp_path):
    config = with_texts(RUN, ["seed=7", "profile=fast", "completer.sweeps=3", "voxel=0.01"])
    path = tmp_path / "settings.json"
    path.write_text(json.dumps(config.to_dict()))
    assert with_file(RUN, path) == config


@pytest.mark.parametrize(("profile", "direction"), [(None, 0.0), ("fast", 2.0)])
def test_a_file_stands_over_its_profile_and_over_one_named_beside_it(tmp_path, profile, direction):
    path = tmp_path / "c.json"
    path.write_text('{"memory": {"observations_per_voxel": 8}, "profile": "accurate"}')
    config = with_file(RUN, path, presets={"profile": profile} if profile else None)
    assert config.memory.observations_per_voxel == 8
    assert (config.profile, config.memory.merge_angle_deg) == (profile or "accurate", direction)


def test_a_section_by_itself_goes_by_its_full_name():
    assert with_texts(StereoOptions(), ["planes=16", "align=auto"]).planes == 16
    for text, complaint in (("plane=1", "'stereo.planes'"), ("planes=1", "stereo.planes 1;")):
        with pytest.raises(OptionError, match=complaint):
            with_texts(StereoOptions(), [text])


def test_later_texts_stand_over_earlier_ones_and_all_over_a_profile():
    assert with_texts(RUN, ["max_side=64", "max_side=100"]).max_side == 100
    for texts in (["max_side=100", "profile=fast"], ["profile=fast", "max_side=100"]):
        config = with_texts(RUN, texts)
        assert (config.max_side, config.views_per_round) == (100, 12)
    # Those that depend on each other may come in any order.
    for order in (1, -1):
        config = with_texts(RUN, ["stereo.sources=8", "stereo.views=8"][::order])
        assert (config.stereo.sources, config.stereo.views) == (8, 8)


@pytest.mark.parametrize("settings", [RUN, TrainingSettings()])
def test_every_setting_is_documented(settings):
    text, table = listing(settings), markdown(settings)
    for key in keys(type(settings)):
        assert f"  {key}=" in text and f"| `{key}` | `" in table
    assert all(row.count(" |") == 5 for row in table.splitlines() if row.startswith("| `"))
    assert all(len(line) <= 100 for line in text.splitlines())
    assert not [row for row in table.splitlines() if row.startswith("| `") and row[-4:] == "|  |"]


def test_help_settings_ends_the_program(capsys):
    with pytest.raises(SystemExit) as end:
        main(["reconstruct", "--max-side", "900", "--help-settings"])
    assert end.value.code == 0
    out = capsys.readouterr().out
    assert "  max_side=900 px  (integer, at least 64, or none)\n      Longer side" in out
    assert "fusion: What is taken of depth and of completions." in out
    assert "  completer.sweeps=60  (integer, at least 0)" in out
    assert "  completer.cascade_steps=none  (integer, at least 1, or none)" in out
