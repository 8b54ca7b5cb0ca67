from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from matplotlib import colormaps
from PIL import Image

from viz.plots.canvas import SKY, rgb_of
from viz.report import pictures as sheets

RNG = np.random.default_rng(0)


def opened(tile: sheets.Thumbnail) -> Image.Image:
    kind, data = tile.uri.split(";base64,")
    image = Image.open(io.BytesIO(base64.b64decode(data)))
    assert kind == f"data:image/{str(image.format).lower()}"
    assert image.size == (tile.width, tile.height)
    return image.convert("RGB")


def pictures(height: int = 300, width: int = 400, **more) -> sheets.TargetPictures:
    x = np.linspace(0, 255, width)
    rgb = np.broadcast_to(x[None, :, None], (height, width, 3)).astype(np.uint8)
    left = np.broadcast_to(np.arange(width) < width // 2, (height, width))
    return sheets.TargetPictures(
        "view", hint=rgb, observed=left, supported=left, completion=rgb, **more
    )  # fmt: skip


def test_the_error_map_is_the_mean_absolute_difference():
    picture = RNG.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    truth = RNG.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    level = np.abs(picture / 255 - truth / 255).mean(axis=2) / sheets.WORST
    expected = colormaps[sheets.ERROR_MAP](np.clip(level, 0, 1))[..., :3] * 255
    # A step of the map's 256 colours.
    assert np.abs(sheets.error_map(picture, truth) - expected).max() < 5
    assert (sheets.error_map(picture, picture) == sheets.error_map(picture, picture)[0, 0]).all()


def test_what_the_mask_leaves_out_is_grey():
    picture = np.zeros((4, 4, 3), np.uint8)
    mask = np.zeros((4, 4), bool)
    mask[0] = True
    shown = sheets.error_map(picture, picture + 255, mask=mask)
    assert (shown[1:] == 128).all()
    assert shown[0, 0, 0] > 200


def test_observed_generated_and_holes_have_a_colour_each():
    observed = np.array([[True, True, False, False]])
    supported = np.array([[True, True, True, False]])
    scanned = np.array([[False, True, False, False]])
    shown = sheets.support_map(observed, supported, scanned)[0]
    assert ["#" + bytes(pixel.tolist()).hex() for pixel in shown] == [
        color.lower() for color in sheets.SUPPORT.values()
    ]


def test_the_tiles_stand_in_order_and_hold_the_pictures():
    white = np.full((30, 20, 3), 255, np.uint8)
    truth = pictures().completion
    tiles = sheets.contact_row(pictures(truth=truth, context=white, context_name="given"), side=200)
    assert [tile.label for tile in tiles] == [
        "context", "hint", "validity", "completion", "truth", "error"
    ]  # fmt: skip
    shown = {tile.label: np.asarray(opened(tile)) for tile in tiles}
    assert shown["context"].shape == (30, 20, 3)
    assert shown["hint"].shape == (150, 200, 3)
    assert np.diff(shown["completion"][75, :, 0].astype(int)).mean() == pytest.approx(1.28, abs=0.1)
    assert shown["error"].max() < 20
    left, right = shown["validity"][0, 0], shown["validity"][0, -1]
    assert "#" + bytes(left.tolist()).hex() == sheets.SUPPORT["observed"].lower()
    assert "#" + bytes(right.tolist()).hex() == sheets.SUPPORT["hole"]
    assert "50% observed" in tiles[2].alt
    assert "given" in tiles[0].alt


COLOR = list(rgb_of(SKY))
WIDTH, HEIGHT = 64, 48


def view(**changes) -> sheets.JudgedView:
    truth = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    never = np.zeros((HEIGHT, WIDTH), bool)
    never[10:30, 20:40] = True
    pictures = {"exact": truth, "bright": np.full_like(truth, 250), "absent": None}
    fields = {"truth": truth, "mask": None, "never_observed": never, "pictures": pictures}
    return sheets.JudgedView(name="view", **{**fields, **changes})


def tiles(canvas: np.ndarray, line: int) -> list[np.ndarray]:
    """The tiles of a line of the sheet: truth and three methods."""
    top = sheets.LETTERS + sheets.GAP + line * (HEIGHT + sheets.GAP)
    lefts = [sheets.GAP + column * (WIDTH + sheets.GAP) for column in range(4)]
    return [canvas[top : top + HEIGHT, left : left + WIDTH] for left in lefts]


def test_a_view_has_truth_pictures_and_error_maps_below_its_methods():
    canvas = sheets.method_sheet([view()])
    truth, exact, bright, absent = tiles(canvas, 0)
    assert (exact == 100).all()
    assert (bright == 250).all()
    assert (absent == sheets.MISSING).all()
    assert (truth == 100).all()
    dimmed, exact_error, bright_error, absent_error = tiles(canvas, 1)
    assert (dimmed[10:30, 20:40] == 100).all()
    assert dimmed.astype(int).sum() == 3 * (100 * 400 + 20 * (WIDTH * HEIGHT - 400))
    rim = (exact_error == COLOR).all(axis=2)
    assert rim[10:12, 20:40].all()
    assert rim[10:30, 38:40].all()
    assert rim.sum() == 20 * 20 - 16 * 16
    inside = exact_error[13:27, 23:37]
    assert (inside == inside[0, 0]).all()
    assert inside.max() < 10
    # Off by more than the brightest difference.
    assert bright_error[0, 0].sum() > 600
    assert (bright_error == COLOR).all(axis=2).sum() == rim.sum()
    assert (absent_error == sheets.MISSING).all()


def test_without_truth_there_are_no_error_maps():
    with_truth, without = (sheets.method_sheet([one]) for one in (view(), view(truth=None)))
    assert with_truth.shape[0] - without.shape[0] == HEIGHT + sheets.GAP
