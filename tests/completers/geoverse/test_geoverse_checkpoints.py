"""Published files and one's own: what is whole is loaded as it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import geoverse_models as micro
import published_folder as published
import pytest
import torch
from geoverse_folders import (
    BARE,
    CONTROL,
    PLAIN,
    SHARED,
    equal,
    load,
    output,
    refused,
    report,
)
from oracle import ABSENT, ORACLE
from published_folder import CASCADE, GEOMETRY, LEVEL1, RGB_HEAD
from safetensors.torch import load_file, save_file

from gvtools.completers.geoverse import GeoVerse, named
from gvtools.completers.geoverse.config import GeoVerseConfig
from gvtools.completers.geoverse.model import empty_model
from gvtools.completers.geoverse.weights import PARTS, expected_of, save_pretrained
from gvtools.networks.tensors import STORED_TYPES, TensorFiles

pytestmark = pytest.mark.usefixtures("one_thread")


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
    save_pretrained(model, tmp_path)
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


@pytest.mark.parametrize(
    ("wrapper", "start"), [("ema", "module."), ("ema", ""), ("model", ""), (None, "module.")]
)
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
    assert report(folder, "rgb_head").ignored == (f"{start}encoder.mask",)


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
    assert report(folder, "geometry_head").ok
    head = published.write_dpt_head(micro.model(BARE), folder)
    state, before = load(folder).state_dict(), load(source).state_dict()
    for name, tensor in before.items():
        own = head.get(name.removeprefix("geometry.head."), tensor)
        assert torch.equal(state[name], own), name
    assert "1 others in the file ignored" in report(folder, "geometry_head").summary
    content = torch.load(folder / published.DPT_HEAD)["model"]
    kept = content.pop("decoder.norm.weight")
    torch.save({"model": {**content, "pred.colour": torch.zeros(2)}}, folder / published.DPT_HEAD)
    said = report(folder, "geometry_head")
    assert said.ok
    assert "missing, as its publisher's code lets pass: norm.weight" in said.summary
    assert "unexpected, as its publisher's code lets pass: colour" in said.summary
    state = load(folder).state_dict()
    name = "geometry.head.norm.weight"
    assert torch.equal(state[name], before[name]) and not torch.equal(state[name], kept)
    torch.save({"model": {**content, "decoder.norm.weight": kept[1:]}}, folder / published.DPT_HEAD)
    refused(folder, r"dpt_decoder\.pt: .*of another shape: norm\.weight")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_floating_point_types_are_loaded_as_float32(folder: Path, dtype: torch.dtype) -> None:
    content = torch.load(folder / LEVEL1)["ema"]
    torch.save({"ema": {n: t.to(dtype) for n, t in content.items()}}, folder / LEVEL1)
    state = load(folder).state_dict()
    for name, tensor in content.items():
        assert torch.equal(state[f"level1.{name}"], tensor.to(dtype).float())
    assert str(dtype).removeprefix("torch.") in report(folder, "level1").summary


def test_views_and_parameters_are_loaded_as_they_are(folder: Path, source: Path) -> None:
    content = torch.load(folder / CASCADE)["ema"]
    name = "s_projector.weight"
    content[name] = torch.nn.Parameter(content[name].T.contiguous()).T
    torch.save({"ema": content}, folder / CASCADE)
    assert equal(load(folder), load(source))


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
