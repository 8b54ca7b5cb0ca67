"""Saving a model: nothing half, nothing that could not be loaded, nothing rounded unasked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import geoverse_models as micro
import pytest
import torch
from geoverse_folders import PLAIN, equal, load
from safetensors.torch import load_file

from gvtools.completers.geoverse.weights import WHOLE_FILE, save_pretrained
from gvtools.errors import CheckpointError, GvError, ProjectError
from gvtools.networks.tensors import save_tensors

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_what_must_not_be_rounded_keeps_float32(dtype: str, tmp_path: Path) -> None:
    model = micro.model(PLAIN)
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
    assert (tmp_path / WHOLE_FILE).stat().st_size < 0.65 * sum(
        4 * t.numel() for t in state.values()
    )


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


def test_a_write_that_fails_leaves_the_earlier_model_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = micro.model(PLAIN)
    save_pretrained(model, tmp_path / "model")
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
    save_pretrained(micro.model(PLAIN), tmp_path)
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
    save_pretrained(model, own)
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
    save_tensors(tensors, tmp_path / "t.safetensors", about="x")
    found = load_file(tmp_path / "t.safetensors")
    assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items())


def test_saved_files_can_be_read_by_those_who_can_read_the_others(tmp_path: Path) -> None:
    save_pretrained(micro.model(PLAIN), tmp_path)
    modes = {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert len(modes) == 1
