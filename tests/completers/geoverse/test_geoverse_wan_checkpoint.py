from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from math import prod
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("diffusers", reason="the extra wan is not installed")

import tiny_wan as tiny
from safetensors.torch import load_file, save_file
from tiny_wan import FILE, original_name, save_original

from gvtools.completers.geoverse.video_prior import VideoPrior
from gvtools.completers.geoverse.wan import (
    EMPTY_PROMPT,
    dtype_of,
    empty_network,
    expected_tensors,
    load_network,
    network_class,
    read_empty_prompt,
)
from gvtools.completers.geoverse.wan_checkpoint import (
    _TEXT,
    TEXT_FILE,
    VAE_FILE,
    by_diffusers_name,
    truncate,
    write_empty_prompt,
)
from gvtools.completers.geoverse.weights import VIDEO_SIZES
from gvtools.errors import CheckpointError, OptionError, ProjectError
from gvtools.networks.tensors import TensorFiles

# Of a Wan with six blocks and hints at 0, 2 and 4, the first four blocks and two hints.
LAYERS, HINTS = 6, (0, 2, 4)
KEPT: dict[str, Any] = {"blocks": 4}
QUANTISED = "blocks.1.ffn.2.weight"
A14B = {
    "num_layers": 40,
    "num_attention_heads": 40,
    "attention_head_dim": 128,
    "ffn_dim": 13824,
    "text_dim": 4096,
    "vace_layers": [0, 5, 10, 15, 20, 25, 30, 35],
}


@pytest.fixture(scope="module")
def network() -> Any:
    return tiny.transformer(LAYERS, HINTS)


