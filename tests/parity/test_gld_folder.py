from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import published_folder as published
import pytest
import torch
from geoverse_models import cameras
from shared_data import shared_folder

from gvtools.completers.geoverse.conditioning import ViewBatch
from gvtools.completers.geoverse.weights import check_folder, config_of, from_pretrained

ORACLE = shared_folder() / "oracle"
SIZE = (56, 70)
FILES = {
    published.GEOMETRY: ("da3_base", "", "model."),
    published.LEVEL1: ("gld_da3_level1", "ema", ""),
    published.CASCADE: ("gld_da3_cascade", "ema", ""),
    published.RGB_HEAD: ("gld_rgb_decoder", "ema", "decoder."),
}


def numbers(key: str, shape: tuple[int, ...]) -> torch.Tensor:
    """Half-precision weights of sensible sizes, the same for the same key."""
    generator = torch.Generator().manual_seed(zlib.crc32(key.encode()))
    values = torch.randn(shape, generator=generator)
    if not key.endswith(".W"):
        small = 0.02 if key.endswith(("bias", "token", "pos_embed")) else 0.1
        fan_in = float(np.prod(shape[1:])) ** -0.5 if len(shape) > 1 else small
        values = 1 + small * values if len(shape) == 1 and small == 0.1 else values * fan_in
    return values.half()


def write_folder(folder: Path) -> None:
    for file, (keys, inside, start) in FILES.items():
        stored = {}
        for line in (ORACLE / "keys" / f"{keys}.txt").read_text(encoding="utf-8").splitlines():
            name, shape = line.split("\t")[:2]
            sides = tuple(int(side) for side in shape.strip("()").split(",") if side.strip())
            stored[name if name.startswith(start) else start + name] = numbers(name, sides)
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
