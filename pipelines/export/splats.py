"""3D Gaussians in the formats that viewers take; the suffix tells which.

PLY is as "3D Gaussian Splatting" writes it. SPZ's axes are right, up, back: Gaussians are turned
half around x, and its readers turn them back where theirs are right, down, forward, as a PLY's.
glTF and USD stand upright where up is known; all other files have the input's axes. SPZ is written
by gsply or, without it, by Open3D; ``.splat`` by Open3D; SOG, ``.ksplat``, compressed PLY and SPZ
of version 2 by gaussforge; USD by OpenUSD.
"""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import OptionError
from gvtools.files import replaced_when_written
from gvtools.optional import installed, require
from gvtools.ply import up_comment, write_ply
from gvtools.sog import META
from gvtools.splat_files import KHR, MODES, RESTS, SRGB, numbered
from gvtools.splats import SH, TERMS, TO_RUB, Splats, box_middle, turn_gaussians
from pipelines.export.formats import ExportOptions
from pipelines.export.points import axes_of, linear, save_glb, save_usd, usd_stage
from pipelines.export.source import ExportSource

# Of SPZ's positions: bits with their sign, the most behind the point, and those that its writers
# take whatever the scene; where the header has them, and its flags.
BITS, MOST_FRACTIONAL, USUAL_FRACTIONAL = 24, 23, 12
FRACTIONAL_AT, FLAGS_AT = 13, 14
# Steps of positions in a small Gaussian's least standard deviation; smaller ones are this share.
STEPS_PER_SIZE, SMALLEST = 8, 0.05
# Coefficients of a channel above degree 0, in a PLY.
REST = 15
# The degree that formats end at (ksplat's own reader takes no more), and what they tell of drawing.
MOST_DEGREE = {".splat": 0, ".ksplat": 2}
MODES_KEPT = {".ply": MODES, ".spz": ("mip",), ".sog": ("mip",)}
FIELD = "/gvtools/splats"
# What says nothing of what is up.
SILENT = (".spz", ".splat", ".ksplat")