@pytest.fixture(scope="module")
def diffusers_source(network: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source") / "wan"
    tiny.transformer(LAYERS, HINTS, seed=77).save_pretrained(folder / "transformer")
    network.save_pretrained(folder / "transformer_2", max_shard_size="120KB")
    tiny.vae().save_pretrained(folder / "vae")
    (folder / "model_index.json").write_text('{"boundary_ratio": 0.875}')
    assert len(list((folder / "transformer_2").glob("*.safetensors"))) > 5
    return folder


@pytest.fixture
def source(diffusers_source: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(diffusers_source, tmp_path / "wan"))


@pytest.fixture(scope="module")
def truncated(diffusers_source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "prior"
    truncate(diffusers_source, out, dtype=torch.float32, **KEPT)
    save_file({"embedding": tiny.prompt()}, out / EMPTY_PROMPT)
    return out


def check_folder(folder: Path, **options: Any) -> VideoPrior:
    return VideoPrior.from_pretrained(folder, config=replace(tiny.CONFIG, **options), device="meta")


def features(prior: VideoPrior) -> tuple[Tensor, ...]:
    return prior.features(*tiny.views(2, size=(16, 32)), 1)


@pytest.mark.parametrize("wrapper", ["", "model.diffusion_model."])
def test_stored_names_are_found_by_diffusers_name(network: Any, wrapper: str) -> None:
    names = list(network.state_dict())
    originals = [f"{wrapper}{original_name(name)}" for name in names]
    assert by_diffusers_name(originals) == dict(zip(names, originals, strict=True))
    assert by_diffusers_name(names) == dict(zip(names, names, strict=True))


def test_a_truncated_folder_gives_the_features_of_the_whole_network(network, truncated):
    direct = features(tiny.prior(network))
    loaded = features(VideoPrior.from_pretrained(truncated, config=tiny.CONFIG))
    assert all(map(torch.equal, direct, loaded))
    assert "prompt: (6, 20)" in check_folder(truncated).summary
    assert not list(truncated.parent.glob(".*"))


@pytest.mark.parametrize("kind", ["folder", "file", "wrapped", "bare"])
def test_wans_own_files_give_the_same_tensors(network, truncated, tmp_path, kind):
    wrapper = "model.diffusion_model." if kind == "wrapped" else ""
    folder = save_original(network, tmp_path / "wan" / "low_noise_model", wrapper=wrapper)
    tiny.vae().save_pretrained(tmp_path / "wan" / "vae")
    if kind == "bare":
        # Without a configuration everything but the width of a head shows in the shapes.
        (folder / "config.json").write_text('{"num_heads": 2}')
    place = folder / FILE if kind == "file" else folder.parent
    truncate(place, tmp_path / "out", dtype=torch.float32, **KEPT)
    found, wanted = (load_file(p / "transformer" / FILE) for p in (tmp_path / "out", truncated))
    assert found.keys() == wanted.keys()
    assert all(torch.equal(found[name], wanted[name]) for name in wanted)
    network_config, config = (
        network_class("transformer").load_config(p / "transformer")
        for p in (truncated, tmp_path / "out")
    )
    assert all(config[k] == network_config[k] for k in config if not k.startswith("_"))


def test_bfloat16_is_what_diffusers_makes_of_it(diffusers_source: Path, tmp_path: Path) -> None:
    pytest.importorskip("accelerate")
    truncate(diffusers_source, tmp_path / "out", **KEPT)
    wanted = network_class("transformer").from_pretrained(
        diffusers_source,
        subfolder="transformer_2",
        num_layers=4,
        vace_layers=[0, 2],
        torch_dtype=torch.bfloat16,
    )
    loaded = load_network(tmp_path / "out", "transformer")
    also = load_network(tmp_path / "out", "transformer", dtype=torch.float32)
    for name, tensor in wanted.state_dict().items():
        found = loaded.state_dict()[name]
        assert found.dtype == tensor.dtype, name
        assert torch.equal(found, tensor)
        assert torch.equal(also.state_dict()[name], tensor.float())
    for found, table in zip(loaded.buffers(), wanted.buffers(), strict=True):
        assert torch.equal(found, table)
    assert {t.dtype for t in wanted.state_dict().values()} == {torch.bfloat16, torch.float32}
    found, expected = (features(tiny.prior(network)) for network in (loaded, wanted))
    assert all(map(torch.equal, found, expected))
    assert found[0].dtype == torch.bfloat16


def test_nothing_is_read_that_is_not_needed(network, source, tmp_path, monkeypatch):
    config = {**network.config, "num_layers": 4, "vace_layers": [0, 2]}
    needed = set(expected_tensors(config))
    shards = source / "transformer_2"
    index = json.loads(next(shards.glob("*.index.json")).read_text())["weight_map"]
    unneeded = set(index.values()) - {index[name] for name in needed}
    assert unneeded
    for file in unneeded:
        (shards / file).unlink()
    reads: list[str] = []
    read = TensorFiles.read

    def reading(files: TensorFiles, name: str, **options: Any) -> Tensor:
        reads.append(name)
        return read(files, name, **options)

    monkeypatch.setattr(TensorFiles, "read", reading)
    truncate(source, tmp_path / "a", **KEPT)
    assert sorted(reads) == sorted(needed)


def test_several_files_are_written_where_one_would_be_large(
    diffusers_source: Path, truncated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gvtools.completers.geoverse.wan_checkpoint._PART", 300_000)
    steps: list[tuple[int, int]] = []
    out = tmp_path / "out"
    truncate(
        diffusers_source, out, dtype=torch.float32, progress=lambda *s: steps.append(s), **KEPT
    )
    files = sorted((out / "transformer").glob("*.safetensors"))
    assert len(files) > 2
    assert all(f.stat().st_size < 320_000 for f in files)
    theirs = network_class("transformer").from_pretrained(out / "transformer")
    wanted = load_file(truncated / "transformer" / FILE)
    for network in (theirs, load_network(out, "transformer")):
        assert network.state_dict().keys() == wanted.keys()
        assert all(torch.equal(network.state_dict()[n], wanted[n]) for n in wanted)
    done, totals = zip(*steps, strict=True)
    assert list(done) == sorted(done)
    assert {done[-1]} == set(totals)
    written = sum(f.stat().st_size for f in out.rglob("*") if f.is_file())
    assert written == pytest.approx(done[-1], rel=0.05)


def test_published_sizes() -> None:
    def numbers(tensors: Mapping[str, tuple[int, ...]]) -> int:
        return sum(map(prod, tensors.values()))

    # The published low-noise file is 34.7 GB in bfloat16.
    assert 2 * numbers(expected_tensors(A14B)) / 1e9 == pytest.approx(34.68, abs=0.01)
    tensors = expected_tensors({**A14B, "num_layers": 16, "vace_layers": [0, 5, 10, 15]})
    assert tensors["blocks.15.attn2.to_out.0.weight"] == (5120, 5120)
    assert tensors["vace_patch_embedding.weight"] == (5120, 96, 1, 2, 2)
    assert "vace_blocks.4.proj_out.weight" not in tensors
    size = sum(prod(s) * dtype_of(n, torch.bfloat16).itemsize for n, s in tensors.items())
    assert VIDEO_SIZES["transformer"] == (len(tensors), numbers(tensors), size)
    tensors = expected_tensors({}, component="vae")
    assert VIDEO_SIZES["vae"] == (len(tensors), numbers(tensors), 4 * numbers(tensors))


def damage(path: Path, change: Any) -> None:
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, path)


def original_with(network: Any, tmp_path: Path, change: Any) -> Path:
    folder = save_original(network, tmp_path / "own")
    tiny.vae().save_pretrained(tmp_path / "vae")
    damage(folder / FILE, change)
    return folder


def without(*starts: str) -> Any:
    return lambda tensors: [tensors.pop(n) for n in list(tensors) if n.startswith(starts)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            without("blocks.2.cross_attn.k.weight", "blocks.3.ffn.0.bias"),
            r"missing: blocks\.2\.attn2\.to_k\.weight and 1 more",
        ),
        (
            lambda t: t.update({QUANTISED: t[QUANTISED].to(torch.float8_e4m3fn)}),
            "is float8_e4m3fn, expected float32",
        ),
    ],
    ids=["missing", "quantised"],
)
def test_a_source_that_does_not_fit_is_refused_and_nothing_is_left(
    network: Any, tmp_path: Path, change: Any, message: str
) -> None:
    place = original_with(network, tmp_path, change)
    with pytest.raises(CheckpointError, match=message):
        truncate(place, tmp_path / "out", **KEPT)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["own", "vae"]


