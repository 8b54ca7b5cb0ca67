from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import geoverse_models as micro
import published_folder as published
import pytest
import torch
from geoverse_folders import BARE, CONTROL, PLAIN, SHARED, equal, load, output, refused, report
from oracle import ABSENT, ORACLE
from published_folder import CASCADE, GEOMETRY, LEVEL1, RGB_HEAD, STATISTICS
from safetensors.torch import load_file, save_file
from torch import Tensor

from gvtools.completers.geoverse import GeoVerse, named
from gvtools.completers.geoverse.model import empty_model
from gvtools.completers.geoverse.weights import (
    PARTS,
    WHOLE_FILE,
    PartReport,
    check_folder,
    examine,
    expected_of,
    from_pretrained,
    left_out,
    parts_of,
    save_pretrained,
)
from gvtools.errors import CheckpointError, GvError, ProjectError
from gvtools.networks.config_json import to_json
from gvtools.networks.tensors import STORED_TYPES, TensorFiles, save_tensors


@cache
def empty() -> GeoVerse:
    return empty_model(BARE, where="bare")


def examined(folder: Path, name: str) -> tuple[PartReport, dict[str, Tensor]]:
    return examine(folder, next(part for part in parts_of(BARE) if part.name == name), empty())


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def refused_part(folder: Path, name: str, message: str) -> str:
    found, tensors = examined(folder, name)
    assert not found.ok and not tensors
    assert re.search(message, found.summary), found.summary
    assert "\n" not in found.summary
    return found.summary


@pytest.fixture(scope="module", params=[PLAIN, CONTROL, SHARED], ids=lambda c: c.injection)
def fresh(source: Path, request: pytest.FixtureRequest) -> tuple[GeoVerse, list[Tensor]]:
    model = load(source, request.param)
    return model, output(model)


def test_published_files_and_ones_own_are_the_same_model(fresh, tmp_path):
    model, made = fresh
    assert not model.training
    state = model.state_dict()
    for name, parameter in model.named_parameters():
        frozen = name.startswith(("geometry.", "rgb_head.")) or name.endswith("t_embedder.W")
        assert parameter.requires_grad != frozen, name
    stored = published.tie_ray_norms(micro.model(BARE))
    for start in ("geometry.", "level1.", "cascade.", "rgb_head.", "statistics.1."):
        wanted = published.part_of(stored, start)
        assert all(torch.equal(state[start + name], t) for name, t in wanted.items())
    save_pretrained(model, tmp_path)
    again = load(tmp_path)
    assert again.config == model.config
    assert equal(model, again)
    assert all(map(torch.equal, made, output(again)))


def test_a_fresh_extension_changes_no_bit_and_is_the_same_each_time(source, fresh):
    model, made = fresh
    bare = output(load(source))
    assert any(tensor.any() for tensor in bare[:2])
    assert all(map(torch.equal, bare, made))
    state = torch.get_rng_state()
    assert equal(model, load(source, model.config))
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize(
    ("wrapper", "start"), [("ema", "module."), ("ema", ""), ("model", ""), (None, "module.")]
)
def test_the_wrappings_of_published_tensors(folder, source, wrapper, start):
    for file, name in ((LEVEL1, "level1"), (CASCADE, "cascade"), (RGB_HEAD, "rgb_head")):
        inner = {start + n: t for n, t in torch.load(folder / file)["ema"].items()}
        content: dict[str, Any] = inner if wrapper is None else {wrapper: inner, "epoch": 7}
        if wrapper == "ema":
            # Of a training checkpoint the averaged weights count, whatever else is in it.
            content |= {"model": {n: t + 1 for n, t in inner.items()}, "opt": {"state": {}}}
        torch.save(content, folder / file)
        found, tensors = examined(folder, name)
        assert found.ok and same(tensors, examined(source, name)[1])
    assert found.ignored == (f"{start}encoder.mask",)


