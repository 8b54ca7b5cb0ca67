"""3D Gaussians as SPZ, version 3: Niantic's format, a tenth of the PLY's size; also read.

A gzip stream of a header and one array after the other: positions (24-bit fixed point), opacities,
colours and logarithms of sizes (8 bits each), rotations (32 bits: the three smallest components and
which one is missing), and harmonics (8 bits, of which 5 count at degree 1 and 4 above).
https://github.com/nianticlabs/spz describes it. Its axes are right, up, back: Gaussians are turned
half around x, and its readers turn them back where theirs are right, down, forward, as a PLY's.
"""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.splat.project_kernels import (
    LOG_SCALE,
    LOGIT,
    QUATERNION,
    SH,
    VALUES,
)
from gvtools.appearance.turning import turned
from gvtools.errors import MemoryFileError
from gvtools.files import replaced_when_written
from gvtools.untrusted import read_bytes, unpack_gzip
from pipelines.export.source import ExportOptions, Source
from pipelines.export.splats import Splats, splats_of

MAGIC, VERSION = 0x5053474E, 3
# What may be unpacked: so many bytes for each of the file's, which harmonics of zeros need, and so
# many more. In RAM a Gaussian takes several times what it does there.
MOST_RATIO, MOST_BYTES = 16, 1 << 22
# Header: magic, version, count, degree of the harmonics, fractional bits, flags, reserved.
HEADER = struct.Struct("<IIIBBBB")
# From right, down, forward to right, up, back.
TO_RUB = np.diag([1.0, -1.0, -1.0])
# Bits of a coordinate with its sign, and the most of them behind the point that readers take.
BITS, MOST_FRACTIONAL = 24, 23
# Steps of positions in a small Gaussian's least standard deviation; smaller ones are this share.
STEPS_PER_SIZE, SMALLEST = 8, 0.05
# Colours are stored as 0.15 f_dc + 0.5, logarithms of sizes as 16 (log + 10).
COLOR, SCALE, SHIFT = 0.15, 16, 10
# Bits of harmonics that are kept, by degree.
HARMONIC_BITS = (5, 4)
# A component's 9 bits of magnitude; the three smallest are at most this.
COMPONENT, LARGEST = 511, np.sqrt(0.5)
# From 0 and from 1, of opacities that are read: their logits are finite.
LEAST = 1e-4


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write the Gaussians."""
    splats = splats_of(source, options)
    data, fractional = packed(splats)
    with replaced_when_written(path) as temporary:
        # Without a time, so that equal scenes give equal files.
        temporary.write_bytes(gzip.compress(data, mtime=0))
    return f"{splats.summary()} in {path}, positions in steps of {2.0**-fractional:.3g}"


def packed(splats: Splats) -> tuple[bytes, int]:
    """The stream before gzip, and how many bits of a position lie behind the point."""
    values = turned(splats.values, TO_RUB)
    one = replace(splats, values=values)
    reach = float(np.abs(values[:, :LOG_SCALE]).max())
    # As fine as the smallest Gaussians ask for and the farthest position allows.
    size = float(np.exp(np.quantile(one.log_scales.min(axis=1), SMALLEST)))
    wanted = int(np.ceil(np.log2(STEPS_PER_SIZE / size)))
    whole = int(np.floor(np.log2(max(reach, 1e-30)))) + 1
    fractional = int(np.clip(min(wanted, BITS - 2 - whole), 0, MOST_FRACTIONAL))
    degree = {1: 0, 4: 1, 9: 2}[one.harmonics.shape[1]]
    header = HEADER.pack(MAGIC, VERSION, len(one), degree, fractional, 0, 0)
    fixed = np.rint(one.positions.astype(np.float64) * 2**fractional).astype("<i4")
    parts = [
        fixed.view(np.uint8).reshape(len(one), 3, 4)[:, :, :3],
        _byte(255 / (1 + np.exp(-one.logits.astype(np.float64)))),
        _byte(255 * (COLOR * one.harmonics[:, 0] + 0.5)),
        _byte(SCALE * (one.log_scales + SHIFT)),
        _smallest_three(one.quaternions),
        _harmonics(one.harmonics[:, 1:]),
    ]
    return header + b"".join(np.ascontiguousarray(part).tobytes() for part in parts), fractional


def read(path: Path) -> Splats:
    """The Gaussians of a file, with the axes of a PLY; harmonics above degree 2 are left out."""
    try:
        packed = read_bytes(path)
        data = unpack_gzip(packed, MOST_RATIO * len(packed) + MOST_BYTES)
        magic, version, count, degree, fractional, _, _ = HEADER.unpack_from(data)
    except (OSError, ValueError, struct.error) as error:
        raise MemoryFileError(
            f"{path}: no SPZ of version 2 or 3 ({error}); expected a gzip stream"
        ) from None
    if magic != MAGIC or version not in (2, 3) or degree > 3:
        raise MemoryFileError(
            f"{path}: SPZ version {version}, harmonics of degree {degree}; expected version 2 or "
            "3, degree 3 at most"
        )
    if not count:
        raise MemoryFileError(f"{path}: no Gaussians; expected some")
    terms = (degree + 1) ** 2 - 1
    lengths = [9, 1, 3, 3, 3 if version == 2 else 4, 3 * terms]
    bytes_ = np.frombuffer(data, np.uint8, offset=HEADER.size)
    if len(bytes_) != count * sum(lengths):
        raise MemoryFileError(
            f"{path}: {len(bytes_)} bytes of Gaussians; its header says {count} of {sum(lengths)}"
        )
    parts = np.split(bytes_, np.cumsum(lengths)[:-1] * count)
    places, opacity, color, size, turns, rest = (part.reshape(count, -1) for part in parts)
    values = np.zeros((count, VALUES), np.float32)
    padded = np.zeros((count, 3, 4), np.uint8)
    # Above the byte that is not there, so that the sign is kept.
    padded[:, :, 1:] = places.reshape(count, 3, 3)
    fixed = padded.reshape(count, -1).view("<i4") >> 8
    values[:, :LOG_SCALE] = fixed / 2.0**fractional
    values[:, LOG_SCALE:QUATERNION] = size / SCALE - SHIFT
    values[:, QUATERNION:LOGIT] = _first_three(turns) if version == 2 else _from_smallest(turns)
    share = np.clip(opacity[:, 0] / 255, LEAST, 1 - LEAST)
    values[:, LOGIT] = np.log(share / (1 - share))
    values[:, SH : SH + 3] = (color / 255 - 0.5) / COLOR
    kept = (rest.astype(np.float32) - 128) / 128
    kept = kept[:, : VALUES - SH - 3]
    values[:, SH + 3 : SH + 3 + kept.shape[1]] = kept
    rounds = np.zeros(count, np.int32)
    return Splats(turned(values, TO_RUB), np.zeros(3), count, 0, rounds)


def _first_three(turns: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(N, 4) w, x, y, z of version 2's (N, 3) bytes: x, y and z of quaternions with w >= 0."""
    xyz = turns / 127.5 - 1
    w = np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1, keepdims=True), 0))
    return np.concatenate([w, xyz], axis=1)