def test_a_torn_or_absent_file_is_named(source: Path, tmp_path: Path) -> None:
    file = sorted((source / "transformer_2").glob("*.safetensors"))[0]
    for damage_file in (lambda: file.write_bytes(file.read_bytes()[:-100]), file.unlink):
        damage_file()
        with pytest.raises(CheckpointError, match=file.name):
            truncate(source, tmp_path / "out", **KEPT)


def test_what_is_not_the_low_noise_expert_is_not_taken_for_it(source: Path, tmp_path: Path) -> None:
    shutil.rmtree(source / "transformer_2")
    with pytest.raises(CheckpointError, match="no transformer_2, the low-noise expert"):
        truncate(source, tmp_path / "out", **KEPT)
    # Of a Wan with one expert it is the right one.
    (source / "model_index.json").write_text("{}")
    truncate(source, tmp_path / "out", **KEPT)


def test_sources_of_another_kind_are_refused(source: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no Wan VACE weights"):
        truncate(tmp_path / "nowhere", tmp_path / "out", **KEPT)
    shutil.rmtree(source / "vae")
    with pytest.raises(CheckpointError, match="no VAE"):
        truncate(source, tmp_path / "out", **KEPT)
    tiny.vae().save_pretrained(tmp_path / "elsewhere")
    truncate(source, tmp_path / "out", vae=tmp_path / "elsewhere", **KEPT)
    config = source / "transformer_2" / "config.json"
    config.write_text(config.read_text().replace("WanVACETransformer3DModel", "FluxModel"))
    with pytest.raises(CheckpointError, match="a FluxModel; expected a WanVACE"):
        truncate(source, tmp_path / "other", vae=tmp_path / "elsewhere", **KEPT)


def test_impossible_numbers_of_blocks_are_refused(diffusers_source: Path, tmp_path: Path) -> None:
    for blocks in (0, 7):
        with pytest.raises(OptionError, match=f"blocks {blocks}; expected 1 to 6"):
            truncate(diffusers_source, tmp_path / "out", blocks=blocks)
    # They would be built for hours before anything is compared.
    for part, name in (("transformer", "num_layers"), ("vae", "num_res_blocks")):
        with pytest.raises(CheckpointError, match=f"{name} 100000000; expected at most 1000"):
            empty_network(part, {name: 10**8})


def test_a_full_disk_is_noticed_before_anything_is_written(diffusers_source, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1_000_000))
    with pytest.raises(ProjectError, match=r"0\.1 GB are needed, 0\.0 GB are free"):
        truncate(diffusers_source, tmp_path / "deep" / "out", **KEPT)
    assert not list(tmp_path.iterdir())


def test_what_fails_half_way_leaves_nothing_and_what_is_there_stays(
    diffusers_source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / ".out.part").mkdir()  # of an attempt that was killed
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copyfile", full)
        with pytest.raises(ProjectError, match="No space left"):
            truncate(diffusers_source, tmp_path / "out", **KEPT)
    assert not list(tmp_path.iterdir())
    (tmp_path / "out").mkdir()
    with pytest.raises(ProjectError, match="is there already"):
        truncate(diffusers_source, tmp_path / "out", **KEPT)


