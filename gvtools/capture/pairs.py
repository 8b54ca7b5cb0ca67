"""Which pictures are matched with which, where matching all with all would take too long."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pycolmap

# Centres of the descriptor, features of a picture that it is made of, and rounds of k-means.
WORDS, FEATURES, ROUNDS = 32, 1000, 8
NEAREST = 20


def similar_pairs(database: Path, *, nearest: int = NEAREST) -> list[tuple[str, str]]:
    """Pairs of pictures whose features are alike, by a descriptor learnt from these pictures.

    Each picture is described by VLAD (Jegou et al. 2010): the sum of its SIFT descriptors'
    differences from the nearest of WORDS centres, which k-means finds among all of them.

    Args:
        database: of COLMAP, with features.
        nearest: how many partners each picture gets; it may be chosen by more.
    """
    import cv2
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        names, features = _features(opened)
    rng = np.random.default_rng(0)
    sample = np.concatenate([rows[rng.permutation(len(rows))[:200]] for rows in features])
    stop = (cv2.TERM_CRITERIA_MAX_ITER, ROUNDS, 0.0)
    cv2.setRNGSeed(0)
    words = min(WORDS, len(sample))
    labels = np.zeros((len(sample), 1), np.int32)
    _, _, centres = cv2.kmeans(sample, words, labels, stop, 1, cv2.KMEANS_PP_CENTERS)
    described = np.stack([vlad(rows, np.asarray(centres, np.float32)) for rows in features])
    alike = described @ described.T
    np.fill_diagonal(alike, -np.inf)
    pairs = set()
    for row, values in enumerate(alike):
        for column in np.argsort(-values)[: min(nearest, len(names) - 1)]:
            pairs.add((min(row, int(column)), max(row, int(column))))
    found = [sorted((names[a], names[b])) for a, b in pairs]
    return sorted((first, second) for first, second in found)


def _features(
    database: pycolmap.Database,
) -> tuple[list[str], list[NDArray[np.float32]]]:
    """Names and RootSIFT descriptors of the pictures that have any."""
    names, features = [], []
    # In the order of their names: that of the database depends on threads.
    for image in sorted(database.read_all_images(), key=lambda image: image.name):
        rows = np.asarray(database.read_descriptors(image.image_id).data, np.float32)
        if len(rows) == 0:
            continue
        rows = rows[np.linspace(0, len(rows) - 1, min(FEATURES, len(rows))).astype(int)]
        rows = np.sqrt(rows / np.maximum(rows.sum(1, keepdims=True), 1e-9))
        names.append(image.name)
        features.append(rows)
    return names, features


def vlad(features: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.float32]:
    """(W * D,) unit descriptor of (N, D) features by (W, D) centres."""
    nearest = np.argmin((centres**2).sum(1) - 2 * features @ centres.T, axis=1)
    sums = np.zeros_like(centres)
    np.add.at(sums, nearest, features - centres[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    flat = sums.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-9)
