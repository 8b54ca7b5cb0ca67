"""Kernels of fitting: gradients of the losses of a picture, and Adam on some rows.

Gradients are rounded as they are written, without ``FAST``: with it, a kernel's last digits
depended on where arrays lay in memory, and a fit of a number of steps was not always the same.

Bending: where photographs say nothing of depth, surfaces should bend little. Inverse depth of a
plane is linear in the picture, so what is made small is its second difference from pixel to pixel,
less so where the photograph has edges, at which surfaces end.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gvtools.kernels import FAST, compiled
from gvtools.poses.refinement import ReducedView

# SSIM (Wang et al. 2004): a Gaussian window of 11 pixels with standard deviation 1.5, zero outside
# the picture, and its two constants for colours from 0 to 1.
WINDOW = 11
HALF = WINDOW // 2
C1, C2 = 0.01**2, 0.03**2
_WEIGHTS = np.exp(-0.5 * ((np.arange(WINDOW) - HALF) / 1.5) ** 2)
# Ended by a tap that weighs nothing, so that four can be taken at a time.
WEIGHTS = np.append(_WEIGHTS / _WEIGHTS.sum(), 0).astype(np.float32)


@compiled(inline="always")
def _add_four(line, lines, k):
    """Add four weighted rows to ``line``, from tap ``k`` on."""
    w0, w1, w2, w3 = WEIGHTS[k], WEIGHTS[k + 1], WEIGHTS[k + 2], WEIGHTS[k + 3]
    a, b, c, d = lines
    for x in range(len(line)):
        line[x] += w0 * a[x] + w1 * b[x] + w2 * c[x] + w3 * d[x]


@compiled()
def blur(picture, out, work):
    """Blur one channel (H, W) by the window; ``work`` (at least W + 12,) is overwritten."""
    height, width = picture.shape
    work[:] = np.float32(0)
    line = work[HALF : HALF + width]
    for y in range(height):
        line[:] = np.float32(0)
        for k in range(0, WINDOW, 4):
            # Rows outside of the picture are black.
            at = y + k - HALF
            if at >= 0 and at + 3 < height:
                rows = (picture[at], picture[at + 1], picture[at + 2], picture[at + 3])
                _add_four(line, rows, k)
            else:
                for row in range(max(at, 0), min(at + 4, height)):
                    weight, source = WEIGHTS[k + row - at], picture[row]
                    for x in range(width):
                        line[x] += weight * source[x]
        result = out[y]
        result[:] = np.float32(0)
        for k in range(0, WINDOW, 4):
            shifted = (work[k:], work[k + 1 :], work[k + 2 :], work[k + 3 :])
            _add_four(result, shifted, k)


@compiled()
def loss_gradient(first, last, picture, target, weight, share, d_picture):
    """Gradient of (1 - share) mean |picture - target| + share (1 - SSIM), by channels.

    Pictures are (C, H, W), ``weight`` of the pixels (H, W), 0 to 1; ``d_picture`` is written.
    """
    one, two = np.float32(1), np.float32(2)
    c1, c2 = np.float32(C1), np.float32(C2)
    channels, height, width = picture.shape[0], picture.shape[1], picture.shape[2]
    scale = np.float32(1 / (channels * height * width))
    k1, k2 = np.float32(1 - share) * scale, -np.float32(share) * scale
    work, product = np.empty(width + WINDOW + 1, np.float32), np.empty_like(target[0])
    m, xx, xy = np.empty_like(target[0]), np.empty_like(target[0]), np.empty_like(target[0])
    mean, square = np.empty_like(target[0]), np.empty_like(target[0])
    for c in range(first, last):
        x, y = picture[c], target[c]
        blur(x, m, work)
        blur(y, mean, work)
        for i in range(height):
            for j in range(width):
                product[i, j] = x[i, j] * x[i, j]
        blur(product, xx, work)
        for i in range(height):
            for j in range(width):
                product[i, j] = x[i, j] * y[i, j]
        blur(product, xy, work)
        for i in range(height):
            for j in range(width):
                product[i, j] = y[i, j] * y[i, j]
        blur(product, square, work)
        for i in range(height):
            for j in range(width):
                u, v = m[i, j], mean[i, j]
                a1 = two * u * v + c1
                a2 = two * (xy[i, j] - u * v) + c2
                b1 = u * u + v * v + c1
                b2 = xx[i, j] - u * u + square[i, j] - v * v + c2
                inverse = one / (b1 * b2)
                ssim = a1 * a2 * inverse
                w = weight[i, j]
                by_square, by_product = -w * ssim / b2, w * two * a1 * inverse
                m[i, j] = (
                    w * two * (v * a2 * inverse - u * ssim / b1)
                    - two * u * by_square - v * by_product
                )  # fmt: skip
                xx[i, j], xy[i, j] = by_square, by_product
        blur(m, product, work)
        blur(xx, m, work)
        blur(xy, xx, work)
        for i in range(height):
            for j in range(width):
                difference = x[i, j] - y[i, j]
                w = weight[i, j]
                sign = w if difference > 0 else (-w if difference < 0 else np.float32(0))
                smooth = product[i, j] + two * x[i, j] * m[i, j] + y[i, j] * xx[i, j]
                d_picture[c, i, j] = k1 * sign + k2 * smooth


@compiled(fastmath=FAST)
def adam_rows(first, last, rows, gradients, values, moments, rates, row_rates, step):
    """One step of Adam (Kingma & Ba 2015), number ``step``, on some ``rows`` (M,) of ``values``.

    ``gradients`` (M, C); ``moments`` (2, N, at least C) are running means of gradient and squared
    gradient; ``rates`` (C,) step lengths of columns, ``row_rates`` (N,) factors of the first three,
    the positions.
    """
    short, long, tiny = np.float32(0.9), np.float32(0.999), np.float32(1e-15)
    rest_short, rest_long = np.float32(0.1), np.float32(0.001)
    c1 = np.float32(1 / (1 - 0.9**step))
    c2 = np.float32(1 / (1 - 0.999**step))
    columns = gradients.shape[1]
    rate = np.empty(columns, np.float32)
    for j in range(first, last):
        i = rows[j]
        g, p, m, v = gradients[j], values[i], moments[0, i], moments[1, i]
        rate[:] = rates[:columns]
        for k in range(3):
            rate[k] *= row_rates[i]
        for k in range(columns):
            a = short * m[k] + rest_short * g[k]
            b = long * v[k] + rest_long * g[k] * g[k]
            m[k], v[k] = a, b
            p[k] -= rate[k] * (a * c1) / (math.sqrt(b * c2) + tiny)


# Weight of depth that a network estimated, and the relative error that is tolerated. Tested with
# depth of a fit to all photographs, with smooth errors added: fits of three and seven photographs
# gain 0.4 dB by it with errors of 2 %, 0.2 dB with 5 %, nothing with 10 %.
ESTIMATE, ESTIMATE_TOLERANCE = 0.3, 0.03


def add_depth(
    image: NDArray[np.float32], view: ReducedView, gradient: NDArray[np.float32], *, weight: float
) -> None:
    """Add the gradient of |D - A d| / d over the pixels with depth d to (5, H, W).

    D is the image's depth times alpha and A its alpha, so opaque pixels should have D = d. Where an
    estimate stands for recorded depth, the loss is quadratic within its tolerance and pulls less.
    ``image``: see ``Splat``.
    """
    depth = view.estimate if view.depth is None else view.depth
    if depth is None:
        return
    known = depth > 0
    d = np.where(known, depth, np.float32(1))
    missed = image[3] - image[4] * d
    if view.depth is None:
        weight = ESTIMATE
        pull = np.clip(missed / (d * np.float32(ESTIMATE_TOLERANCE)), -1, 1)
    else:
        pull = np.sign(missed)
    pull = pull * known * view.weight
    gradient[3:] += weight * np.stack([pull / d, -pull])


# Inverse depth, in shares of its median, may bend by so much before the loss grows more slowly:
# from there on linearly, before as its square.
SOFT = 0.002
# Where a colour from 0 to 1 changes by 1 / EDGE, the loss counts 37 %.
EDGE = 10.0
# Pixels below this alpha have no surface.
LEAST_ALPHA = 0.5


def add_bending(
    image: NDArray[np.float32],
    target: NDArray[np.float32],
    gradient: NDArray[np.float32],
    *,
    weight: float,
) -> None:
    """Add the gradient of the bending of surfaces, summed over the picture, to (5, H, W).

    ``image`` (5, H, W), see ``Splat``; ``target`` (3, H, W), the photograph.
    """
    some = image[3:, ::4, ::4]
    solid = some[1] > LEAST_ALPHA
    if solid.any():
        median = np.median(some[0][solid] / some[1][solid])
        inverse = np.empty_like(image[4])
        pull = np.empty_like(inverse)
        bending_gradient(image, target, np.float32(median), np.float32(weight), inverse, pull,
                         gradient)  # fmt: skip


@compiled()
def bending_gradient(image, target, median, weight, inverse, pull, gradient):
    """See ``add_bending``; ``inverse`` and ``pull`` (H, W) are overwritten."""
    zero, one, two, soft = np.float32(0), np.float32(1), np.float32(2), np.float32(1 / SOFT)
    edge = np.float32(EDGE / 3)
    least = np.float32(LEAST_ALPHA)
    height, width = inverse.shape
    for y in range(height):
        for x in range(width):
            a = image[4, y, x]
            inverse[y, x] = median * a / image[3, y, x] if a > least else zero
    pull[:] = zero
    for dy, dx in ((0, 1), (1, 0)):
        for y in range(dy, height - dy):
            for x in range(dx, width - dx):
                here = inverse[y, x]
                before, after = inverse[y - dy, x - dx], inverse[y + dy, x + dx]
                if before > 0 and here > 0 and after > 0:
                    change = zero
                    for c in range(3):
                        middle = target[c, y, x]
                        change += abs(target[c, y - dy, x - dx] - middle)
                        change += abs(target[c, y + dy, x + dx] - middle)
                    bend = (before - two * here + after) * soft
                    g = min(max(bend, -one), one) * math.exp(-edge * change)
                    pull[y - dy, x - dx] += g
                    pull[y, x] -= two * g
                    pull[y + dy, x + dx] += g
    for y in range(height):
        for x in range(width):
            if inverse[y, x] > 0:
                # Inverse depth is median alpha / (depth alpha).
                g = weight * pull[y, x] * inverse[y, x]
                gradient[3, y, x] -= g / image[3, y, x]
                gradient[4, y, x] += g / image[4, y, x]