def test_loading_is_strict(truncated: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(truncated, tmp_path / "prior"))
    damage(folder / "transformer" / FILE, lambda t: t.pop("blocks.1.norm2.bias"))
    for read in (check_folder, lambda f: VideoPrior.from_pretrained(f, config=tiny.CONFIG)):
        with pytest.raises(CheckpointError, match=r"missing: blocks\.1\.norm2\.bias"):
            read(folder)
    (folder / "transformer" / "config.json").write_text("{]")
    with pytest.raises(CheckpointError, match=r"config\.json: cannot be read"):
        check_folder(folder)
    (folder / "transformer" / "config.json").unlink()
    with pytest.raises(CheckpointError, match=r"config\.json: cannot be read"):
        check_folder(folder)


def test_without_the_empty_prompt_it_says_how_to_make_it(truncated: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(truncated, tmp_path / "prior"))
    (folder / EMPTY_PROMPT).unlink()
    with pytest.raises(CheckpointError, match="gvtools weights empty-prompt WAN"):
        VideoPrior.from_pretrained(folder, config=tiny.CONFIG)
    with pytest.raises(CheckpointError, match=EMPTY_PROMPT):
        check_folder(folder)
    VideoPrior.from_pretrained(folder, config=replace(tiny.CONFIG, prompt="zeros"))
    check_folder(folder, prompt="zeros")
    save_file({"embedding": torch.zeros(1, 1, 20)}, folder / EMPTY_PROMPT)
    with pytest.raises(CheckpointError, match=r"expected \(tokens, channels\)"):
        VideoPrior.from_pretrained(folder, config=tiny.CONFIG)


def test_without_diffusers_the_extra_is_named(truncated, monkeypatch):
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(CheckpointError, match=r"pip install 'gvtools\[wan\]'"):
        VideoPrior.from_pretrained(truncated, config=tiny.CONFIG)


