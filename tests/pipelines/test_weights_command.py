"""``gvtools weights`` and ``completers``, whose figures stand in the pages that they name."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import geoverse_models as micro
import published_folder as published
import pytest
import torch
from command_line import refused
from PIL import Image
from safetensors.torch import load_file, save_file

from gvtools.completers import base
from gvtools.completers.base import Completer, available, completer_type
from gvtools.completers.geoverse import from_pretrained
from gvtools.completers.geoverse.weights import WHOLE_FILE, save_pretrained
from gvtools.networks.config_json import to_json
from gvtools.untrusted import sha256_of
from pipelines.cli import main
from pipelines.published import MODELS, Published

pytestmark = pytest.mark.usefixtures("one_thread")

PLAIN = micro.config()


def weights(*arguments: object) -> int:
    return main(["weights", *map(str, arguments)])


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be changed."""
    folder = tmp_path_factory.mktemp("own")
    save_pretrained(micro.model(PLAIN), folder)
    return folder


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files as they are published, without the network that turns depth into a condition."""
    bare = replace(PLAIN, level1=replace(PLAIN.level1, depth_condition=False))
    return published.write_published(micro.model(bare), tmp_path_factory.mktemp("published"))


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "published"))


@pytest.fixture
def micro_file(tmp_path: Path) -> Path:
    path = tmp_path / "micro.json"
    path.write_text(json.dumps(to_json(PLAIN)))
    return path


# Tensors and numbers of the official networks; safetensors keep six shared names less. Sizes as the
# publisher states them are 0.5, 3.0, 1.8 and 1.6 GB.
PUBLISHED = {
    "pretrained_models/da3/model.safetensors": "541 MB, 437 tensors, 135,366,599 numbers",
    "checkpoints/da3_level1.pt": "3.13 GB, 430 tensors, 783,326,716 numbers",
    "checkpoints/da3_cascade.pt": "1.89 GB, 378 tensors, 472,541,268 numbers",
    "pretrained_models/mae_decoder.pt": "1.69 GB, 456 tensors, 422,536,396 numbers",
    "model_stats/da3/normalization_stats_level0.pt": "12.3 kB, 2 tensors, 3,072 numbers",
    "model_stats/da3/normalization_stats_level1.pt": "12.3 kB, 2 tensors, 3,072 numbers",
    "pretrained_models/da3/dpt_decoder.pt": "optional, 470 MB, ",
}


def test_published_files_have_their_published_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    assert weights("list", "base") == 0
    lines = capsys.readouterr().out.splitlines()
    for path, figures in PUBLISHED.items():
        place = lines.index(f"  {path}")
        assert lines[place + 1].startswith(f"      {figures}")
        assert lines[place + 3].startswith("      from ")
    assert f"  {WHOLE_FILE}" in lines
    assert "  video/" in lines


def test_depth_alone_and_gld_are_listed_with_their_steps(capsys):
    assert weights("list", "depth") == 0
    text = capsys.readouterr().out
    # The official network of DA3-LARGE has 643 tensors of these many numbers.
    for line in (
        "DA3-SMALL, model.safetensors: 137 MB, 34,299,463 numbers, Apache-2.0",
        "DA3-BASE, model.safetensors: 541 MB, 135,366,599 numbers, Apache-2.0",
        "DA3-LARGE-1.1, model.safetensors: 1.64 GB, 410,941,767 numbers, CC BY-NC 4.0",
        "step 2: gvtools reconstruct PROJECT --depth da3 --set da3.weights=DIR --out RUN",
    ):
        assert line in text
    assert weights("list", "gld") == 0
    text = capsys.readouterr().out
    assert all(f"  {path}\n" in text for path in PUBLISHED)
    assert "video/" not in text
    assert "step 2: gvtools weights check DIR" in text
    assert "--completer geoverse --set completer.weights=DIR" in text


def test_the_list_is_readable(capsys: pytest.CaptureFixture[str], micro_file: Path) -> None:
    assert weights("list", micro_file) == 0
    text = capsys.readouterr().out
    assert text.startswith("micro: nothing of its size is published")
    assert WHOLE_FILE in text
    assert weights("list", "tiny", "--quiet") == 0
    assert weights("--quiet", "list", "tiny") == 0
    assert main(["weights", "--quiet", "list", "tiny"]) == 0
    assert capsys.readouterr().out == ""


def test_a_folder_that_fits(capsys: pytest.CaptureFixture[str], own: Path, tmp_path: Path) -> None:
    assert weights("check", own) == 0
    text = capsys.readouterr().out
    assert "geoverse  ok (geoverse.safetensors, " in text
    assert text.endswith("ok: true\n")
    assert weights("check", own, "--json", tmp_path / "check.json") == 0
    found = json.loads((tmp_path / "check.json").read_text())
    assert found["ok"] is True
    assert found["config"] == "micro"
    assert found["problem"] is None
    (part,) = found["parts"]
    assert part["parameters"] == sum(t.numel() for t in load_file(own / WHOLE_FILE).values())
    assert part["missing"] == part["unexpected"] == part["shape_mismatch"] == []


def test_what_does_not_fit_is_said_for_each_part(capsys, folder, tmp_path):
    assert weights("check", folder) == 0
    assert "absent: pretrained_models/da3/dpt_decoder.pt" in capsys.readouterr().out
    (folder / published.CASCADE).unlink()
    content = torch.load(folder / published.LEVEL1)["ema"]
    content["blocks.0.qkv"] = content.pop("blocks.0.attn.qkv.weight")
    torch.save({"ema": content}, folder / published.LEVEL1)
    assert weights("check", folder, "--json", tmp_path / "check.json") == 2
    line = capsys.readouterr().err.strip()
    assert "2 of 7 parts cannot be loaded, first " in line
    assert "da3_level1.pt: of 94 tensors missing: blocks.0.attn.qkv.weight; unexpected: " in line
    found = json.loads((tmp_path / "check.json").read_text())
    assert found["ok"] is False
    assert found["problem"] in line
    parts = {part["name"]: part for part in found["parts"]}
    assert parts["level1"]["missing"] == ["blocks.0.attn.qkv.weight"]
    assert parts["level1"]["unexpected"] == ["blocks.0.qkv"]
    assert parts["cascade"]["path"] is None
    assert not parts["cascade"]["ok"]
    assert parts["rgb_head"]["ignored"] == ["encoder.mask"]
    assert [name for name, part in parts.items() if part["ok"]] == [
        "geometry", "rgb_head", "statistics0", "statistics1", "geometry_head",
    ]  # fmt: skip
    assert weights("check", folder) == 2
    text = capsys.readouterr().out
    assert "cascade        does not fit: neither" in text
    assert text.endswith("ok: false\n")


def test_the_configuration_may_be_another_than_the_folders(capsys, own, micro_file):
    assert weights("check", own, "--config", micro_file, "--quiet") == 0
    assert weights("check", own, "--config", own, "--quiet") == 0
    line = refused(capsys, "weights", "check", own, "--config", "tiny", "--quiet")
    assert "missing: " in line
    assert "of another shape: " in line


def test_a_photograph_is_encoded_and_decoded(capsys, own, tmp_path, monkeypatch):
    assert weights("check", own) == 0
    text = capsys.readouterr().out
    (line,) = [line for line in text.splitlines() if line.startswith("self-check")]
    assert "astronaut.png encoded and decoded, PSNR " in line and "GLD" not in line
    Image.new("RGB", (60, 40), (128, 128, 128)).save(tmp_path / "grey.png")
    assert weights("check", own, "--photo", tmp_path / "grey.png") == 0
    assert "grey.png encoded" in capsys.readouterr().out
    assert "no such file" in refused(capsys, "weights", "check", own, "--photo", tmp_path / "none")
    monkeypatch.setattr("pipelines.weights.of_published_size", lambda config: True)
    assert weights("check", own) == 0
    assert "GLD states 35 dB of its files: the files are damaged" in capsys.readouterr().err
    monkeypatch.setattr(micro.GeoVerse, "reconstruct", lambda model, picture: picture)
    assert weights("check", own) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_published_files_are_packed_into_one(capsys, folder, tmp_path, dtype):
    (folder / "video" / "vae").mkdir(parents=True)
    (folder / "video" / "vae" / "numbers").write_bytes(b"1234")
    words = ("weights", "pack", folder, tmp_path / "out", "--dtype", dtype)
    assert "name Wan's text encoder with --text-encoder" in refused(capsys, *words)
    assert not (tmp_path / "out").exists()
    embedding = torch.randn(3, 5)
    torch.save({"token_embedding.weight": embedding, "norm.weight": torch.ones(5)}, tmp_path / "t5")
    assert main([str(word) for word in (*words, "--text-encoder", tmp_path / "t5")]) == 0
    packed, whole = (from_pretrained(place).state_dict() for place in (tmp_path / "out", folder))
    buffers = {name for name, _ in from_pretrained(folder).named_buffers()}
    for name, tensor in whole.items():
        exact = name in buffers or name.endswith(".t_embedder.W")
        kept = tensor if exact else tensor.to(getattr(torch, dtype)).float()
        assert torch.equal(packed[name], kept), name
    prompt = load_file(tmp_path / "out" / "video" / "empty_prompt.safetensors")["embedding"]
    wanted = embedding[1] / embedding[1].square().mean().add(1e-6).sqrt()
    torch.testing.assert_close(prompt, wanted[None])
    assert (tmp_path / "out" / "video" / "vae" / "numbers").read_bytes() == b"1234"
    assert not (folder / "video" / "empty_prompt.safetensors").exists()
    assert weights("check", tmp_path / "out") == 0
    again = ("weights", "pack", tmp_path / "out", tmp_path / "again", "--text-encoder", "t5")
    assert "that lacks empty_prompt.safetensors; leave it out" in refused(capsys, *again)
    assert "lies within" in refused(capsys, "weights", "pack", folder, folder / "packed")


def test_an_older_revision_is_named(capsys, folder, monkeypatch):
    path = folder / published.LEVEL1
    monkeypatch.setattr("pipelines.weights.of_published_size", lambda config: True)
    monkeypatch.setattr(micro.GeoVerse, "reconstruct", lambda model, picture: picture)
    for older in ({sha256_of(path): "of another camera convention"}, {}):
        file = Published(published.LEVEL1.as_posix(), "", "", path.stat().st_size, "0" * 64,
                         older=older)  # fmt: skip
        monkeypatch.setitem(MODELS, "gld", (file,))
        assert weights("check", folder) == 0
        said = "is an older revision (of another camera" if older else "is of sha256 "
        assert f"{path}: {said}" in capsys.readouterr().err


def test_a_folder_that_is_none(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    report = tmp_path / "check.json"
    line = refused(capsys, "weights", "check", tmp_path / "absent", "--json", report)
    assert "absent does not exist" in line
    found = json.loads(report.read_text())
    assert found["ok"] is False
    assert found["problem"] in line
    assert "neither config.json nor a published file" in refused(
        capsys, "weights", "check", tmp_path
    )


def test_a_created_model_is_untrained_and_its_seeds_own(capsys, tmp_path, micro_file):
    state = torch.get_rng_state()
    for folder, seed in (("a", 0), ("b", 0), ("c", 1)):
        assert weights("create", micro_file, tmp_path / folder, "--seed", seed) == 0
    assert torch.equal(torch.get_rng_state(), state)
    assert "UNTRAINED" in capsys.readouterr().out
    files = [(tmp_path / folder / WHOLE_FILE).read_bytes() for folder in "ab"]
    assert files[0] == files[1]
    a, c = (from_pretrained(tmp_path / folder) for folder in "ac")
    name = "geometry.backbone.pretrained.patch_embed.proj.weight"
    assert not torch.equal(a.state_dict()[name], c.state_dict()[name])
    assert a.config == replace(PLAIN, trained=False)
    assert weights("check", tmp_path / "c") == 0
    # Such a model runs.
    assert torch.isfinite(a.generate(micro.batch()).decoded.rgb).all()


def test_nothing_is_overwritten(capsys, own, micro_file, tmp_path):
    before = {path: path.read_bytes() for path in own.iterdir()}
    assert "nothing is overwritten" in refused(capsys, "weights", "create", micro_file, own)
    assert {path: path.read_bytes() for path in own.iterdir()} == before
    assert "nothing is overwritten" in refused(capsys, "weights", "create", micro_file, micro_file)
    (tmp_path / "new" / "video").mkdir(parents=True)
    assert weights("create", micro_file, tmp_path / "new") == 0
    assert "'huge'" in refused(capsys, "weights", "create", "huge", tmp_path / "huge")
    assert not (tmp_path / "huge").exists()


def test_a_created_model_says_that_its_training_needs_the_video_prior(capsys, tmp_path):
    path = tmp_path / "control.json"
    path.write_text(json.dumps(to_json(micro.config(injection="control"))))
    assert weights("create", path, tmp_path / "model") == 0
    assert f"truncate-wan SOURCE {tmp_path / 'model' / 'video'}" in capsys.readouterr().out
    assert weights("check", tmp_path / "model") == 0
    assert "before the branch that takes its features is trained" in capsys.readouterr().out


def test_the_video_prior_is_cut_and_completed(capsys, tmp_path):
    pytest.importorskip("diffusers", reason="the extra wan is not installed")
    import tiny_wan

    source, folder = tmp_path / "wan", tmp_path / "model"
    tiny_wan.transformer(6, (0, 2, 4)).save_pretrained(source / "transformer")
    tiny_wan.vae().save_pretrained(source / "vae")
    config = micro.config(injection="control", video=tiny_wan.CONFIG)
    save_pretrained(micro.model(config), folder)
    video = folder / "video"
    assert weights("truncate-wan", source, video, "--blocks", 4) == 0
    text = capsys.readouterr().out
    size = sum(path.stat().st_size for path in video.rglob("*.safetensors")) / 1e3
    assert f"of {size:.3g} kB written" in text or "kB written" in text
    assert f"gvtools weights empty-prompt TEXT_ENCODER {video}" in text
    assert json.loads((video / "transformer" / "config.json").read_text())["num_layers"] == 4
    assert "is there already" in refused(capsys, "weights", "truncate-wan", source, video)
    assert "empty_prompt.safetensors is absent" in refused(
        capsys, "weights", "check", folder, "--quiet"
    )
    assert "no folder" in refused(capsys, "weights", "empty-prompt", tmp_path, tmp_path / "absent")
    line = refused(capsys, "weights", "empty-prompt", tmp_path / "absent", video)
    assert "transformers" in line
    save_file({"embedding": tiny_wan.prompt()}, video / "empty_prompt.safetensors")
    assert "nothing is overwritten" in refused(capsys, "weights", "empty-prompt", tmp_path, video)
    assert weights("check", folder) == 0
    assert "video     ok (video, " in capsys.readouterr().out
    assert from_pretrained(folder, video=True).video is not None
    shutil.rmtree(video / "vae")
    assert "vae" in refused(capsys, "weights", "check", folder, "--quiet")


ROOT = Path(__file__).parents[2]
FACTS = [(name, facts) for name in available() for facts in completer_type(name).facts]
# Rows of the table "Four domains", by the completer that they are of; seconds of the core alone.
ROWS = {"inpaint": ("inpaint", "inpaint"), "geoverse": ("geoverse", "without its refiner")}


@pytest.mark.parametrize(("name", "facts"), FACTS, ids=[f"{n} {f.of}" for n, f in FACTS])
def test_figures_are_those_of_their_page(name, facts):
    if not facts.source:
        assert not re.search(r"\d", facts.cost + facts.gives)
        return
    file, section = facts.source.partition(" (")[0].split(", ")
    text = (ROOT / file).read_text(encoding="utf-8").split(f"## {section}\n")[1].split("\n## ")[0]
    if section != "Four domains":
        assert "1,034" in facts.cost and "**1,034**" in text and "Peak memory 20.4 GiB" in text
        return
    lines = [line for line in text.split("\nDifferences")[0].splitlines() if line[:2] == "| "]
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    judged, timed = ROWS[name]
    sets = ("procedural rooms", "hand-made levels", "recorded depth", "photographs: fern")
    found = [
        next(row for row in rows if row[0].startswith(one) and row[1] == judged) for one in sets
    ]
    time = [
        next(row for row in rows if row[0].startswith(sets[at]) and row[1] == timed)
        for at in (0, 2)
    ]
    assert re.findall(r"(\d\.\d+) s", facts.cost) == [row[9].strip(" |") for row in time]
    psnr, depth = facts.gives.split(";")
    assert re.findall(r"\d+\.\d+", psnr) == [row[3] for row in found]
    assert re.findall(r"\d+\.\d+", depth) == [row[5] for row in found[:3]]


def test_the_list_has_each_completer_and_ones_own(capsys, monkeypatch, tmp_path):
    class Mine(Completer):
        name = "mine"

    monkeypatch.setattr(base, "_REGISTRY", {**base._REGISTRY, "mine": Mine})
    assert main(["completers", "--json", str(tmp_path / "list.json")]) == 0
    said = capsys.readouterr().out
    for name in ("none: ", "inpaint: ", "geoverse, the model that ships: ", "mine: of your own"):
        assert f"\n{name}" in f"\n{said}"
    written = json.loads((tmp_path / "list.json").read_text())
    assert [entry["name"] for entry in written["completers"]] == [name for name, _ in FACTS]
    assert written["without_figures"] == ["mine"]