def _from_smallest(turns: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(N, 4) w, x, y, z: the inverse of ``_smallest_three``."""
    word = np.ascontiguousarray(turns).view("<u4")[:, 0]
    largest = word >> 30
    q = np.zeros((len(word), 4))
    for axis in (3, 2, 1, 0):
        stored = largest != axis
        size = (word & COMPONENT) * (LARGEST / COMPONENT)
        q[:, axis] = np.where(stored, np.where(word >> 9 & 1, -size, size), 0)
        word = np.where(stored, word >> 10, word)
    rest = np.sqrt(np.maximum(1 - np.square(q).sum(axis=1), 0))
    np.put_along_axis(q, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return np.roll(q, 1, axis=1)


def _byte(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _smallest_three(quaternions: NDArray[np.float32]) -> NDArray[np.uint32]:
    """(N,) from w, x, y, z: two bits say which of x, y, z, w is largest, ten each the others."""
    q = np.roll(quaternions.astype(np.float64), -1, axis=1)
    largest = np.abs(q).argmax(axis=1)
    q = q * np.where(np.take_along_axis(q, largest[:, None], axis=1) < 0, -1, 1)
    size = np.clip(np.rint(COMPONENT * np.abs(q) / LARGEST), 0, COMPONENT).astype(np.uint32)
    ten_bits = size | (q < 0).astype(np.uint32) << 9
    word = largest.astype(np.uint32)
    for axis in range(4):
        word = np.where(largest == axis, word, word << 10 | ten_bits[:, axis])
    return word.astype("<u4")


def _harmonics(coefficients: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(N, H, 3) bytes; low bits that do not count are zero for gzip's sake."""
    degree_one, above = (2.0 ** (8 - bits) for bits in HARMONIC_BITS)
    steps = np.where(np.arange(coefficients.shape[1]) < 3, degree_one, above)[None, :, None]
    return _byte(np.rint((128 * coefficients + 128) / steps) * steps)