def write_splats(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write the Gaussians in the format that the name's end tells."""
    return write_file(source.splats(options), path, options)


def write_file(splats: Splats, path: Path, options: ExportOptions) -> str:
    """Write Gaussians, and say how many and how."""
    if options.up is not None and path.suffix.lower() in SILENT:
        raise OptionError(f"--up: a {path.suffix} has no place for it; leave it out")
    with replaced_when_written(path, suffix="".join(path.suffixes[-2:]).lower()) as temporary:
        ends = (end for end in WRITERS if path.name.lower().endswith(end))
        note = WRITERS[next(ends)](splats, temporary, options)
    return f"{splats.summary()} in {path}{note}{_lost(splats, path.suffix.lower())}"


def _lost(splats: Splats, suffix: str) -> str:
    """What is said of what a format has no place for."""
    most, text = MOST_DEGREE.get(suffix, splats.degree), ""
    if most < splats.degree:
        text = f", harmonics up to degree {most}" if most else ", without harmonics"
    if splats.mode not in ("", *MODES_KEPT.get(suffix, ())):
        text += f", without SplatRenderMode {splats.mode}"
    return text


def _write_ply(splats: Splats, path: Path, options: ExportOptions) -> str:
    write_ply(path, ply_rows(splats), comments=_comments(splats))
    return ""


def _comments(splats: Splats) -> tuple[str, ...]:
    lines = ["3D Gaussians by gvtools, axes of the input's world frame, scene units"]
    if splats.origin.any():
        lines.append("origin " + " ".join(repr(float(x)) for x in splats.origin))
    lines += up_comment(splats.up)
    if splats.mode:
        lines.append(f"SplatRenderMode: {splats.mode}")
    return tuple(lines)


def ply_rows(splats: Splats) -> NDArray[np.void]:
    """(N,) rows as the PLY has them; normals are zero, as INRIA's are."""
    # As many as degree 3 has, whatever is used: readers of a fixed layout count on them.
    rest = np.zeros((len(splats), 3, REST), np.float32)
    rest[:, :, : splats.harmonics.shape[1] - 1] = splats.harmonics[:, 1:].transpose(0, 2, 1)
    columns: dict[tuple[str, ...], NDArray[Any]] = {
        ("x", "y", "z"): splats.positions,
        ("nx", "ny", "nz"): np.zeros((len(splats), 3)),
        numbered("f_dc", 3): splats.harmonics[:, 0],
        numbered("f_rest", 3 * REST): rest.reshape(len(splats), -1),
        ("opacity",): splats.logits[:, None],
        numbered("scale", 3): splats.log_scales,
        numbered("rot", 4): splats.quaternions,
    }
    rows = np.empty(len(splats), [(name, "<f4") for names in columns for name in names])
    for names, values in columns.items():
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    return rows


def _write_spz(splats: Splats, path: Path, options: ExportOptions) -> str:
    """Positions as fine as the smallest Gaussians ask for and the farthest one allows.

    gsply writes harmonics in 8 bits; Open3D and gaussforge in 5 and 4, which costs 1 dB on fox. All
    have one step: what is between it and ours, a power of two, is taken into the positions, and out
    of them in the header.
    """
    values = turn_gaussians(splats.values, TO_RUB)
    size = float(np.exp(np.quantile(splats.log_scales.min(axis=1), SMALLEST)))
    wanted = int(np.ceil(np.log2(STEPS_PER_SIZE / size)))
    reach = float(np.abs(splats.positions).max())
    whole = int(np.floor(np.log2(max(reach, 1e-30)))) + 1
    fractional = int(np.clip(min(wanted, BITS - 2 - whole), 0, MOST_FRACTIONAL))
    values[:, :3] *= 2.0 ** (fractional - USUAL_FRACTIONAL)
    turned, antialiased = replace(splats, values=values), int(splats.mode == "mip")
    version = options.spz_version
    if version > 2 and installed("gsply") and installed("zstandard"):
        packed = _by_gsply(turned, path, version)
    elif version == 4:
        _write_by_open3d(turned, path, options)
        packed = path.read_bytes()
    else:
        packed = _by_gaussforge(turned, "spz", spz_version=version)
    data = bytearray(packed if version == 4 else gzip.decompress(packed))
    data[FRACTIONAL_AT], data[FLAGS_AT] = fractional, data[FLAGS_AT] | antialiased
    # Without a time, so that equal scenes give equal files.
    path.write_bytes(data if version == 4 else gzip.compress(data, mtime=0))
    return f", axes right, up, back, positions in steps of {2.0**-fractional:.3g}"


def _by_gsply(splats: Splats, path: Path, version: int) -> bytes:
    import gsply

    above = splats.harmonics[:, 1:]
    data = gsply.GSData.from_arrays(
        splats.positions, splats.log_scales, splats.quaternions, splats.logits,
        splats.harmonics[:, 0], above if above.size else None, format="ply",
    )  # fmt: skip
    gsply.write_spz(path, data, version=version)
    return path.read_bytes()


def _write_by_open3d(splats: Splats, path: Path, options: ExportOptions) -> str:
    from gvtools.o3d import o3d

    parts = {
        "positions": splats.positions,
        "scale": np.exp(splats.log_scales),
        "rot": splats.quaternions,
        "opacity": splats.logits[:, None],
        "f_dc": splats.harmonics[:, 0],
        "f_rest": splats.harmonics[:, 1:],
    }
    cloud = o3d.t.geometry.PointCloud()
    for name, part in parts.items():
        if part.size:
            cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(part, np.float32))
    if not o3d.t.io.write_point_cloud(str(path), cloud):
        raise OSError("Open3D wrote no file")
    return ""


def _write_sog(splats: Splats, path: Path, options: ExportOptions) -> str:
    packed, told = BytesIO(_by_gaussforge(splats, "sog")), {"antialias": splats.mode == "mip"}
    told |= {} if splats.up is None else {"up": splats.up.tolist()}
    with ZipFile(packed) as members, ZipFile(path, "w") as out:
        for item in members.infolist():
            content = members.read(item)
            if item.filename == META:
                content = json.dumps({**json.loads(content), **told}).encode()
            out.writestr(item, content)
    return ""


def _write_compressed(splats: Splats, path: Path, options: ExportOptions) -> str:
    """SuperSplat's PLY; gaussforge 0.6 writes harmonics as they come, which are to be by colour."""
    by_color = splats.harmonics[:, 1:].transpose(0, 2, 1)
    data = _by_gaussforge(splats, "compressed.ply", rest=by_color)
    head, mark, body = data.partition(b"end_header\n")
    comments = "".join(f"comment {line}\n" for line in _comments(splats)).encode()
    path.write_bytes(head + comments + mark + body)
    return ""