def test_a_shared_tensor_may_have_any_of_its_names(folder: Path, source: Path) -> None:
    wanted, tensors = examined(source, "geometry")[1], load_file(folder / GEOMETRY)
    one, other = (f"model.head.scratch.output_conv2_aux.{level}.2.bias" for level in (0, 3))
    value = tensors.pop(one)
    for names in ({other: value}, {one: value.clone(), other: value.clone()}):
        save_file({**tensors, **names}, folder / GEOMETRY)
        assert same(examined(folder, "geometry")[1], wanted)
    name = r"head\.scratch\.output_conv2_aux\.0\.2\.bias"
    for names, message in (
        ({one: value, other: value + 1}, rf"aux\.3\.2\.bias differs from {name}"),
        ({}, f"missing: {name} and 3 more"),
    ):
        save_file({**tensors, **names}, folder / GEOMETRY)
        refused_part(folder, "geometry", message)


def test_the_publishers_other_geometry_head_takes_the_place_of_the_first(folder, source):
    assert report(folder, "geometry_head").ok
    before = load(source).state_dict()
    head = published.write_dpt_head(micro.model(BARE), folder)
    for name, tensor in load(folder).state_dict().items():
        own = head.get(name.removeprefix("geometry.head."), before[name])
        assert torch.equal(tensor, own), name
    assert "1 others in the file ignored" in report(folder, "geometry_head").summary
    content = torch.load(folder / published.DPT_HEAD)["model"]
    kept = content.pop("decoder.norm.weight")
    torch.save({"model": {**content, "pred.colour": torch.zeros(2)}}, folder / published.DPT_HEAD)
    said, tensors = examined(folder, "geometry_head")
    assert said.ok
    assert "missing, as its publisher's code lets pass: norm.weight" in said.summary
    assert "unexpected, as its publisher's code lets pass: colour" in said.summary
    name = "geometry.head.norm.weight"
    assert name not in tensors
    assert torch.equal(load(folder).state_dict()[name], before[name])
    assert left_out(folder, BARE) is None
    twice = {"decoder.norm.weight": kept, "pred.norm.weight": kept + 1}
    torch.save({"model": {**content, **twice}}, folder / published.DPT_HEAD)
    assert torch.equal(examined(folder, "geometry_head")[1][name], kept + 1)
    for damaged in ({"model": {**content, "decoder.norm.weight": kept[1:]}}, {"model": print}):
        torch.save(damaged, folder / published.DPT_HEAD)
        said, tensors = examined(folder, "geometry_head")
        assert said.ok and said.left_out and not tensors
        assert "dpt_decoder.pt is left out, Depth Anything 3's own" in str(left_out(folder, BARE))
    assert equal(load(folder), load(source))


def test_other_floating_point_types_are_loaded_as_float32(folder: Path) -> None:
    kinds = (torch.float16, torch.bfloat16, torch.float64)
    tensors = torch.load(folder / LEVEL1)["ema"].items()
    content = {n: t.to(kinds[index % 3]) for index, (n, t) in enumerate(tensors)}
    torch.save({"ema": content}, folder / LEVEL1)
    state = load(folder).state_dict()
    for name, tensor in content.items():
        assert torch.equal(state[f"level1.{name}"], tensor.float())
        assert state[f"level1.{name}"].dtype == torch.float32
    assert "bfloat16 and float16 and float64" in report(folder, "level1").summary


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


@cache
def base() -> GeoVerse:
    return empty_model(named("base"), where="base")


