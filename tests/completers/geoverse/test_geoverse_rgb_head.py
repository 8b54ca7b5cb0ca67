from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from gvtools.completers.geoverse.rgb_head import RGBHead, RGBHeadConfig, sine_table
from gvtools.networks.depth_anything.encoder import IMAGENET_MEAN, IMAGENET_STD

SMALL = RGBHeadConfig(
    in_channels=20, width=16, depth=2, heads=2, mlp=24, patch=4, base_grid=(3, 5), eps=1e-12
)


def head(config: RGBHeadConfig = SMALL, *, seed: int = 0) -> RGBHead:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        module = RGBHead(config)
        nn.init.normal_(module.trainable_cls_token)
        for parameter in module.parameters():
            if parameter.ndim == 1:
                nn.init.normal_(parameter, mean=0.5, std=0.3)
    return module.double().eval()


def features(views: int, grid: tuple[int, int], *, seed: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    shape = (views, grid[0] * grid[1], SMALL.in_channels)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def test_the_layers_are_torchs_pre_norm_encoder_layers():
    module = head()
    x = features(3, SMALL.base_grid)
    ours = module.logits(x, SMALL.base_grid)
    y = module.decoder_embed(x)
    y = torch.cat((module.trainable_cls_token.expand(3, -1, -1), y), 1) + module.decoder_pos_embed
    for layer in module.decoder_layers:
        theirs = nn.TransformerEncoderLayer(
            SMALL.width, SMALL.heads, SMALL.mlp, dropout=0.0, activation="gelu",
            layer_norm_eps=SMALL.eps, batch_first=True, norm_first=True,
        ).double()  # fmt: skip
        own = layer.state_dict()
        part = {
            name: torch.cat(
                [own[f"attention.attention.{k}.{name}"] for k in ("query", "key", "value")]
            )
            for name in ("weight", "bias")
        }
        theirs.load_state_dict(
            {f"self_attn.in_proj_{name}": value for name, value in part.items()}
            | {
                f"{there}.{name}": own[f"{here}.{name}"]
                for there, here in (
                    ("self_attn.out_proj", "attention.output.dense"),
                    ("linear1", "intermediate.dense"),
                    ("linear2", "output.dense"),
                    ("norm1", "layernorm_before"),
                    ("norm2", "layernorm_after"),
                )
                for name in ("weight", "bias")
            }
        )
        y = theirs(y)
    theirs_logits = module.decoder_pred(module.decoder_norm(y)[:, 1:])
    torch.testing.assert_close(ours, theirs_logits, rtol=1e-9, atol=1e-9)


def test_pixels_go_where_their_patch_lies():
    module, grid, patch = head(), (2, 3), SMALL.patch
    logits = torch.randn(2, 6, patch * patch * 3, dtype=torch.float64)
    found = module.image(logits, grid).numpy()
    assert found.shape == (2, 3, 2 * patch, 3 * patch)
    for view, c, y, x in np.ndindex(found.shape):
        token = (y // patch) * 3 + x // patch
        channel = ((y % patch) * patch + x % patch) * 3 + c
        expected = logits[view, token, channel].item() * IMAGENET_STD[c] + IMAGENET_MEAN[c]
        assert found[view, c, y, x] == pytest.approx(expected)


def test_the_sine_table_in_closed_form():
    width, (rows, columns) = 16, (3, 5)
    found = sine_table(width, (rows, columns)).numpy()
    assert found.dtype == np.float32 and not found[0].any()
    for y, x, i in np.ndindex(rows, columns, width // 4):
        row = found[1 + y * columns + x]
        rate = 10000 ** (-i / (width // 4))
        expected = [f(p * rate) for p in (x, y) for f in (np.sin, np.cos)]
        np.testing.assert_allclose(row[i :: width // 4], expected, atol=1e-7)


def test_the_table_is_the_constructors_and_is_saved_but_not_trained():
    module = RGBHead(SMALL)
    assert "decoder_pos_embed" in module.state_dict()
    assert "decoder_pos_embed" not in dict(module.named_parameters())
    assert module.positions(SMALL.base_grid) is module.decoder_pos_embed
    other = module.positions((6, 10))
    assert other.shape == (1, 61, SMALL.width)
    torch.testing.assert_close(other[:, 0], module.decoder_pos_embed[:, 0])
    # Twice the grid: the mean over 2 x 2 cells is near the table (bicubic, so not exactly).
    fine = other[0, 1:].unflatten(0, (3, 2, 5, 2)).mean(dim=(1, 3))[1:-1, 1:-1]
    table = module.decoder_pos_embed[0, 1:].unflatten(0, (3, 5))[1:-1, 1:-1]
    torch.testing.assert_close(fine, table, rtol=0, atol=0.1)


@pytest.mark.parametrize("chunk", [1, 2, 5])
def test_chunks_change_neither_pictures_nor_gradients(chunk):
    module, grid = head(), (4, 3)
    results = []
    for options in ({}, {"chunk": chunk}):
        x = features(3, grid).requires_grad_()
        image = module(x, grid, **options)
        image.square().sum().backward()
        weight = module.decoder_embed.weight.grad
        assert weight is not None
        results.append((image.detach(), x.grad, weight.clone()))
        module.zero_grad()
    for whole, parts in zip(*results, strict=True):
        torch.testing.assert_close(parts, whole)
