"""The paper's loss formulas, pixel by pixel in numpy float64, for one sample. Slow on purpose."""

from __future__ import annotations

import numpy as np

SOBEL_X = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]], float)
DELTA = 1e-6


def flow_matching(predicted, clean, noise, alpha) -> float:
    """Eq. supp_flow_loss without its expectation: (V, C, h, w), alpha of each view."""
    total = 0.0
    for j in range(len(predicted)):
        total += alpha[j] * sum(
            (predicted[j][i] - (noise[j][i] - clean[j][i])) ** 2
            for i in np.ndindex(predicted[j].shape)
        )
    return total


def sobel(gray, valid) -> np.ndarray:
    """Gradient magnitude (H, W); neighbours outside the picture repeat its border."""
    height, width = gray.shape
    out = np.zeros((height, width))
    for r, c in np.ndindex(height, width):
        if not valid[r, c]:
            continue
        x = y = 0.0
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                n = min(max(r + dr, 0), height - 1), min(max(c + dc, 0), width - 1)
                value = gray[n] if valid[n] else gray[r, c]
                x += SOBEL_X[dr + 1, dc + 1] * value
                y += SOBEL_X.T[dr + 1, dc + 1] * value
        out[r, c] = (x**2 + y**2) ** 0.5
    return out


def weights(image, valid) -> np.ndarray:
    """w_j(p) (T, H, W) of pictures (T, 3, H, W)."""
    gray = 0.299 * image[:, 0] + 0.587 * image[:, 1] + 0.114 * image[:, 2]
    g = np.stack([sobel(gray[j], valid[j]) for j in range(len(image))])
    out = np.zeros(g.shape)
    if valid.any():
        low, high = np.quantile(g[valid], (0.5, 0.98))
        for p in zip(*np.nonzero(valid), strict=True):
            out[p] = min(max((g[p] - low) / (high - low + DELTA), 0), 1)
    return out


def rgb(predicted, image, valid) -> float:
    """Eq. supp_rgb_loss: (T, 3, H, W), valid (T, H, W)."""
    total, count = 0.0, 0
    for j, r, c in zip(*np.nonzero(valid), strict=True):
        total += sum(abs(predicted[j, k, r, c] - image[j, k, r, c]) for k in range(3)) / 3
        count += 1
    return total / max(1, count)


def high_gradient(predicted, image, valid) -> float:
    """Eq. supp_hf_loss."""
    w = weights(image, valid)
    total, normaliser = 0.0, 0.0
    for j, r, c in zip(*np.nonzero(valid), strict=True):
        error = sum(abs(predicted[j, k, r, c] - image[j, k, r, c]) for k in range(3)) / 3
        total += w[j, r, c] * error
        normaliser += w[j, r, c]
    return total / max(DELTA, normaliser)


def scale_of(predicted, reference) -> float:
    """s* of Eq. supp_camera_alignment over (V, 3) centres, by the SVD of the cross-covariance."""
    x, y = predicted - predicted.mean(axis=0), reference - reference.mean(axis=0)
    u, d, vt = np.linalg.svd(y.T @ x)
    d[2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return float(d.sum() / (x**2).sum())


def depth(predicted, reference, scale, valid=None) -> float:
    """Eq. supp_depth_loss: (T, H, W)."""
    total, count = 0.0, 0
    for p in np.ndindex(reference.shape):
        usable = np.isfinite(reference[p]) and reference[p] > 0
        if usable and (valid is None or valid[p]):
            total += abs(scale * predicted[p] - reference[p])
            count += 1
    return total / max(1, count)
