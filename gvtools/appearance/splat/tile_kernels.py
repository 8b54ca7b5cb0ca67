"""Kernels that sort projected Gaussians into tiles, blend them there, and carry gradients back.

A picture is divided into tiles of 16 x 16 pixels, and a tile into blocks of 8 x 2 pixels whose
16 values lie together in memory, so that a vector unit takes a block at once. A pixel has the
colour sum_i w_i c_i, w_i = alpha_i prod_(j<i) (1 - alpha_j), over the Gaussians from front to back,
and a depth likewise.

alpha = opacity exp(-q / 2) falls to zero continuously: below 2 / 255 twice as fast, to zero at
1 / 255, where a Gaussian ends. (Without the ramp its border jumps, and gradients are wrong there.)
"""

from __future__ import annotations

import math

import numpy as np

from gvtools.appearance.splat.project_kernels import (
    BLUE,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    END,
    GREEN,
    LEAST_ALPHA,
    OPACITY,
    RADIUS_X,
    RADIUS_Y,
    RED,
    SUMS,
    X,
    Y,
)  # fmt: skip
from gvtools.kernels import FAST, compiled

TILE = 16
PIXELS = TILE * TILE
# A block's width, height and size [px], and how many of them are side by side and in a tile.
BLOCK_WIDTH, BLOCK_HEIGHT, BLOCK = 8, 2, 16
HALVES, BLOCK_ROWS = TILE // BLOCK_WIDTH, TILE // BLOCK_HEIGHT
BLOCKS = HALVES * BLOCK_ROWS
# Pixels that let less light through than this are finished.
OPAQUE = 1e-4
MOST_ALPHA = 0.99
# Finished pixels are looked for after so many Gaussians.
LOOK_EVERY = 16


@compiled(inline="always")
def _tile_columns(row, tile_row, tiles_x):
    """First and last + 1 tile that the Gaussian's ellipse touches in a row of tiles."""
    # The ellipse in dy from top to bottom of the row; its extreme x is at dy = -(B / C) dx.
    low = tile_row * TILE + 0.5 - row[Y]
    high = low + (TILE - 1)
    low, high = max(low, -row[RADIUS_Y]), min(high, row[RADIUS_Y])
    if low > high:
        return 0, 0
    A, B, C, q = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY], 2 * row[END]
    radius = row[RADIUS_X]
    extreme = -B / C * radius
    left, right = radius, radius
    if not low <= extreme <= high:
        dy = low if extreme < low else high
        right = (-B * dy + math.sqrt(max((B * B - A * C) * dy * dy + A * q, 0))) / A
    if not low <= -extreme <= high:
        dy = low if -extreme < low else high
        left = (B * dy + math.sqrt(max((B * B - A * C) * dy * dy + A * q, 0))) / A
    # A pixel more on either side, for rounding.
    first = math.floor((row[X] - left - 1) / TILE)
    last = math.floor((row[X] + right + 1) / TILE) + 1
    return max(first, 0), min(last, tiles_x)


@compiled(error_model="numpy")
def count_tiles(first, last, bounds, seen, depth_part, projected, tiles_x, tiles_y, pairs, counts):
    """Count each Gaussian's tiles, and each tile's Gaussians, for the parts ``first`` to ``last``.

    Part p holds the places ``bounds[p]`` to ``bounds[p + 1]`` of ``seen``; ``depth_part``: the part
    that each falls into when they are ordered by depth. ``pairs`` (len(seen),) is written,
    ``counts`` (parts of ``seen``, parts by depth, tiles) added to.
    """
    for part in range(first, last):
        for j in range(bounds[part], bounds[part + 1]):
            row = projected[seen[j]]
            count = counts[part, depth_part[j]]
            top = max(math.floor((row[Y] - row[RADIUS_Y]) / TILE), 0)
            bottom = min(math.floor((row[Y] + row[RADIUS_Y]) / TILE) + 1, tiles_y)
            total = 0
            for tile_row in range(top, bottom):
                left, right = _tile_columns(row, tile_row, tiles_x)
                for tile in range(tile_row * tiles_x + left, tile_row * tiles_x + right):
                    count[tile] += 1
                total += max(right - left, 0)
            pairs[j] = total


