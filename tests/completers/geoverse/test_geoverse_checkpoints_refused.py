"""Files that hold something else, too little or too much are refused in one line."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import published_folder as published
import pytest
import torch
from geoverse_folders import refused, report
from published_folder import CASCADE, GEOMETRY, LEVEL1, RGB_HEAD, STATISTICS
from safetensors.torch import load_file, save_file
from torch import Tensor

from gvtools.completers.geoverse.weights import WHOLE_FILE, check_folder
from gvtools.errors import CheckpointError

pytestmark = pytest.mark.usefixtures("one_thread")


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
    "renamed": (lambda t: t.update(other=t.pop(LAYER)), f"missing: {LAYER}; unexpected: other"),
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
    "sparse": (lambda t: t.update({LAYER: t[LAYER].to_sparse()}), f"{LAYER} is sparse"),
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


def test_what_does_not_fit_is_listed_in_full(folder: Path) -> None:
    tensors_changed(folder / LEVEL1, DAMAGES["missing"][0])
    tensors_changed(folder / LEVEL1, lambda t: t.update(a=torch.zeros(1), b=torch.zeros(1)))
    found = report(folder, "level1").to_dict()
    assert found["missing"] == (LAYER, "blocks.1.attn.qkv.bias")
    assert found["unexpected"] == ("a", "b")
    assert (
        "missing: blocks.1.attn.qkv.weight and 1 more; unexpected: a and 1 more" in found["summary"]
    )
    json.dumps(found)


def test_a_name_that_is_there_twice_is_refused(folder: Path) -> None:
    tensors_changed(folder / LEVEL1, lambda t: t.update({f"module.{LAYER}": t[LAYER] + 1}))
    refused(folder, f"holds {LAYER} twice, also as module.{LAYER}")


def test_a_network_in_the_place_of_another_is_refused(folder: Path) -> None:
    shutil.copy(folder / CASCADE, folder / LEVEL1)
    refused(folder, r"da3_level1\.pt: .*missing: .*unexpected: ")
    shutil.copy(folder / LEVEL1, folder / RGB_HEAD)
    said = report(folder, "rgb_head").summary
    assert "missing: trainable_cls_token and 23 more" in said
    assert "others in the file ignored" in said


def test_statistics_of_the_other_level_are_refused(folder: Path) -> None:
    shutil.copy(folder / STATISTICS[1], folder / STATISTICS[0])
    refused(folder, r"level0\.pt: statistics of level 1; expected level 0")
    content = torch.load(folder / STATISTICS[1])
    torch.save({**content, "level": -3}, folder / STATISTICS[1])
    assert report(folder, "statistics1").ok
    torch.save({**content, "var": -content["var"]}, folder / STATISTICS[1])
    assert "negative" in report(folder, "statistics1").summary
    torch.save({"mean": content["mean"]}, folder / STATISTICS[1])
    assert "missing: var" in report(folder, "statistics1").summary


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
    from gvtools.networks.tensors import read_tensors

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
