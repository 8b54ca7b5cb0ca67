from __future__ import annotations

import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import geoverse_models as micro
import published_folder as published
import pytest
import torch
from oracle import ABSENT, ORACLE
from published_folder import CASCADE, GEOMETRY, LEVEL1, RGB_HEAD, STATISTICS
from safetensors.torch import load_file, save_file
from torch import Tensor

from gvtools.completers.geoverse import GeoVerse, named
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.config_json import to_json
from gvtools.completers.geoverse.weights import saved_tensors
from gvtools.completers.geoverse.weights.checkpoints import READABLE, expected_of
from gvtools.completers.geoverse.weights.folder import (
    check_folder,
    from_pretrained,
    save_extension,
    save_pretrained,
)
from gvtools.completers.geoverse.weights.folder_parts import PartReport, empty_model
from gvtools.completers.geoverse.weights.published import PARTS, WHOLE_FILE
from gvtools.errors import CheckpointError, GvError, ProjectError

pytestmark = pytest.mark.usefixtures("one_thread")

PLAIN = micro.config()
CONTROL, SHARED = micro.config(injection="control"), micro.config(injection="shared")
# What GeoVerse adds to the published networks, taken away.
BARE = replace(PLAIN, level1=replace(PLAIN.level1, depth_condition=False))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of published files; its config.json has neither video nor extensions."""
    folder = tmp_path_factory.mktemp("published")
    return published.write_published(micro.model(BARE), folder)


@pytest.fixture(scope="module")
def own_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    micro.model(PLAIN).save_pretrained(folder)
    return folder


@pytest.fixture
def folder(source: Path, tmp_path: Path) -> Path:
    """Published files to be damaged."""
    return Path(shutil.copytree(source, tmp_path / "published"))


@pytest.fixture
def own(own_source: Path, tmp_path: Path) -> Path:
    """A folder of one's own to be damaged."""
    return Path(shutil.copytree(own_source, tmp_path / "own"))


def load(folder: Path, config: GeoVerseConfig | None = None) -> GeoVerse:
    return from_pretrained(folder, config=config, video=False)


def equal(a: GeoVerse, b: GeoVerse) -> bool:
    first, second = a.state_dict(), b.state_dict()
    return first.keys() == second.keys() and all(
        torch.equal(first[n], second[n]) and first[n].dtype == second[n].dtype for n in first
    )


def output(model: GeoVerse) -> list[Tensor]:
    views = micro.batch()
    features = None if model.config.video is None else micro.video_features(1, 4)
    made = model.generate(views, seed=3, video=features)
    return [made.level1, made.level0, made.decoded.rgb, made.decoded.geometry.depth]


def report(folder: Path, name: str, config: GeoVerseConfig | None = None) -> PartReport:
    return next(part for part in check_folder(folder, config) if part.name == name)


def refused(folder: Path, message: str, config: GeoVerseConfig | None = None) -> str:
    """Loading and checking refuse a folder alike; the message."""
    with pytest.raises(CheckpointError, match=message) as caught:
        load(folder, config)
    said = str(caught.value)
    assert "\n" not in said
    bad = [part for part in check_folder(folder, config) if not part.ok and part.name != "video"]
    assert bad
    assert bad[0].said in said
    return said


# What is whole


@pytest.mark.parametrize("config", [PLAIN, CONTROL, SHARED], ids=lambda c: c.injection)
def test_published_files_and_ones_own_are_the_same_model(
    source: Path, config: GeoVerseConfig, tmp_path: Path
) -> None:
    model = load(source, config)
    assert not model.training
    for name, parameter in model.named_parameters():
        frozen = name.startswith(("geometry.", "rgb_head.")) or name.endswith("t_embedder.W")
        assert parameter.requires_grad != frozen, name
    for start in ("geometry.", "level1.", "cascade.", "rgb_head.", "statistics.1."):
        wanted = published.part_of(published.tie_ray_norms(micro.model(BARE)), start)
        assert all(torch.equal(model.state_dict()[start + n], t) for n, t in wanted.items())
    model.save_pretrained(tmp_path)
    again = load(tmp_path)
    assert again.config == config
    assert equal(model, again)
    assert all(map(torch.equal, output(model), output(again)))