@compiled(error_model="numpy")
def fill_tiles(
    first, last, bounds, nearest, seen, projected, tiles_x, tiles_y, starts, place, lists
):
    """Write the tiles' lists: each Gaussian's number and the row of its gradient sums.

    ``bounds`` are those of parts of ``nearest``, places in ``seen``, nearest first; ``starts``:
    where the rows of each Gaussian of ``seen`` begin; ``place`` (parts, tiles): where each part's
    Gaussians begin in each tile's list, advanced. Of ``lists`` (pairs, 3) the first two columns are
    written.
    """
    for part in range(first, last):
        for j in range(bounds[part], bounds[part + 1]):
            place_seen = nearest[j]
            number = seen[place_seen]
            row = projected[number]
            top = max(math.floor((row[Y] - row[RADIUS_Y]) / TILE), 0)
            bottom = min(math.floor((row[Y] + row[RADIUS_Y]) / TILE) + 1, tiles_y)
            pair = starts[place_seen]
            for tile_row in range(top, bottom):
                left, right = _tile_columns(row, tile_row, tiles_x)
                for tile in range(tile_row * tiles_x + left, tile_row * tiles_x + right):
                    at = place[part, tile]
                    lists[at, 0] = number
                    lists[at, 1] = pair
                    place[part, tile] = at + 1
                    pair += 1