def test_files_are_read_as_the_library_reads_them(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    numbers = torch.randn(3, 4, 2, generator=generator)
    tensors = {str(d): (numbers * 9).to(d) for d in STORED_TYPES.values()}
    tensors |= {"scalar": torch.tensor(2.5), "empty": torch.zeros(0, 3)}
    save_file(tensors, tmp_path / "a.safetensors", metadata={"format": "pt"})
    files = TensorFiles.find(tmp_path)
    assert files.places.keys() == tensors.keys()
    for name, tensor in load_file(tmp_path / "a.safetensors").items():
        found = files.read(name)
        assert (found.dtype, found.shape) == (tensor.dtype, tensor.shape)
        assert torch.equal(found, tensor)


LAYER = "blocks.1.attn.qkv.weight"

DAMAGES: dict[str, tuple[Callable[[dict[str, Tensor]], Any], str]] = {
    "missing": (lambda t: [t.pop(LAYER), t.pop("blocks.1.attn.qkv.bias")], f"missing: {LAYER}"),
    "extra": (lambda t: t.update(extra=torch.zeros(2)), "unexpected: extra"),
    "shape": (
        lambda t: t.update({LAYER: t[LAYER][:, 1:].clone()}),
        rf"of another shape: {LAYER} is \(96, 31\), expected \(96, 32\)",
    ),
    "nan": (lambda t: t[LAYER].view(-1)[-1:].fill_(float("nan")), f"{LAYER} holds values that"),
    "integers": (lambda t: t.update({LAYER: t[LAYER].long()}), f"{LAYER} is int64, expected float"),
    "quantised": (
        lambda t: t.update({LAYER: t[LAYER].to(torch.float8_e4m3fn)}),
        "is float8_e4m3fn, expected float32",
    ),
    "twice": (
        lambda t: t.update({f"module.{LAYER}": t[LAYER] + 1}),
        f"holds {LAYER} twice, also as module.{LAYER}",
    ),
    "sparse": (lambda t: t.update({LAYER: t[LAYER].to_sparse()}), f"{LAYER} is sparse"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_published_file_with_wrong_tensors_is_refused(folder: Path, damage: str) -> None:
    change, message = DAMAGES[damage]
    content = torch.load(folder / LEVEL1)
    change(content["ema"])
    torch.save(content, folder / LEVEL1)
    refused_part(folder, "level1", message)


def test_statistics_of_the_other_level_are_refused(folder: Path) -> None:
    shutil.copy(folder / STATISTICS[1], folder / STATISTICS[0])
    refused(folder, r"level0\.pt: statistics of level 1; expected level 0")
    content = torch.load(folder / STATISTICS[1])
    torch.save({**content, "level": -3}, folder / STATISTICS[1])
    assert examined(folder, "statistics1")[0].ok
    torch.save({**content, "var": -content["var"]}, folder / STATISTICS[1])
    refused_part(folder, "statistics1", "negative")
    torch.save({"mean": content["mean"]}, folder / STATISTICS[1])
    refused_part(folder, "statistics1", "missing: var")


class Malicious:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return os.system, (f"touch '{self.path}'",)


@pytest.mark.parametrize("form", ["torch", "pickle"])
def test_code_in_a_file_is_not_run(folder: Path, tmp_path: Path, form: str) -> None:
    trace, file = tmp_path / "trace", folder / LEVEL1
    inner = torch.load(file)["ema"]
    if form == "torch":
        torch.save({"ema": {**inner, "evil": Malicious(trace)}}, file)
    else:
        file.write_bytes(pickle.dumps({"ema": inner, "evil": Malicious(trace)}))
    message = "bare pickle, which may hold code" if form == "pickle" else r"asks for \w+\.system"
    refused_part(folder, "level1", message)
    assert not trace.exists()
    # The trap works: without the caution the file would be there.
    pickle.loads(pickle.dumps(Malicious(trace)))
    assert trace.exists()


def zip_of_text(file: Path) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("readme.txt", "no tensors")


@pytest.mark.parametrize(("part", "file"), [("geometry", GEOMETRY), ("statistics0", STATISTICS[0])])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: f.write_bytes(f.read_bytes()[:-50]), "cannot be read"),
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
    ids=["torn", "empty", "zip", "html", "lfs"],
)
def test_a_file_that_is_no_whole_tensor_file_is_refused(folder, part, file, damage, message):
    damage(folder / file)
    refused_part(folder, part, message)


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
        refused_part(folder, "level1", message)
    torch.save({"ema": tensors}, folder / LEVEL1, _use_new_zipfile_serialization=False)
    refused_part(folder, "level1", r"since PyTorch 1\.6")


def test_an_absent_file_is_named_with_its_publisher(folder: Path, tmp_path: Path) -> None:
    for name, file in zip([part.name for part in PARTS], published.FILES, strict=True):
        said = refused_part(tmp_path, name, f"absent: neither {WHOLE_FILE} nor {file}")
        assert "GLD" in said or "Geometric-Latent-Diffusion" in said or "DA3" in said
    (folder / LEVEL1).unlink()
    assert "gvtools weights list" in refused(folder, f"absent: neither {WHOLE_FILE} nor {LEVEL1}")


@cache
def plain() -> GeoVerse:
    """Not to be changed."""
    return micro.model(PLAIN)


@cache
def other() -> GeoVerse:
    """Not to be changed."""
    return micro.model(replace(PLAIN, views=4), seed=1)


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_what_must_not_be_rounded_keeps_float32(dtype: str, tmp_path: Path) -> None:
    model = plain()
    save_pretrained(model, tmp_path, dtype=dtype)
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
    size = (tmp_path / WHOLE_FILE).stat().st_size
    assert size < 0.65 * sum(4 * t.numel() for t in state.values())


def test_what_could_not_be_loaded_is_not_saved(tmp_path: Path) -> None:
    model = micro.model(PLAIN)
    save_pretrained(model, tmp_path)
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


def test_a_write_that_fails_leaves_the_earlier_model_whole(tmp_path, monkeypatch):
    save_pretrained(plain(), tmp_path / "model")

    def full(tensors: Any, file: str, **_: Any) -> None:
        Path(file).write_bytes(b"half of it")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("safetensors.torch.save_file", full)
        for name in ("model", "new"):
            with pytest.raises(ProjectError, match="No space left on device"):
                save_pretrained(other(), tmp_path / name)
    kept = load(tmp_path / "model")
    assert equal(kept, plain()) and kept.config == PLAIN
    assert len(list((tmp_path / "model").iterdir())) == 2
    assert not list((tmp_path / "new").iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(ProjectError, match="cannot be written"):
        save_pretrained(other(), tmp_path / "file")


def test_weights_are_never_beside_another_configuration(tmp_path, monkeypatch):
    save_pretrained(plain(), tmp_path)
    real = Path.replace

    def killed(path: Path, target: Path) -> Path:
        if target.name == "config.json":
            raise KeyboardInterrupt
        return real(path, target)

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        save_pretrained(other(), tmp_path)
    monkeypatch.undo()
    with pytest.raises(GvError, match=r"without its config\.json"):
        load(tmp_path)
    save_pretrained(other(), tmp_path)
    assert equal(load(tmp_path), other())


def test_a_model_is_saved_over_the_files_it_was_loaded_from(own: Path) -> None:
    model = load(own)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    with torch.no_grad():
        model.level1.get_parameter("blocks.0.norm1.weight").add_(1)
    save_pretrained(model, own)
    again = load(own)
    assert equal(model, again)
    changed = [n for n, t in again.state_dict().items() if not torch.equal(t, before[n])]
    assert changed == ["level1.blocks.0.norm1.weight"]


def test_two_names_of_one_tensor_are_both_saved(tmp_path: Path) -> None:
    shared = torch.randn(4, 4)
    tensors = {"a": shared, "b": shared, "c": shared.T, "d": shared[1:]}
    save_tensors(tensors, tmp_path / "t.safetensors", about="x")
    found = load_file(tmp_path / "t.safetensors")
    assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items())


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
        ("{]", r"config\.json: "),
        (changed_config(image_sise=96), "no field 'image_sise'; did you mean 'image_size'"),
        (changed_config(image_size="96"), "image_size = '96'; expected int"),
        (changed_config(hints={"fill": "all"}), r"hints\.fill = 'all'; expected"),
        (changed_config(flow={"cfg_scale": float("nan")}), "cfg_scale = nan; expected a finite"),
        (changed_config(level1={**to_json(PLAIN)["level1"], "width": -32}), "no network comes of"),
    ],
)
def test_a_damaged_configuration_is_refused(own: Path, text: str, message: str) -> None:
    (own / "config.json").write_text(text)
    for read in (load, check_folder):
        with pytest.raises(CheckpointError, match=message) as caught:
            read(own)
        assert "\n" not in str(caught.value)


def test_the_video_folder_is_checked_as_it_is_loaded(folder: Path) -> None:
    pytest.importorskip("diffusers", reason="the extra wan is not installed")
    import tiny_wan

    tiny_wan.transformer().save_pretrained(folder / "video" / "transformer")
    tiny_wan.vae().save_pretrained(folder / "video" / "vae")
    zeros = replace(CONTROL, video=replace(tiny_wan.CONFIG, prompt="zeros"))
    assert from_pretrained(folder, config=zeros).video is None
    assert "not run" in report(folder, "video", zeros).summary
    model = from_pretrained(folder, config=zeros, video=True)
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
        from_pretrained(folder, config=config, video=True)