@pytest.mark.parametrize("config", [PLAIN, CONTROL, SHARED], ids=lambda c: c.injection)
def test_a_fresh_extension_changes_no_bit_and_is_the_same_each_time(
    source: Path, config: GeoVerseConfig
) -> None:
    bare, fresh = load(source), load(source, config)
    assert any(tensor.any() for tensor in output(bare)[:2])
    assert all(map(torch.equal, output(bare), output(fresh)))
    state = torch.get_rng_state()
    assert equal(fresh, load(source, config))
    assert torch.equal(torch.get_rng_state(), state)
    said = report(source, "extension", config)
    assert said.ok
    assert not said.needed
    assert "untrained" in said.said


@pytest.mark.parametrize("config", [CONTROL, SHARED], ids=lambda c: c.injection)
def test_a_trained_extension_is_read_beside_the_published_files(
    folder: Path, config: GeoVerseConfig
) -> None:
    trained = load(folder, config)
    with torch.no_grad():
        for name, parameter in trained.named_parameters():
            if name.startswith(("level1.depth_embedder.", "control.", "shared.")):
                parameter.add_(torch.randn_like(parameter), alpha=0.1)
    path = save_extension(trained, folder)
    assert path.stat().st_size < (folder / LEVEL1).stat().st_size
    again = load(folder, config)
    assert equal(trained, again)
    aside = path.rename(folder / "aside")
    assert not torch.equal(output(again)[0], output(load(folder, config))[0])
    aside.rename(path)
    tensors = load_file(path)
    save_file({**tensors, "level1.blocks.0.norm1.weight": torch.ones(32)}, path)
    refused(folder, r"unexpected: level1\.blocks\.0\.norm1\.weight", config)
    name = next(iter(tensors))
    save_file({n: t for n, t in tensors.items() if n != name}, path)
    refused(folder, f"missing: {name}", config)
    save_file({**tensors, name: tensors[name] + float("nan")}, path)
    refused(folder, f"{name} holds values that are not finite", config)