@compiled(error_model="numpy", fastmath=FAST)
def blend_tiles(first, last, tiles, tiles_x, offsets, lists, blocks, projected, image, used, faint):
    """Blend the tiles ``tiles[first:last]`` from front to back.

    ``lists`` (pairs, 3) of a tile begin at its ``offsets``; the last column is written, how many
    blocks of the tile each touches, and to ``blocks`` (pairs,) their numbers, four bits each.
    ``image`` (5, H, W): red, green, blue, depth (weighted sums) and alpha; ``used`` (tiles,): how
    many Gaussians a tile looked at. The gradient leaves out blocks whose 16 pixels together got
    less light than ``faint``.
    """
    dtype = projected.dtype.type
    zero, one, two, most = dtype(0), dtype(1), dtype(2), dtype(MOST_ALPHA)
    least2, half = dtype(2 * LEAST_ALPHA), dtype(0.5)
    e1, e2, e3, e4, e5 = (
        dtype(-1 / 8), dtype(1 / 128), dtype(-1 / 3072), dtype(1 / 98304), dtype(-1 / 3932160)
    )  # fmt: skip
    height, width = image.shape[1], image.shape[2]
    acc = np.empty(5 * PIXELS, projected.dtype)
    eight, opaque, faint = dtype(BLOCK_WIDTH), dtype(OPAQUE), dtype(faint)
    for at in range(first, last):
        tile = tiles[at]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        acc[: 4 * PIXELS] = zero
        acc[4 * PIXELS :] = one
        k, end = offsets[tile], offsets[tile + 1]
        while k < end:
            if (k - offsets[tile]) % LOOK_EVERY == LOOK_EVERY - 1:
                clearest = zero
                for p in range(4 * PIXELS, 5 * PIXELS):
                    clearest = max(clearest, acc[p])
                if clearest < opaque:
                    break
            row = projected[lists[k, 0]]
            A, B, C = half * row[CONIC_XX], row[CONIC_XY], half * row[CONIC_YY]
            opacity, limit = row[OPACITY], row[END]
            red, green, blue, depth = row[RED], row[GREEN], row[BLUE], row[DEPTH]
            u, v = row[X] - dtype(left) - half, row[Y] - dtype(top) - half
            a = max(math.floor((u - row[RADIUS_X]) / eight), 0)
            b = min(math.floor((u + row[RADIUS_X]) / eight) + 1, HALVES)
            c = max(math.floor((v - row[RADIUS_Y]) / two), 0)
            d = min(math.floor((v + row[RADIUS_Y]) / two) + 1, BLOCK_ROWS)
            numbers, count = 0, 0
            for part in range(a, b):
                x0 = dtype(part * BLOCK_WIDTH) - u
                for block in range(c, d):
                    y0 = dtype(block * BLOCK_HEIGHT) - v
                    number = part * BLOCK_ROWS + block
                    received = zero
                    # A view, since an index that may be negative keeps loops from vectorising.
                    pixels = acc[number * BLOCK :]
                    for j in range(BLOCK):
                        ex, ey = dtype(j & 7) + x0, dtype(j >> 3) + y0
                        p = (A * ex + B * ey) * ex + C * ey * ey
                        e = one + p * (e1 + p * (e2 + p * (e3 + p * (e4 + p * e5))))
                        e = e * e
                        e = e * e
                        alpha = opacity * (e * e)
                        ramp = two * alpha - least2
                        alpha = alpha if alpha < ramp else ramp
                        alpha = alpha if alpha < most else most
                        alpha = alpha if alpha > zero else zero
                        alpha = alpha if p < limit else zero
                        t = pixels[4 * PIXELS + j]
                        w = alpha * t
                        pixels[j] += w * red
                        pixels[PIXELS + j] += w * green
                        pixels[2 * PIXELS + j] += w * blue
                        pixels[3 * PIXELS + j] += w * depth
                        pixels[4 * PIXELS + j] = t - w
                        received += w
                    # Blocks that got no light from it need no look at its gradient.
                    if received > faint:
                        numbers |= number << (4 * count)
                        count += 1
            lists[k, 2] = count
            blocks[k] = numbers
            k += 1
        used[tile] = k - offsets[tile]
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                i, j = x - left, y - top
                q = (i // 8 * BLOCK_ROWS + j // 2) * BLOCK + j % 2 * 8 + i % 8
                for channel in range(4):
                    image[channel, y, x] = acc[channel * PIXELS + q]
                image[4, y, x] = one - acc[4 * PIXELS + q]


@compiled(error_model="numpy", fastmath=FAST)
def backward_tiles(
    first, last, tiles, tiles_x, offsets, lists, blocks, projected, image, used, d_image, sums
):
    """Gradient sums of each Gaussian in each of the tiles ``tiles[first:last]``.

    By ``d_image`` (5, H, W), to ``sums`` (pairs, SUMS), see project_kernels. The other arguments
    are those of ``blend_tiles``.
    """
    dtype = projected.dtype.type
    zero, one, two, most = dtype(0), dtype(1), dtype(2), dtype(MOST_ALPHA)
    least2, half = dtype(2 * LEAST_ALPHA), dtype(0.5)
    e1, e2, e3, e4, e5 = (
        dtype(-1 / 8), dtype(1 / 128), dtype(-1 / 3072), dtype(1 / 98304), dtype(-1 / 3932160)
    )  # fmt: skip
    height, width = image.shape[1], image.shape[2]
    # Transmittance, what the Gaussians behind add to the loss's gradient, and the five gradients.
    acc = np.empty(7 * PIXELS, projected.dtype)
    lanes = np.empty(SUMS * BLOCK, projected.dtype)
    for at in range(first, last):
        tile = tiles[at]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        acc[:] = zero
        acc[:PIXELS] = one
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                i, j = x - left, y - top
                q = (i // 8 * BLOCK_ROWS + j // 2) * BLOCK + j % 2 * 8 + i % 8
                for channel in range(5):
                    g = d_image[channel, y, x]
                    acc[(2 + channel) * PIXELS + q] = g
                    acc[PIXELS + q] += g * image[channel, y, x]
        stop = offsets[tile] + used[tile]
        for k in range(stop, offsets[tile + 1]):
            for s in range(SUMS):
                sums[lists[k, 1], s] = zero
        for k in range(offsets[tile], stop):
            row = projected[lists[k, 0]]
            A, B, C = half * row[CONIC_XX], row[CONIC_XY], half * row[CONIC_YY]
            opacity, limit = row[OPACITY], row[END]
            red, green, blue, depth = row[RED], row[GREEN], row[BLUE], row[DEPTH]
            lanes[:] = zero
            numbers = blocks[k]
            for _ in range(lists[k, 2]):
                number = numbers & 15
                numbers >>= 4
                u = row[X] - dtype(left + number // BLOCK_ROWS * BLOCK_WIDTH) - half
                v = row[Y] - dtype(top + number % BLOCK_ROWS * BLOCK_HEIGHT) - half
                # A view, since an index that may be negative keeps loops from vectorising.
                pixels = acc[number * BLOCK :]
                for j in range(BLOCK):
                    dx, dy = dtype(j & 7) - u, dtype(j >> 3) - v
                    p = (A * dx + B * dy) * dx + C * dy * dy
                    e = one + p * (e1 + p * (e2 + p * (e3 + p * (e4 + p * e5))))
                    e = e * e
                    e = e * e
                    raw = opacity * (e * e)
                    ramp = two * raw - least2
                    alpha = raw if raw < ramp else ramp
                    alpha = alpha if alpha < most else most
                    alpha = alpha if alpha > zero else zero
                    alpha = alpha if p < limit else zero
                    # d alpha / d log(raw)
                    slope = raw if raw > least2 else two * raw
                    slope = slope if alpha > zero else zero
                    slope = slope if alpha < most else zero
                    t = pixels[j]
                    w = alpha * t
                    g0, g1 = pixels[2 * PIXELS + j], pixels[3 * PIXELS + j]
                    g2, g3 = pixels[4 * PIXELS + j], pixels[5 * PIXELS + j]
                    along = g0 * red + g1 * green + g2 * blue + g3 * depth
                    along += pixels[6 * PIXELS + j]
                    behind = pixels[PIXELS + j] - w * along
                    pixels[PIXELS + j] = behind
                    pixels[j] = t - w
                    g = slope * (t * along - behind / (one - alpha))
                    gx, gy = g * dx, g * dy
                    lanes[j] += w * g0
                    lanes[16 + j] += w * g1
                    lanes[32 + j] += w * g2
                    lanes[48 + j] += w * g3
                    lanes[64 + j] += g
                    lanes[80 + j] += gx
                    lanes[96 + j] += gy
                    lanes[112 + j] += gx * dx
                    lanes[128 + j] += gx * dy
                    lanes[144 + j] += gy * dy
            out = sums[lists[k, 1]]
            for s in range(SUMS):
                total = zero
                for j in range(BLOCK):
                    total += lanes[s * BLOCK + j]
                out[s] = total


# The surface is the first Gaussian after which less than this share of the light is left.
HALF = 0.5


@compiled(error_model="numpy")
def median_tiles(first, last, tiles, tiles_x, offsets, lists, projected, depth):
    """Write the median depth (H, W) of the tiles ``tiles[first:last]``; see blend_tiles."""
    height, width = depth.shape
    for at in range(first, last):
        tile = tiles[at]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                light = 1.0
                for k in range(offsets[tile], offsets[tile + 1]):
                    row = projected[lists[k, 0]]
                    dx, dy = x + 0.5 - row[X], y + 0.5 - row[Y]
                    q = 0.5 * (row[CONIC_XX] * dx * dx + row[CONIC_YY] * dy * dy)
                    q += row[CONIC_XY] * dx * dy
                    if q < row[END]:
                        # As in blend_tiles: falls to zero twice as fast near LEAST_ALPHA.
                        alpha = row[OPACITY] * math.exp(-q)
                        alpha = min(alpha, 2 * alpha - 2 * LEAST_ALPHA, MOST_ALPHA)
                        light *= 1 - max(alpha, 0)
                        if light < HALF:
                            depth[y, x] = row[DEPTH]
                            break
