from __future__ import annotations

import shutil
import threading
import zlib
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import published_folder as published
import pytest
import torch
from geoverse_models import cameras
from PIL import Image
from shared_data import shared_folder
from tiny_scan import write_scan

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.weights import check_folder, config_of, from_pretrained
from gvtools.untrusted import sha256_of
from pipelines.cli import main
from pipelines.published import MODELS

ORACLE = shared_folder() / "oracle"
SIZE = (56, 70)
FILES = {
    published.GEOMETRY: ("da3_base", "", "model."),
    published.LEVEL1: ("gld_da3_level1", "ema", ""),
    published.CASCADE: ("gld_da3_cascade", "ema", ""),
    published.RGB_HEAD: ("gld_rgb_decoder", "ema", "decoder."),
}


def numbers(key: str, shape: tuple[int, ...]) -> torch.Tensor:
    """Weights of sensible sizes, the same for the same key."""
    generator = torch.Generator().manual_seed(zlib.crc32(key.encode()))
    values = torch.randn(shape, generator=generator)
    if not key.endswith(".W"):
        small = 0.02 if key.endswith(("bias", "token", "pos_embed")) else 0.1
        fan_in = float(np.prod(shape[1:])) ** -0.5 if len(shape) > 1 else small
        values = 1 + small * values if len(shape) == 1 and small == 0.1 else values * fan_in
    return values


def write_folder(folder: Path, dtype: torch.dtype = torch.half) -> None:
    for file, (keys, inside, start) in FILES.items():
        stored = {}
        for line in (ORACLE / "keys" / f"{keys}.txt").read_text(encoding="utf-8").splitlines():
            name, shape = line.split("\t")[:2]
            sides = tuple(int(side) for side in shape.strip("()").split(",") if side.strip())
            stored[name if name.startswith(start) else start + name] = numbers(name, sides).to(
                dtype
            )
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        if inside:
            torch.save({inside: stored}, path)
            continue
        once = {k: v for k, v in stored.items() if "output_conv2_aux." not in k or "_aux.0." in k
                or ".2." not in k.split("_aux.")[1]}  # fmt: skip
        published.save_file(once, path)
        head = {
            "decoder." + name.removeprefix("model.head."): tensor + 0.01
            for name, tensor in stored.items()
            if name.startswith("model.head.")
        }
        more = {"decoder.another.weight": torch.zeros(3), "encoder.cls_token": torch.zeros(3)}
        torch.save({"model": {**head, **more}}, folder / published.DPT_HEAD)
    for level, file in enumerate(published.STATISTICS):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        stored = {"mean": torch.zeros(1, 1536, 1, 1), "var": torch.ones(1, 1536, 1, 1)}
        torch.save({**stored, "count": 179_568_640, "level": level}, folder / file)


def views() -> ViewBatch:
    generator = torch.Generator().manual_seed(0)
    cams = cameras(3, size=SIZE)
    valid = torch.zeros(1, 3, 1, *SIZE, dtype=torch.bool)
    valid[:, :2] = True
    images = torch.rand(1, 3, 3, *SIZE, generator=generator) * valid
    pose, K = (torch.from_numpy(a)[None].float() for a in (cams.cam_from_world, cams.K))
    return ViewBatch(images, 2.0 * valid, valid, pose, K, 2)


@pytest.mark.slow
@pytest.mark.skipif(not (ORACLE / "keys").is_dir(), reason="no oracles beside the repository")
def test_the_published_layout_is_sampled_along_glds_own_schedule(tmp_path: Path):
    write_folder(tmp_path)
    assert config_of(tmp_path).name == "gld"
    parts = {part.name: part for part in check_folder(tmp_path)}
    assert all(part.ok for part in parts.values()), parts
    said = parts["geometry_head"].summary
    assert "unexpected, as its publisher's code lets pass: another.weight" in said
    assert "1 others in the file ignored" in said
    model = from_pretrained(tmp_path)
    assert model.geometry.head.scratch.output_conv1.bias is not None
    times: dict[str, list[float]] = {"level1": [], "cascade": []}
    for name, network in (("level1", model.level1), ("cascade", model.cascade)):
        assert network is not None
        network.register_forward_pre_hook(
            lambda _, given, kept=times[name]: kept.append(float(given[1].reshape(-1)[0]))
        )
    made = model.generate(views(), seed=1)
    grid = np.load(ORACLE / "gld_sampler.npz")["case0.out.time_grid"]
    assert len(grid) == 50
    for kept in times.values():
        # Without and with cameras in one batch.
        np.testing.assert_allclose(kept, grid[:-1], atol=1e-6)
    # Depth is the exponential of a number, which without training may be of any size.
    for tensor in (made.level1, made.level0, made.decoded.rgb):
        assert bool(tensor.isfinite().all())
    assert tuple(made.decoded.rgb.shape) == (1, 1, 3, *SIZE)


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.mark.slow
@pytest.mark.skipif(not (ORACLE / "keys").is_dir(), reason="no oracles beside the repository")
def test_from_a_server_to_a_picture_in_the_published_shapes(tmp_path, monkeypatch, capsys):
    """All of the commands, with random weights: 7.3 GB in float32, mapped."""
    there, here = tmp_path / "published", tmp_path / "gld"
    write_folder(there, torch.float32)
    files = []
    for file in MODELS["gld"]:
        path = there / file.place
        if not file.optional:
            size, sha256 = path.stat().st_size, sha256_of(path)
            # The layout's tensors are as many bytes as are published, but for what else files hold.
            assert size == pytest.approx(file.size, rel=0.01, abs=10_000), file.place
            files.append(replace(file, size=size, sha256=sha256, about=False, older={}))
    monkeypatch.setitem(MODELS, "gld", tuple(files))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(there))) as server:
        threading.Thread(target=server.serve_forever, args=[0.01], daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        assert main(["weights", "fetch", "gld", "--to", str(here), "--from", address]) == 0
        server.shutdown()
    shutil.rmtree(there)
    # Narrow, so that it is quick at the model's 504 pixels.
    Image.new("RGB", (2000, 50), "teal").save(tmp_path / "photo.png")
    assert main(["weights", "check", str(here), "--photo", str(tmp_path / "photo.png")]) == 0
    said = capsys.readouterr().out
    assert "gld: 6 files, 7.2" in said and "ok: true" in said and "self-check: photo.png" in said

    run = tmp_path / "run"
    words = ["reconstruct", str(write_scan(tmp_path / "scan")), "--out", str(run), "--quiet"]
    words += ["--context", "first:4", "--targets", "range:4-5", "--protocol", "paper"]
    for text in (f"weights={here}", "image_size=28", "steps=2", "cascade_steps=2", "device=cpu"):
        words += ["--set", f"completer.{text}"]
    assert main(words) == 0
    pictures = sorted(run.glob("round_*/generated_*.png"))
    assert len(pictures) == 2
    for path in pictures:
        assert np.asarray(Image.open(path)).std() > 0, path