def test_a_model_without_extension_has_none_to_save(source: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="adds nothing"):
        save_extension(load(source), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("start", ["", "module."])
@pytest.mark.parametrize("wrapper", ["ema", "model", None])
def test_the_wrappings_of_published_tensors(
    folder: Path, source: Path, wrapper: str | None, start: str
) -> None:
    for file in (LEVEL1, CASCADE, RGB_HEAD):
        inner = {start + n: t for n, t in torch.load(folder / file)["ema"].items()}
        content: dict[str, Any] = inner if wrapper is None else {wrapper: inner, "epoch": 7}
        if wrapper == "ema":
            # Of a training checkpoint the averaged weights count, whatever else is in it.
            content |= {"model": {n: t + 1 for n, t in inner.items()}, "opt": {"state": {}}}
        torch.save(content, folder / file)
    assert equal(load(folder), load(source))
    assert report(folder, "rgb_head").passed_over == (f"{start}encoder.mask",)


def test_a_shared_tensor_may_have_any_of_its_names(folder: Path, source: Path) -> None:
    tensors = load_file(folder / GEOMETRY)
    one, other = (f"model.head.scratch.output_conv2_aux.{level}.2.bias" for level in (0, 3))
    value = tensors.pop(one)
    save_file({**tensors, other: value}, folder / GEOMETRY)
    assert equal(load(folder), load(source))
    save_file({**tensors, one: value.clone(), other: value.clone()}, folder / GEOMETRY)
    assert equal(load(folder), load(source))
    save_file({**tensors, one: value, other: value + 1}, folder / GEOMETRY)
    refused(folder, r"aux\.3\.2\.bias differs from head\.scratch\.output_conv2_aux\.0\.2\.bias")
    save_file(tensors, folder / GEOMETRY)
    refused(folder, r"missing: head\.scratch\.output_conv2_aux\.0\.2\.bias and 3 more")


def test_the_publishers_other_geometry_head_takes_the_place_of_the_first(
    folder: Path, source: Path
) -> None:
    assert not report(folder, "geometry_head").needed
    head = published.write_dpt_head(micro.model(BARE), folder)
    state, before = load(folder).state_dict(), load(source).state_dict()
    for name, tensor in before.items():
        own = head.get(name.removeprefix("geometry.head."), tensor)
        assert torch.equal(state[name], own), name
    assert "1 others in the file passed over" in report(folder, "geometry_head").said
    content = torch.load(folder / published.DPT_HEAD)["model"]
    torch.save({"model": {**content, "pred.colour": torch.zeros(2)}}, folder / published.DPT_HEAD)
    refused(folder, r"dpt_decoder\.pt: .*unexpected: colour")
    content.pop("decoder.norm.weight")
    torch.save({"model": content}, folder / published.DPT_HEAD)
    refused(folder, r"dpt_decoder\.pt: .*missing: norm\.weight")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_floating_point_types_are_loaded_as_float32(folder: Path, dtype: torch.dtype) -> None:
    content = torch.load(folder / LEVEL1)["ema"]
    torch.save({"ema": {n: t.to(dtype) for n, t in content.items()}}, folder / LEVEL1)
    state = load(folder).state_dict()
    for name, tensor in content.items():
        assert torch.equal(state[f"level1.{name}"], tensor.to(dtype).float())
    assert str(dtype).removeprefix("torch.") in report(folder, "level1").said


def test_views_and_parameters_are_loaded_as_they_are(folder: Path, source: Path) -> None:
    content = torch.load(folder / CASCADE)["ema"]
    name = "s_projector.weight"
    content[name] = torch.nn.Parameter(content[name].T.contiguous()).T
    torch.save({"ema": content}, folder / CASCADE)
    assert equal(load(folder), load(source))


# What is not


def tensors_changed(file: Path, change: Callable[[dict[str, Tensor]], Any]) -> None:
    if file.suffix == ".safetensors":
        tensors = load_file(file)
        change(tensors)
        save_file(tensors, file)
        return
    content = torch.load(file)
    change(content.get("ema", content))
    torch.save(content, file)


LAYER = "blocks.1.attn.qkv.weight"
DAMAGES: dict[str, tuple[Callable[[dict[str, Tensor]], Any], str]] = {
    "missing": (lambda t: [t.pop(LAYER), t.pop("blocks.1.attn.qkv.bias")], f"missing: {LAYER}"),
    "extra": (lambda t: t.update(extra=torch.zeros(2)), "unexpected: extra$"),
    "renamed": (
        lambda t: t.update(other=t.pop(LAYER)),
        f"missing: {LAYER}; unexpected: other",
    ),
    "shape": (
        lambda t: t.update({LAYER: t[LAYER][:, 1:].clone()}),
        rf"of another shape: {LAYER} is \(96, 31\), expected \(96, 32\)",
    ),
    "transposed": (lambda t: t.update({LAYER: t[LAYER].T.contiguous()}), r"is \(32, 96\)"),
    "nan": (lambda t: t[LAYER].view(-1)[-1:].fill_(float("nan")), f"{LAYER} holds values that"),
    "infinite": (lambda t: t[LAYER].view(-1)[5:6].fill_(float("-inf")), f"{LAYER} holds values"),
    "integers": (lambda t: t.update({LAYER: t[LAYER].long()}), f"{LAYER} is int64, expected float"),
    "quantised": (
        lambda t: t.update({LAYER: t[LAYER].to(torch.float8_e4m3fn)}),
        "is float8_e4m3fn, expected float32",
    ),
    "complex": (lambda t: t.update({LAYER: t[LAYER] + 0j}), "is complex64"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_published_file_with_wrong_tensors_is_refused(folder: Path, damage: str) -> None:
    change, message = DAMAGES[damage]
    tensors_changed(folder / LEVEL1, change)
    said = refused(folder, message.removesuffix("$"))
    assert "da3_level1.pt" in said
    assert [part.name for part in check_folder(folder) if not part.ok] == ["level1"]


@pytest.mark.parametrize("damage", ["missing", "extra", "shape", "nan", "integers"])
def test_a_folder_of_ones_own_with_wrong_tensors_is_refused(own: Path, damage: str) -> None:
    change, message = DAMAGES[damage]

    def changed(tensors: dict[str, Tensor]) -> None:
        inner = {n.removeprefix("level1."): t for n, t in tensors.items() if n.startswith("level1")}
        others = {n: t for n, t in tensors.items() if not n.startswith("level1")}
        change(inner)
        tensors.clear()
        tensors.update({**others, **{f"level1.{n}": t for n, t in inner.items()}})

    tensors_changed(own / WHOLE_FILE, changed)
    message = message.removesuffix("$").replace(LAYER, f"level1.{LAYER}")
    assert WHOLE_FILE in refused(own, message.replace(": extra", ": level1.extra"))


def test_sparse_tensors_are_refused(folder: Path) -> None:
    tensors_changed(folder / LEVEL1, lambda t: t.update({LAYER: t[LAYER].to_sparse()}))
    refused(folder, f"{LAYER} is sparse")


def test_what_does_not_fit_is_listed_in_full(folder: Path) -> None:
    tensors_changed(folder / LEVEL1, DAMAGES["missing"][0])
    tensors_changed(folder / LEVEL1, lambda t: t.update(a=torch.zeros(1), b=torch.zeros(1)))
    found = report(folder, "level1").to_dict()
    assert found["missing"] == [LAYER, "blocks.1.attn.qkv.bias"]
    assert found["unexpected"] == ["a", "b"]
    assert "missing: blocks.1.attn.qkv.weight and 1 more; unexpected: a and 1 more" in found["said"]
    json.dumps(found)


def test_a_name_that_is_there_twice_is_refused(folder: Path) -> None:
    tensors_changed(folder / LEVEL1, lambda t: t.update({f"module.{LAYER}": t[LAYER] + 1}))
    refused(folder, f"holds {LAYER} twice, also as module.{LAYER}")


def test_a_network_in_the_place_of_another_is_refused(folder: Path) -> None:
    shutil.copy(folder / CASCADE, folder / LEVEL1)
    refused(folder, r"da3_level1\.pt: .*missing: .*unexpected: ")
    shutil.copy(folder / LEVEL1, folder / RGB_HEAD)
    said = report(folder, "rgb_head").said
    assert "missing: trainable_cls_token and 23 more" in said
    assert "others in the file passed over" in said


def test_statistics_of_the_other_level_are_refused(folder: Path) -> None:
    shutil.copy(folder / STATISTICS[1], folder / STATISTICS[0])
    refused(folder, r"level0\.pt: statistics of level 1; expected level 0")
    content = torch.load(folder / STATISTICS[1])
    torch.save({**content, "level": -3}, folder / STATISTICS[1])
    assert report(folder, "statistics1").ok
    torch.save({**content, "var": -content["var"]}, folder / STATISTICS[1])
    assert "negative" in report(folder, "statistics1").said
    torch.save({"mean": content["mean"]}, folder / STATISTICS[1])
    assert "missing: var" in report(folder, "statistics1").said


class Malicious:
    """Unpickled, it would make a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return os.system, (f"touch '{self.path}'",)


@pytest.mark.parametrize("form", ["torch", "beside", "pickle"])
def test_code_in_a_file_is_not_run(folder: Path, tmp_path: Path, form: str) -> None:
    trace, file = tmp_path / "trace", folder / LEVEL1
    inner = torch.load(file)["ema"]
    if form == "torch":
        torch.save({"ema": {**inner, "evil": Malicious(trace)}}, file)
    elif form == "beside":
        torch.save({"ema": inner, "config": Malicious(trace)}, file)
    else:
        file.write_bytes(pickle.dumps({"ema": inner, "evil": Malicious(trace)}))
    message = "bare pickle, which may hold code" if form == "pickle" else r"asks for \w+\.system"
    refused(folder, message)
    assert not trace.exists()
    # The trap works: without the caution the file would be there.
    pickle.loads(pickle.dumps(Malicious(trace)))
    assert trace.exists()


def zip_of_text(file: Path) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("readme.txt", "no tensors")


@pytest.mark.parametrize("file", [GEOMETRY, STATISTICS[0]], ids=lambda f: f.name)
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: f.write_bytes(f.read_bytes()[:-50]), "cannot be read"),
        (lambda f: f.write_bytes(f.read_bytes()[: f.stat().st_size // 2]), "cannot be read"),
        (lambda f: f.write_bytes(f.read_bytes()[:3]), "cannot be read|no PyTorch file"),
        (lambda f: f.write_bytes(b""), "is empty"),
        (zip_of_text, "cannot be read"),
        (lambda f: f.write_text("<!DOCTYPE html><p>Sign in</p>"), "cannot be read|no PyTorch file"),
        (
            lambda f: f.write_text(
                f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 12345\n"
            ),
            "Git LFS's placeholder",
        ),
    ],
    ids=["torn", "half", "start", "empty", "zip", "html", "lfs"],
)
def test_a_file_that_is_no_whole_tensor_file_is_refused(
    folder: Path, file: Path, damage: Callable[[Path], Any], message: str
) -> None:
    damage(folder / file)
    assert file.name in refused(folder, message)


def test_other_contents_of_a_pytorch_file_are_refused(folder: Path) -> None:
    tensors = torch.load(folder / LEVEL1)["ema"]
    for content, message in (
        ([1, 2], "holds a list; expected a dictionary"),
        (torch.zeros(3), "holds a Tensor"),
        ({"ema": {**tensors, "opt": [1]}}, "'opt' is a list; expected tensors by name"),
        ({"ema": {**tensors, 7: torch.zeros(1)}}, "7 is a Tensor"),
        ({"weights": tensors}, "'weights' is a dict"),
    ):
        torch.save(content, folder / LEVEL1)
        refused(folder, message)
    torch.save({"ema": tensors}, folder / LEVEL1, _use_new_zipfile_serialization=False)
    refused(folder, r"since PyTorch 1\.6")


@pytest.mark.parametrize("file", [STATISTICS[0], Path("a.safetensors")], ids=lambda f: f.suffix)
def test_no_damage_ends_in_another_error(folder: Path, file: Path) -> None:
    """Every ending, and random bytes: either it is read, or the error is our own."""
    from gvtools.completers.geoverse.weights.checkpoints import read_tensors

    path = folder / file
    if file.suffix == ".safetensors":
        save_file({"a": torch.randn(5), "b": torch.randn(2, 3).half()}, path)
    whole = path.read_bytes()
    generator = torch.Generator().manual_seed(0)
    variants = [whole[:end] for end in range(0, len(whole), max(1, len(whole) // 60))]
    for _ in range(150):
        changed = bytearray(whole)
        for place in torch.randint(len(whole), (2,), generator=generator).tolist():
            changed[place] ^= int(torch.randint(1, 256, (1,), generator=generator))
        variants.append(bytes(changed))
    refusals = 0
    for variant in variants:
        path.write_bytes(variant)
        try:
            read_tensors(path)
        except CheckpointError as error:
            refusals += 1
            assert "\n" not in str(error)
    assert refusals >= 60


@pytest.mark.parametrize("file", published.FILES, ids=lambda f: f.name)
def test_an_absent_file_is_named_with_its_publisher(folder: Path, file: Path) -> None:
    (folder / file).unlink()
    said = refused(folder, f"absent: neither {WHOLE_FILE} nor {file}")
    assert "GLD" in said or "Geometric-Latent-Diffusion" in said
    assert "gvtools weights list" in said


# Folders and their configuration


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
        (changed_config(hints={"fill": "all"}), r"hints\.fill = 'all'; expected one of"),
        (changed_config(flow={"guidance": float("nan")}), "guidance = nan; expected a finite"),
        (changed_config(geometry=None), r"config\.geometry = None; expected an object"),
        (changed_config(rgb={"width": 30}), "config.json|expected"),
    ],
)
def test_a_damaged_configuration_is_refused(own: Path, text: str, message: str) -> None:
    (own / "config.json").write_text(text)
    for read in (load, check_folder):
        with pytest.raises(CheckpointError, match=message) as caught:
            read(own)
        assert "\n" not in str(caught.value)


def test_dimensions_that_make_no_network_are_refused(own: Path) -> None:
    for changes in ({"width": -32}, {"frequencies": -1}):
        level1 = {**to_json(PLAIN)["level1"], **changes}
        (own / "config.json").write_text(changed_config(level1=level1))
        for read in (load, check_folder):
            with pytest.raises(CheckpointError, match="no network comes of") as caught:
                read(own)
            assert "\n" not in str(caught.value)


def test_a_configuration_of_another_size_does_not_fit(own: Path) -> None:
    level1 = {**to_json(PLAIN)["level1"], "head_depth": 2}
    (own / "config.json").write_text(changed_config(level1=level1))
    refused(own, r"missing: level1\.blocks\.6\.")


# The video prior beside them


def test_an_absent_video_folder_is_named(folder: Path) -> None:
    with pytest.raises(CheckpointError, match=r"video: absent; .*truncate-wan"):
        from_pretrained(folder, config=CONTROL)
    found = report(folder, "video", CONTROL)
    assert not found.ok
    assert found.needed
    assert "truncate-wan" in found.said
    assert load(folder, CONTROL).video is None


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
        assert message in report(folder, "video", config).said
        with pytest.raises(CheckpointError, match=message):
            from_pretrained(folder, config=config)


# Saving


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_what_must_not_be_rounded_keeps_float32(dtype: str, tmp_path: Path) -> None:
    model = micro.model(PLAIN)
    model.save_pretrained(tmp_path, dtype=dtype)
    stored, state = load_file(tmp_path / WHOLE_FILE), model.state_dict()
    exact = {name for name, tensor in stored.items() if tensor.dtype == torch.float32}
    assert exact == {
        "rgb_head.decoder_pos_embed",
        "level1.t_embedder.W",
        "cascade.t_embedder.W",
        *(f"statistics.{level}.{name}" for level in (0, 1) for name in ("mean", "var")),
    }
    kind = getattr(torch, dtype)
    loaded = load(tmp_path).state_dict()
    for name, tensor in state.items():
        wanted = tensor if name in exact else tensor.to(kind).float()
        assert torch.equal(loaded[name], wanted), name
        assert loaded[name].dtype == torch.float32
    assert (tmp_path / WHOLE_FILE).stat().st_size < 0.65 * sum(
        4 * t.numel() for t in state.values()
    )


def test_what_could_not_be_loaded_is_not_saved(tmp_path: Path) -> None:
    model = micro.model(PLAIN)
    model.save_pretrained(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    weight = model.level1.blocks[0].attn.qkv.weight
    for value, dtype, message in (
        (1e6, "float16", r"reaches 1e\+06, too large for float16"),
        (float("nan"), "float32", "not finite"),
        (0.0, "float8", "expected one of float32, float16, bfloat16"),
    ):
        with torch.no_grad():
            weight[0, 0] = value
        with pytest.raises(CheckpointError, match=message):
            save_pretrained(model, tmp_path, dtype=dtype)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_write_that_fails_leaves_the_earlier_model_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = micro.model(PLAIN)
    model.save_pretrained(tmp_path / "model")
    other = micro.model(replace(PLAIN, views=4), seed=1)

    def full(tensors: Any, file: str, **_: Any) -> None:
        Path(file).write_bytes(b"half of it")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("safetensors.torch.save_file", full)
        with pytest.raises(ProjectError, match="No space left on device"):
            save_pretrained(other, tmp_path / "model")
        with pytest.raises(ProjectError, match="No space left on device"):
            save_pretrained(other, tmp_path / "new")
    assert equal(load(tmp_path / "model"), model)
    assert load(tmp_path / "model").config == model.config
    assert len(list((tmp_path / "model").iterdir())) == 2
    assert not list((tmp_path / "new").iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(ProjectError, match="cannot be written"):
        save_pretrained(other, tmp_path / "file")


def test_weights_are_never_beside_another_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed between the two names, the folder holds no model, rather than a wrong one."""
    micro.model(PLAIN).save_pretrained(tmp_path)
    other = micro.model(replace(PLAIN, views=4), seed=1)
    real = Path.replace

    def killed(path: Path, target: Path) -> Path:
        if target.name == "config.json":
            raise KeyboardInterrupt
        return real(path, target)

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        save_pretrained(other, tmp_path)
    monkeypatch.undo()
    with pytest.raises(GvError, match=r"without its config\.json"):
        load(tmp_path)
    save_pretrained(other, tmp_path)
    assert equal(load(tmp_path), other)


def test_a_model_is_saved_over_the_files_it_was_loaded_from(own: Path) -> None:
    model = load(own)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    with torch.no_grad():
        model.level1.get_parameter("blocks.0.norm1.weight").add_(1)
    model.save_pretrained(own)
    again = load(own)
    assert equal(model, again)
    changed = [n for n, t in again.state_dict().items() if not torch.equal(t, before[n])]
    assert changed == ["level1.blocks.0.norm1.weight"]


def test_training_does_not_write_into_the_loaded_files(own: Path) -> None:
    before = (own / WHOLE_FILE).read_bytes()
    model = load(own)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1)
    assert (own / WHOLE_FILE).read_bytes() == before


def test_two_names_of_one_tensor_are_both_saved(tmp_path: Path) -> None:
    shared = torch.randn(4, 4)
    tensors = {"a": shared, "b": shared, "c": shared.T, "d": shared[1:]}
    saved_tensors.save_tensors(tensors, tmp_path / "t.safetensors", about="x")
    found = load_file(tmp_path / "t.safetensors")
    assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items())


def test_saved_files_can_be_read_by_those_who_can_read_the_others(tmp_path: Path) -> None:
    micro.model(PLAIN).save_pretrained(tmp_path)
    modes = {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert len(modes) == 1


# The published networks themselves


@pytest.mark.skipif(not (ORACLE / "keys").is_dir(), reason=ABSENT)
@pytest.mark.parametrize(
    ("part", "keys", "start"),
    [
        ("geometry", "da3_base", ""),
        ("level1", "gld_da3_level1", "module."),
        ("cascade", "gld_da3_cascade", ""),
        ("rgb_head", "gld_rgb_decoder", "decoder."),
    ],
)
def test_the_published_key_lists_become_ours(part: str, keys: str, start: str) -> None:
    known = next(p for p in PARTS if p.name == part)
    found = {}
    for line in (ORACLE / "keys" / f"{keys}.txt").read_text(encoding="utf-8").splitlines():
        name, shape = line.split("\t")[:2]
        sides = tuple(int(side) for side in shape.strip("()").split(",") if side.strip())
        found[known.own_name(start + name)] = sides
    assert found == expected_of(base(), known)
    assert all(name in found for names in known.tied for name in names)


def base() -> GeoVerse:
    return empty_model(named("base"), where="base")


def test_the_core_does_without_safetensors_until_a_file_is_read() -> None:
    code = (
        "import sys, gvtools.completers.geoverse;"
        "print([m for m in ('safetensors', 'diffusers', 'open3d') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_readable_types_are_floating_point() -> None:
    assert all(dtype.is_floating_point and dtype.itemsize >= 2 for dtype in READABLE)
