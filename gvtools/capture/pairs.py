"""Which pictures are matched with which, where matching all with all would take too long."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

# Centres of the descriptor, features of a picture that it is made of, and rounds of k-means.
WORDS, FEATURES, ROUNDS = 32, 1000, 8
NEAREST = 20


def similar_pairs(
    described: Mapping[str, NDArray[np.float32]], *, nearest: int = NEAREST
) -> list[tuple[str, str]]:
    """Pairs of pictures whose features are alike, by a descriptor learnt from these pictures.

    Each picture is described by VLAD (Jegou et al. 2010): the sum of its features' differences from
    the nearest of WORDS centres, which k-means finds among all of them.

    Args:
        described: (N, D) unit descriptors of each picture's features; N may be 0.
        nearest: how many partners each picture gets; it may be chosen by more.
    """
    import cv2

    # In the order of names, so that pairs are chosen alike every time.
    names = sorted(name for name, rows in described.items() if len(rows))
    if len(names) < 2:
        return []
    features = [
        rows[np.linspace(0, len(rows) - 1, min(FEATURES, len(rows))).astype(int)]
        for rows in (described[name] for name in names)
    ]
    rng = np.random.default_rng(0)
    sample = np.concatenate([rows[rng.permutation(len(rows))[:200]] for rows in features])
    stop = (cv2.TERM_CRITERIA_MAX_ITER, ROUNDS, 0.0)
    cv2.setRNGSeed(0)
    words = min(WORDS, len(sample))
    labels = np.zeros((len(sample), 1), np.int32)
    _, _, centres = cv2.kmeans(sample, words, labels, stop, 1, cv2.KMEANS_PP_CENTERS)
    images = np.stack([vlad(rows, np.asarray(centres, np.float32)) for rows in features])
    alike = images @ images.T
    np.fill_diagonal(alike, -np.inf)
    pairs = set()
    for row, values in enumerate(alike):
        for column in np.argsort(-values)[: min(nearest, len(names) - 1)]:
            pairs.add((min(row, int(column)), max(row, int(column))))
    return sorted((names[a], names[b]) for a, b in pairs)


def sift_descriptors(database: Path) -> dict[str, NDArray[np.float32]]:
    """(N, 128) RootSIFT descriptors of each picture in COLMAP's database."""
    import pycolmap

    described = {}
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            rows = np.asarray(opened.read_descriptors(image.image_id).data, np.float32)
            rows = rows.reshape(-1, 128)
            rows = rows[np.linspace(0, len(rows) - 1, min(FEATURES, len(rows))).astype(int)]
            described[image.name] = np.sqrt(rows / np.maximum(rows.sum(1, keepdims=True), 1e-9))
    return described


def vlad(features: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.float32]:
    """(W * D,) unit descriptor of (N, D) features by (W, D) centres."""
    nearest = np.argmin((centres**2).sum(1) - 2 * features @ centres.T, axis=1)
    sums = np.zeros_like(centres)
    np.add.at(sums, nearest, features - centres[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    flat = sums.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-9)