def test_the_empty_prompt_is_the_encoding_of_the_end_token(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers", reason="transformers is not installed")
    torch.manual_seed(0)
    sizes = {"vocab_size": 30, "d_model": tiny.TEXT, "d_kv": 4, "d_ff": 16, "num_heads": 2}
    encoder = transformers.UMT5EncoderModel(transformers.UMT5Config(num_layers=2, **sizes)).eval()
    encoder.save_pretrained(tmp_path / "text_encoder")
    write_empty_prompt(tmp_path / "text_encoder", tmp_path)
    # As Wan's pipelines run it: padded to a fixed length, the mask on the one token.
    tokens, mask = torch.zeros(1, 12, dtype=torch.long), torch.zeros(1, 12, dtype=torch.long)
    tokens[0, 0], mask[0, 0] = 1, 1
    with torch.no_grad():
        padded = encoder(tokens, attention_mask=mask).last_hidden_state[0, :1]
    torch.testing.assert_close(read_empty_prompt(tmp_path), padded, rtol=0, atol=1e-5)
    with pytest.raises(CheckpointError, match="no text encoder; expected models_t5"):
        write_empty_prompt(tmp_path / "absent", tmp_path)


def encoder_tensors(form: int, blocks: int = 2) -> dict[str, Tensor]:
    torch.manual_seed(0)
    width, inner, hidden = 12, 8, 10
    sizes = {
        "embedding": (5, width), "v": (inner, width), "o": (width, inner), "gate": (hidden, width),
        "in": (hidden, width), "out": (width, hidden),
    }  # fmt: skip
    tensors = {}
    for part, names in _TEXT.items():
        for block in range(blocks if "{}" in names[0] else 1):
            tensors[f"{names[form].format(block)}.weight"] = torch.randn(sizes.get(part, (width,)))
    return tensors


def encoded(stored: Mapping[str, Tensor], tokens: Tensor, blocks: int = 2) -> Tensor:
    """UMT5 over several tokens, by Wan's names, of which the first alone is seen; two heads."""

    def linear(x: Tensor, name: str) -> Tensor:
        return x @ stored[f"{name}.weight"].T

    def norm(x: Tensor, name: str) -> Tensor:
        scale = x.pow(2).mean(-1, keepdim=True).add(1e-6).rsqrt()
        return x * scale * stored[f"{name}.weight"]

    x = stored["token_embedding.weight"][tokens]
    seen = torch.full((len(tokens), len(tokens)), -torch.inf)
    seen[:, 0] = 0
    for block in range(blocks):
        start = f"blocks.{block}."
        y = norm(x, f"{start}norm1")
        q, k = torch.randn(2, 2, len(tokens), 4)
        share = (q @ k.mT + torch.randn(2, len(tokens), len(tokens)) + seen).softmax(-1)
        values = linear(y, f"{start}attn.v").unflatten(-1, (2, 4)).transpose(0, 1)
        x = x + linear((share @ values).transpose(0, 1).flatten(1), f"{start}attn.o")
        y = norm(x, f"{start}ffn".replace("ffn", "norm2"))
        z = linear(y, f"{start}ffn.gate.0")
        z = z / 2 * (1 + torch.tanh((2 / torch.pi) ** 0.5 * (z + 0.044715 * z**3)))
        x = x + linear(z * linear(y, f"{start}ffn.fc1"), f"{start}ffn.fc2")
    return norm(x, "norm")


@pytest.mark.parametrize("kind", ["file", "folder", "transformers"])
def test_the_empty_prompt_comes_of_wans_own_file(tmp_path: Path, kind: str) -> None:
    stored = encoder_tensors(int(kind == "transformers"))
    path = tmp_path / TEXT_FILE
    if kind == "transformers":
        save_file(stored, tmp_path / "model.safetensors")
    else:
        torch.save(stored, path)
    write_empty_prompt(path if kind == "file" else tmp_path, tmp_path)
    wanted = encoded(encoder_tensors(0), torch.tensor([1, 0, 0]))[:1]
    torch.testing.assert_close(read_empty_prompt(tmp_path), wanted, rtol=1e-5, atol=1e-5)
    if kind == "file":
        stored.pop("blocks.1.ffn.fc1.weight")
        torch.save(stored, path)
        with pytest.raises(CheckpointError, match=r"no blocks\.1\.ffn\.fc1\.weight"):
            write_empty_prompt(path, tmp_path)


def own_vae_names(names: list[str]) -> dict[str, str]:
    """Wan's own names of its VAE's tensors by diffusers', for two blocks a stage."""
    changes = {
        "mid_block.resnets.0": "middle.0", "mid_block.resnets.1": "middle.2",
        "mid_block.attentions.0": "middle.1", "norm_out": "head.0", "conv_out": "head.2",
        "quant_conv": "conv1", "down_blocks": "downsamples", "conv_in": "conv1",
    }  # fmt: skip
    parts = {
        "norm1": "residual.0", "conv1": "residual.2", "norm2": "residual.3", "conv2": "residual.6",
        "conv_shortcut": "shortcut",
    }  # fmt: skip
    found = {}
    for name in names:
        own = name
        if name.startswith("post_quant_conv"):
            own = name.replace("post_quant_conv", "conv2")
        elif "resnets" in name or "down_blocks" in name:
            for new, old in parts.items():
                own = own.replace(f".{new}.", f".{old}.")
        own = re.sub(
            r"up_blocks\.(\d)\.resnets\.(\d)",
            lambda m: f"upsamples.{4 * int(m[1]) + int(m[2])}", own,
        )  # fmt: skip
        own = re.sub(
            r"up_blocks\.(\d)\.upsamplers\.0", lambda m: f"upsamples.{4 * int(m[1]) + 3}", own
        )
        for new, old in changes.items():
            own = own.replace(new, old)
        found[name] = own
    return found


def test_wans_own_vae_file_is_the_vae_of_diffusers(network, tmp_path):
    torch.manual_seed(5)
    vae = network_class("vae")(base_dim=4, num_res_blocks=2).eval()
    state = vae.state_dict()
    names = own_vae_names(list(state))
    assert len(set(names.values())) == len(state)
    folder = save_original(network, tmp_path / "wan" / "low_noise_model")
    stored = {names[name]: tensor for name, tensor in state.items()}
    torch.save(stored, folder.parent / VAE_FILE)
    for number, given in enumerate((None, folder.parent / VAE_FILE)):
        truncate(folder.parent, tmp_path / f"out{number}", vae=given, **KEPT)
        loaded = load_network(tmp_path / f"out{number}", "vae").state_dict()
        assert loaded.keys() == state.keys()
        assert all(torch.equal(loaded[name], tensor) for name, tensor in state.items())
    stored.pop("conv2.bias")
    torch.save(stored, folder.parent / VAE_FILE)
    with pytest.raises(
        CheckpointError, match=r"Wan2\.1_VAE\.pth: .*missing: post_quant_conv\.bias"
    ):
        truncate(folder.parent, tmp_path / "none", **KEPT)
    assert not (tmp_path / "none").exists()