def _write_ksplat(splats: Splats, path: Path, options: ExportOptions) -> str:
    """Degree by degree and in these by colour, which gaussforge 0.6 writes by colour alone."""
    degree = min(splats.degree, MOST_DEGREE[".ksplat"])
    rest = splats.harmonics[:, 1 : TERMS[degree]]
    by_degree = [rest[:, first:last].transpose(0, 2, 1).reshape(len(splats), -1)
                 for first, last in pairwise(RESTS[: degree + 1])]  # fmt: skip
    if by_degree:
        ordered = np.concatenate(by_degree, axis=1)
        rest = ordered.reshape(len(splats), 3, -1).transpose(0, 2, 1)
    kept = replace(splats, values=splats.values[:, : SH + 3 * TERMS[degree]])
    data = bytearray(_by_gaussforge(kept, "ksplat", rest=rest))
    # Sections, those that are loaded, Gaussians at most and there.
    struct.pack_into("<4I", data, 4, 1, 1, len(splats), len(splats))
    path.write_bytes(data)
    return ""


def _by_gaussforge(
    splats: Splats, form: str, *, rest: NDArray[np.float32] | None = None, spz_version: int = 3
) -> bytes:
    """A file's bytes; ``rest`` are harmonics above degree 0 in another order."""
    package = require("gaussforge", extra="export", purpose=f"Gaussians as {form}")
    parts = {
        "positions": splats.positions,
        "scales": splats.log_scales,
        "rotations": splats.quaternions,
        "alphas": splats.logits,
        "colors": splats.harmonics[:, 0],
        "sh": splats.harmonics[:, 1:] if rest is None else rest,
    }
    told = package.GaussForge().write(
        {"numPoints": len(splats), "meta": {"shDegree": splats.degree}, "extras": {}}
        | {name: np.ascontiguousarray(part, np.float32).tobytes() for name, part in parts.items()},
        form,
        spz_version=spz_version,
    )
    if "error" in told:
        raise OSError(f"gaussforge: {told['error']}")
    return bytes(told["data"])


def _write_glb(splats: Splats, path: Path, options: ExportOptions) -> str:
    """GlTF with KHR_gaussian_splatting: sizes and opacities as they are drawn, quaternions x to w.

    Viewers without the extension draw points of the colours.
    """
    parts: dict[str, NDArray[np.float32]] = {
        "COLOR_0": np.column_stack([linear(splats.colors), splats.opacities]),
        f"{KHR}:ROTATION": np.roll(splats.quaternions, -1, axis=1),
        f"{KHR}:SCALE": np.exp(splats.log_scales),
        f"{KHR}:OPACITY": splats.opacities[:, None],
    }
    for degree in range(splats.degree + 1):
        for term in range(2 * degree + 1):
            name = f"{KHR}:SH_DEGREE_{degree}_COEF_{term}"
            parts[name] = splats.harmonics[:, degree**2 + term]
    extension = {KHR: {"kernel": "ellipse", "colorSpace": SRGB}}
    save_glb(
        path, splats.positions + splats.origin, parts, name="gvtools_splats", up=splats.up,
        primitive={"mode": 0, "extensions": extension}, extensionsUsed=[KHR],
    )  # fmt: skip
    return axes_of(splats.up)


def _write_usd(splats: Splats, path: Path, options: ExportOptions) -> str:
    """One ParticleField3DGaussianSplat; a scene unit is a metre."""
    require("pxr.UsdVol", extra="export", purpose=f"--out {path}")
    from pxr import UsdVol, Vt

    center = box_middle(splats.positions.astype(np.float64))
    local = (splats.positions - center).astype(np.float32)
    stage = usd_stage(center + splats.origin, splats.up)
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, FIELD)
    sh = np.ascontiguousarray(splats.harmonics.reshape(-1, 3))
    reach = 3 * np.exp(splats.log_scales.max(axis=1, keepdims=True))
    corners = np.stack([(local - reach).min(axis=0), (local + reach).max(axis=0)])
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(local))
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(np.exp(splats.log_scales)))
    turns = np.ascontiguousarray(np.roll(splats.quaternions, -1, axis=1))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(turns))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacities))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(splats.degree)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(sh))
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)))
    save_usd(stage, path)
    return axes_of(splats.up)


# By the end of a name, longer ones first.
WRITERS: Mapping[str, Callable[[Splats, Path, ExportOptions], str]] = {
    ".compressed.ply": _write_compressed,
    ".ply": _write_ply,
    ".spz": _write_spz,
    ".sog": _write_sog,
    ".ksplat": _write_ksplat,
    ".splat": _write_by_open3d,
    ".glb": _write_glb,
    **dict.fromkeys((".usdc", ".usda"), _write_usd),
}
