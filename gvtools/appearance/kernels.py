"""Kernels of fitting: the gradient of the loss between two pictures, and Adam on some rows.

The gradient is rounded as it is written, without ``FAST``: with it, a kernel's last digits depended
on where arrays lay in memory, and a fit of a number of steps was not always the same.
"""

from __future__ import annotations

import math

import numpy as np

from gvtools.kernels import FAST, compiled

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
    """Blur one channel (H, W) by the window.

    Args:
        out: (H, W), written.
        work: (at least W + 12,) is overwritten.
    """
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

    Args:
        last: one past the last of them.
        picture: (C, H, W) float32.
        target: (C, H, W) float32, what it should be.
        weight: (H, W) of the pixels, 0 to 1.
        d_picture: (C, H, W), written.
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
    """One step of Adam (Kingma & Ba 2015) on some rows; the others stay as they are.

    Args:
        first: of ``rows``.
        last: one past the last of them.
        rows: (M,) numbers of the rows that have a gradient.
        gradients: (M, C).
        values: (N, at least C) float32, changed.
        moments: (2, N, at least C) running means of gradient and squared gradient, changed.
        rates: (C,) step length of each column.
        row_rates: (N,) factor of the first three columns, the positions.
        step: how many steps were made, this one included.
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
