"""3D Gaussians as INRIA's PLY and as SPZ, version 3, written and read.

The PLY is as "3D Gaussian Splatting" writes it: natural logarithms of standard deviations, opacity
before the sigmoid, quaternions w, x, y, z, and coefficients of spherical harmonics channel by
channel.

SPZ is Niantic's format, a tenth of the PLY's size: a gzip stream of a header and one array after
the other: positions (24-bit fixed point), opacities, colours and logarithms of sizes (8 bits each),
rotations (32 bits: the three smallest components and which one is missing), and harmonics (8 bits,
of which 5 count at degree 1 and 4 above). https://github.com/nianticlabs/spz describes it. Its axes
are right, up, back: Gaussians are turned half around x, and its readers turn them back where theirs
are right, down, forward, as a PLY's.
"""

from __future__ import annotations

import gzip
import struct
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.harmonics import turn_gaussians
from gvtools.appearance.splat.project_kernels import (
    LOG_SCALE,
    LOGIT,
    QUATERNION,
    SH,
    VALUES,
)
from gvtools.errors import MemoryFileError
from gvtools.files import replaced_when_written
from gvtools.ply import read_ply, write_ply
from gvtools.untrusted import other_version, read_bytes, unpack_gzip
from pipelines.export.formats import ExportOptions
from pipelines.export.source import ExportSource, Splats

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
# Coefficients of a channel above degree 0, in a PLY.
REST = 15
# Bits of harmonics that are kept, by degree.
HARMONIC_BITS = (5, 4)
# A component's 9 bits of magnitude; the three smallest are at most this.
COMPONENT, LARGEST = 511, np.sqrt(0.5)
# From 0 and from 1, of opacities that are read: their logits are finite.
LEAST = 1e-4


def write_splat_ply(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write the Gaussians."""
    splats = source.splats(options)
    comments = ["3D Gaussians by gvtools, axes of the input's world frame, scene units"]
    if splats.origin.any():
        comments.append("origin " + " ".join(repr(float(x)) for x in splats.origin))
    write_ply(path, ply_rows(splats), comments=tuple(comments))
    return f"{splats.summary()} in {path}"


def ply_rows(splats: Splats) -> NDArray[np.void]:
    """(N,) rows as the PLY has them; normals are zero, as INRIA's are."""
    # As many as degree 3 has, whatever is used: readers of a fixed layout count on them.
    rest = np.zeros((len(splats), 3, REST), np.float32)
    rest[:, :, : splats.harmonics.shape[1] - 1] = splats.harmonics[:, 1:].transpose(0, 2, 1)
    columns: dict[tuple[str, ...], NDArray[Any]] = {
        ("x", "y", "z"): splats.positions,
        ("nx", "ny", "nz"): np.zeros((len(splats), 3)),
        _numbered("f_dc", 3): splats.harmonics[:, 0],
        _numbered("f_rest", 3 * REST): rest.reshape(len(splats), -1),
        ("opacity",): splats.logits[:, None],
        _numbered("scale", 3): splats.log_scales,
        _numbered("rot", 4): splats.quaternions,
    }
    rows = np.empty(len(splats), [(name, "<f4") for names in columns for name in names])
    for names, values in columns.items():
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    return rows


def is_splat(names: Collection[str]) -> bool:
    """Whether a PLY with properties of these names holds Gaussians."""
    needed = {*"xyz", *_numbered("f_dc", 3), "opacity", *_numbered("scale", 3)}
    return needed.union(_numbered("rot", 4)) <= set(names)


def read_splat_ply(path: Path) -> Splats:
    """The Gaussians of a file; harmonics above degree 2 and values that are none are left out."""
    rows = read_ply(path)
    names = rows.dtype.names or ()
    if not is_splat(names):
        raise MemoryFileError(f"{path}: a PLY without Gaussians; expected f_dc_0, scale_0, rot_0")

    def columns(of: Sequence[str]) -> NDArray[np.float32]:
        return np.stack([rows[name].astype(np.float32) for name in of], axis=1)

    values = np.zeros((len(rows), VALUES), np.float32)
    values[:, :LOG_SCALE] = columns("xyz")
    values[:, LOG_SCALE:QUATERNION] = columns(_numbered("scale", 3))
    values[:, QUATERNION:LOGIT] = columns(_numbered("rot", 4))
    values[:, LOGIT] = rows["opacity"]
    values[:, SH : SH + 3] = columns(_numbered("f_dc", 3))
    rest = [name for name in _numbered("f_rest", len(names)) if name in names]
    if rest and len(rest) % 3 == 0:
        kept = columns(rest).reshape(len(rows), 3, -1).transpose(0, 2, 1)
        kept = kept.reshape(len(rows), -1)[:, : VALUES - SH - 3]
        values[:, SH + 3 : SH + 3 + kept.shape[1]] = kept
    values = values[np.isfinite(values).all(axis=1) & values[:, QUATERNION:LOGIT].any(axis=1)]
    return splats_of(values, _origin(path))


def splats_of(values: NDArray[np.float32], origin: NDArray[np.float64]) -> Splats:
    """Gaussians of a file, which says nothing of rounds and sources."""
    count = len(values)
    return Splats(values, origin, count, 0, np.zeros(count, np.int32), np.zeros(count, np.bool_))


def _origin(path: Path) -> NDArray[np.float64]:
    """(3,) that positions count from, as a comment says it; zero without one."""
    with path.open("rb") as file:
        for line in file:
            words = line.split()
            if words[:2] == [b"comment", b"origin"] and len(words) == 5:
                try:
                    return np.array([float(word) for word in words[2:]])
                except ValueError:
                    break
            if words[:1] == [b"end_header"]:
                break
    return np.zeros(3)


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{number}" for number in range(count))


def write_spz(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write the Gaussians."""
    splats = source.splats(options)
    data, fractional = spz_stream(splats)
    with replaced_when_written(path) as temporary:
        # Without a time, so that equal scenes give equal files.
        temporary.write_bytes(gzip.compress(data, mtime=0))
    return f"{splats.summary()} in {path}, positions in steps of {2.0**-fractional:.3g}"


def spz_stream(splats: Splats) -> tuple[bytes, int]:
    """The stream before gzip, and how many bits of a position lie behind the point."""
    values = turn_gaussians(splats.values, TO_RUB)
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


def read_spz(path: Path) -> Splats:
    """The Gaussians of a file, with the axes of a PLY; harmonics above degree 2 are left out."""
    try:
        packed = read_bytes(path)
        if packed[:4] == HEADER.pack(MAGIC, *[0] * 6)[:4] and len(packed) >= 8:
            version = int.from_bytes(packed[4:8], "little")
            raise MemoryFileError(
                f"{path}: SPZ version {version}; expected version 2 or 3; "
                f"{other_version(version, VERSION, 'save it again')}"
            )
        data = unpack_gzip(packed, MOST_RATIO * len(packed) + MOST_BYTES)
        magic, version, count, degree, fractional, _, _ = HEADER.unpack_from(data)
    except (OSError, ValueError, struct.error) as error:
        raise MemoryFileError(
            f"{path}: no SPZ of version 2 or 3 ({error}); expected a gzip stream"
        ) from None
    if magic != MAGIC or version not in (2, 3) or degree > 3:
        raise MemoryFileError(
            f"{path}: SPZ version {version}, harmonics of degree {degree}; expected version 2 or "
            f"3, degree 3 at most; {other_version(version, VERSION, 'save it again')}"
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
    return splats_of(turn_gaussians(values, TO_RUB), np.zeros(3))


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
