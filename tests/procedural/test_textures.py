from __future__ import annotations

import numpy as np

from gvtools.procedural import furnished_room as materials
from gvtools.procedural.render import decode_srgb, encode_srgb
from gvtools.procedural.textures import (
    LONGEST,
    PHOTOGRAPHS,
    SIDE,
    level_starts,
    photograph,
    photograph_names,
    picture,
    stack_levels,
)


def test_splits_share_no_photograph() -> None:
    train, held_out = (PHOTOGRAPHS[split] for split in ("train", "held-out"))
    assert not set(train) & set(held_out)
    thumbnails = {
        name: np.sort(photograph(name).reshape(-1, 3).mean(1))[:: photograph(name).size // 300][
            :100
        ]
        for split in PHOTOGRAPHS
        for name in photograph_names(split)
    }
    for a in photograph_names("train"):
        for b in photograph_names("held-out"):
            assert not np.array_equal(thumbnails[a], thumbnails[b])


def test_photographs_of_installed_wheels_alone() -> None:
    for split in PHOTOGRAPHS:
        names = photograph_names(split)
        assert len(names) >= 6
        for name in names:
            image = photograph(name)
            assert image.dtype == np.uint8 and image.shape[2] == 3
            assert max(image.shape) <= LONGEST and image.std() > 5


def test_pictures_are_neither_black_nor_blank() -> None:
    rng = np.random.default_rng(0)
    images = [picture(rng, photograph_names("train")) for _ in range(60)]
    assert all(image.shape == (SIDE, SIDE, 3) and image.dtype == np.uint8 for image in images)
    assert np.median([image.mean() for image in images]) > 60
    assert np.mean([image.std() > 8 for image in images]) > 0.9


def test_levels_are_block_means_in_linear_light() -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, SIDE, SIDE, 3), np.uint8)
    texels = stack_levels(list(images))
    linear = decode_srgb(images).astype(np.float64)
    starts = level_starts(SIDE)
    for level in range(len(starts) - 1):
        side = SIDE >> level
        block = 1 << level
        expected = linear.reshape(2, side, block, side, block, 3).mean((2, 4))
        found = texels[:, starts[level] : starts[level + 1]].reshape(2, side, side, 3)
        np.testing.assert_allclose(found, expected, atol=2e-6)


def test_room_materials_have_their_colour_and_size() -> None:
    rng = np.random.default_rng(0)
    color = (0.5, 0.6, 0.7)
    for image in (materials.paint(color), materials.tiled("brick", color)):
        np.testing.assert_allclose(image.mean((0, 1)) / 255, color, atol=0.03)
    boards = materials.planks(color, rng)
    assert boards.std() > materials.paint(color).std()
    for image in (boards, materials.globe("moon"), materials.picture("rocket")[0]):
        assert image.shape == (materials.SIDE, materials.SIDE, 3) and image.dtype == np.uint8


def test_colour_codes_round_trip_below_the_roll_off() -> None:
    codes = np.arange(0, 215, dtype=np.uint8)
    np.testing.assert_array_equal(encode_srgb(decode_srgb(codes)), codes)
    bright = encode_srgb(np.linspace(0.6, 5, 50).astype(np.float32))
    assert (np.diff(bright.astype(int)) >= 0).all()
