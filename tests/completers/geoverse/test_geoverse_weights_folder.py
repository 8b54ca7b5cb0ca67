"""Folders, their configuration and the video prior beside them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import geoverse_models as micro
import pytest
from geoverse_folders import CONTROL, PLAIN, SHARED, load, refused, report

from gvtools.completers.geoverse.weights import WHOLE_FILE, check_folder, from_pretrained
from gvtools.errors import CheckpointError
from gvtools.networks.config_json import to_json

pytestmark = pytest.mark.usefixtures("one_thread")


def test_what_is_no_folder_is_refused(tmp_path: Path, own: Path) -> None:
    for place, message in (
        (tmp_path / "absent", "absent does not exist; expected a folder"),
        (own / WHOLE_FILE, "is a file; expected a folder"),
    ):
        for config in (None, PLAIN):
            with pytest.raises(CheckpointError, match=message):
                load(place, config)
            with pytest.raises(CheckpointError, match=message):
                check_folder(place, config)
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match=r"neither config\.json nor a published file"):
        load(tmp_path / "empty")
    (own / "config.json").unlink()
    with pytest.raises(CheckpointError, match=r"without its config\.json"):
        load(own)


def changed_config(**changes: Any) -> str:
    return json.dumps({**to_json(PLAIN), **changes})


def with_level1(**changes: Any) -> str:
    return changed_config(level1={**to_json(PLAIN)["level1"], **changes})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"config\.json: .*Expecting value"),
        ("{]", r"config\.json: "),
        ("[1]", r"expected an object"),
        (changed_config(image_sise=96), "no field 'image_sise'; did you mean 'image_size'"),
        (changed_config(image_size="96"), "image_size = '96'; expected int"),
        (changed_config(image_size=True), "image_size = True; expected int"),
        (changed_config(level1={"depth": 2.0}), r"level1\.depth = 2\.0; expected int"),
        (changed_config(flow={"shift": "no"}), r"flow\.shift = 'no'; expected float"),
        (changed_config(flow={"level1": 3}), r"flow\.level1 = 3; expected a list"),
        (changed_config(camera={"pixel_offset": [1.0]}), "expected 2 entries"),
        (changed_config(hints={"fill": "all"}), r"hints\.fill = 'all'; expected"),
        (changed_config(flow={"cfg_scale": float("nan")}), "cfg_scale = nan; expected a finite"),
        (changed_config(geometry=None), r"config\.geometry = None; expected an object"),
        (changed_config(rgb={"width": 30}), "config.json|expected"),
        (with_level1(width=-32), "no network comes of"),
        (with_level1(frequencies=-1), "no network comes of"),
    ],
)
def test_a_damaged_configuration_is_refused(own: Path, text: str, message: str) -> None:
    (own / "config.json").write_text(text)
    for read in (load, check_folder):
        with pytest.raises(CheckpointError, match=message) as caught:
            read(own)
        assert "\n" not in str(caught.value)


def test_a_configuration_of_another_size_does_not_fit(own: Path) -> None:
    (own / "config.json").write_text(with_level1(head_depth=2))
    refused(own, r"missing: level1\.blocks\.6\.")


def test_an_absent_video_folder_is_named(folder: Path) -> None:
    with pytest.raises(CheckpointError, match=r"video: absent; .*truncate-wan"):
        from_pretrained(folder, config=SHARED)
    found = report(folder, "video", SHARED)
    assert not found.ok
    assert "truncate-wan" in found.summary
    assert load(folder, SHARED).video is None


def test_the_video_folder_is_checked_as_it_is_loaded(folder: Path) -> None:
    pytest.importorskip("diffusers", reason="the extra wan is not installed")
    import tiny_wan

    tiny_wan.transformer().save_pretrained(folder / "video" / "transformer")
    tiny_wan.vae().save_pretrained(folder / "video" / "vae")
    zeros = replace(CONTROL, video=replace(tiny_wan.CONFIG, prompt="zeros"))
    model = from_pretrained(folder, config=zeros)
    assert model.video is not None
    model.generate(micro.batch(), seed=1)
    assert all(part.ok for part in check_folder(folder, zeros))
    for video, message in (
        (tiny_wan.CONFIG, "empty_prompt.safetensors is absent"),
        (replace(tiny_wan.CONFIG, prompt="zeros", channels=24), "48 channels; expected 24"),
        (replace(tiny_wan.CONFIG, prompt="zeros", taps=(0, 1, 2, 4)), "4 blocks"),
    ):
        config = replace(CONTROL, video=video)
        assert message in report(folder, "video", config).summary
        with pytest.raises(CheckpointError, match=message):
            from_pretrained(folder, config=config)
