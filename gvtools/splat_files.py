"""Splat files of any format, read into ``Splats``: the one reader of them.

PLY, ``.splat``, ``.ksplat``, glTF and SOG are read here, with counts that the file's size explains.
SPZ and compressed PLY are unpacked by gaussforge (SPZ without it by Open3D), and USD by OpenUSD, in
a child process. Axes stay the file's, but for SPZ, which has right, up, back: its Gaussians are
turned half around x, as a PLY's mostly are right, down, forward.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import Float64, rigid_poses
from gvtools.errors import GvError, MemoryFileError, OptionError
from gvtools.glb import (
    GLTF_ENDS,
    UNKNOWN,
    drawn_nodes,
    glb_axes,
    glb_numbers,
    read_gltf,
    turn_back,
    unit,
)
from gvtools.optional import installed, require
from gvtools.ply import read_header, read_ply
from gvtools.sandbox import Item, ReaderError, read_apart
from gvtools.sog import META, read_sog
from gvtools.splats import (
    HARMONICS,
    LOG_SCALE,
    LOGIT,
    QUATERNION,
    SH,
    TERMS,
    TO_RUB,
    Splats,
    near_origin,
    place_gaussians,
    turn_gaussians,
)
from gvtools.untrusted import DAMAGED, other_version, read_bytes, regular

Float32 = NDArray[np.float32]

# From 0 and from 1, of opacities that are read: their logits are finite.
LEAST = 1e-4
# Of a file's bytes, what Gaussians of it take in the child; rows that it sends at once.
BYTES_PER_BYTE, ROWS = 96, 1 << 20
# SPZ: magic, version, count, degree of the harmonics, fractional bits, flags; whether antialiased.
SPZ_HEADER, SPZ_MAGIC, SPZ_VERSION, ANTIALIASED = struct.Struct("<IIIBBB"), 0x5053474E, 4, 1
SPLAT_ROW = np.dtype([("xyz", "<f4", 3), ("size", "<f4", 3), ("rgba", "u1", 4), ("q", "u1", 4)])
# ksplat: bytes in front of the sections' heads, and of each of these.
KSPLAT_HEAD, KSPLAT_SECTION = 4096, 1024
# Of harmonics in 8 bits, where the head names none.
KSPLAT_RANGE = 1.5
# glTF's extension, whose name the attributes' names begin with, and its colours that are read.
KHR, SRGB = "KHR_gaussian_splatting", "srgb_rec709_display"
# Of a GLB, in which the extensions that it uses are named.
GLB_HEAD = 1 << 20
# Of a Gaussian in a glTF, in bytes.
LEAST_BYTES = 16
# How many coefficients of a colour harmonics of degree 1 to 4 have above degree 0.
RESTS = (0, 3, 8, 15, 24)
# Who reads a USD, in a child process, and what a byte of its text takes there.
USD, USD_BYTES_PER_BYTE = f"{__name__}:usd", 64
USD_ENDS = (".usd", ".usda", ".usdc", ".usdz")
# The node by which an exported USD stands upright, see ``pipelines.export.points``.
USD_ROOT = "gvtools"
# Of a flat Gaussian's third size, before the exponential, below its smaller one.
FLAT = 7.0
PACKED, MODES = "packed_position", ("mip", "2dgs")
# Numbers of a compressed PLY's chunk: ranges of positions and of sizes, without those of colours.
OLD_RANGES = 12


def read_splats(path: Path) -> Splats:
    """The Gaussians of a file of a format that ``READERS`` has; harmonics end at degree 3."""
    path = path / META if path.is_dir() else path
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise OptionError(f"{path}: expected splats, a file that ends with {', '.join(READERS)}")
    try:
        with np.errstate(all="ignore"):  # what becomes no number is left out
            return READERS[suffix](regular(path))
    except GvError as error:
        if str(path) in str(error):
            raise
        raise type(error)(f"{path}: {error}") from None
    except FileNotFoundError:
        raise MemoryFileError(f"{path}: no such file; expected splats") from None
    except (ReaderError, *DAMAGED) as error:
        said = str(error)[:200] or type(error).__name__
        raise MemoryFileError(
            f"{path}: cannot be read as {suffix} ({said}); expected a whole file of Gaussians; it "
            "is damaged, or of another kind; save it again"
        ) from None


def holds_splats(path: Path) -> bool:
    """Whether a file is of splats by its suffix or, where that does not tell, by what it names.

    A folder is where it has the ``meta.json`` of an SOG.
    """
    suffix = path.suffix.lower()
    if suffix == ".json" or path.is_dir():
        return (path / META).is_file() if path.is_dir() else path.name.endswith(META)
    if suffix == ".ply" and path.is_file():
        header = read_header(path)
        names = {name for element in header.elements for name, _ in element.columns}
        return is_splat(names) and not header.holds("face")
    if suffix in GLTF_ENDS and path.is_file():
        with regular(path).open("rb") as file:
            return KHR.encode() in file.read(GLB_HEAD if suffix == ".glb" else -1)
    return suffix in READERS


def is_splat(names: Collection[str]) -> bool:
    """Whether a PLY with properties of these names holds Gaussians, compressed or not."""
    needed = {*"xyz", *numbered("f_dc", 3), "opacity", *numbered("scale", 2), *numbered("rot", 4)}
    return needed <= {*names} or PACKED in names


def numbered(name: str, count: int) -> tuple[str, ...]:
    """Names of a PLY's properties: NAME_0, NAME_1 and so on."""
    return tuple(f"{name}_{number}" for number in range(count))


def _splats(
    values: NDArray[np.floating[Any]],
    *,
    origin: Float64 | None = None,
    center: Float64 | None = None,
    up: Float64 | None = None,
    mode: str = "",
    axes: Float64 | None = None,
) -> Splats:
    """Rows of a file without those that are no numbers, turned to where its axes are ``axes``.

    Positions count from ``center``, which is told as an origin where float32 needs it, and both
    from ``origin``, which the file tells.
    """
    widest = SH + 3 * TERMS[-1]
    cut = values.shape[1] > widest
    values = values[:, :widest].astype(np.float32)
    values[:, LOGIT] = np.clip(values[:, LOGIT], -99, 99)
    sound = np.isfinite(values).all(axis=1) & values[:, QUATERNION:LOGIT].any(axis=1)
    kept = values[sound]
    if not len(kept):
        raise MemoryFileError("no Gaussians; expected some")
    # Degrees that a format has and nobody used.
    terms = (kept.shape[1] - SH) // 3
    while terms > 1 and not kept[:, SH + 3 * TERMS[TERMS.index(terms) - 1] :].any():
        terms = TERMS[TERMS.index(terms) - 1]
    kept = kept[:, : SH + 3 * terms]
    if axes is not None:
        kept = turn_gaussians(kept, axes)
    origin = np.zeros(3) if origin is None else origin
    if center is not None:
        kept, shift = near_origin(kept, center)
        origin = origin + shift
    rounds, generated = np.zeros(len(kept), np.int32), np.zeros(len(kept), np.bool_)
    dropped = len(values) - len(kept)
    return Splats(kept, origin, None, 0, rounds, generated, up, mode, dropped, cut)


def _rows(positions: Any, log_scales: Any, quaternions: Any, *, logits: Any, sh: Any) -> Float32:
    """Rows of the parts of N Gaussians; ``sh`` (N, H, 3)."""
    count = len(positions)
    parts = (positions, log_scales, quaternions, np.reshape(logits, (count, 1)))
    return np.concatenate([*parts, np.reshape(sh, (count, -1))], axis=1, dtype=np.float32)


def _logits(shares: Any) -> Float64:
    """Before the sigmoid, what shares from 0 to 1 are behind it."""
    shares = np.clip(np.asarray(shares, np.float64), LEAST, 1 - LEAST)
    return np.log(shares / (1 - shares))


def _dc(colors: Any) -> Float64:
    """Coefficients of degree 0 of colours from 0 to 1."""
    return (np.asarray(colors, np.float64) - 0.5) / HARMONICS[0]


def _logarithms(sizes: Any) -> Float64:
    return np.log(np.asarray(sizes, np.float64))


def _read_ply(path: Path) -> Splats:
    header = read_header(path)
    told = told_by(header.comments)
    if any(PACKED in dict(item.columns) for item in header.elements):
        return _splats(_unpacked(path, form="compressed.ply"), **told)
    rows = read_ply(path, strict=False)
    if "scale_2" not in (rows.dtype.names or ()):
        told["mode"] = "2dgs"
    if rows.dtype["x"].itemsize == 8 and len(rows):
        # Doubles may be far from 0: any place among them is near.
        first = np.array([rows[axis][0] for axis in "xyz"])
        told["center"] = np.round(np.nan_to_num(first, posinf=0, neginf=0))
    return _splats(_ply_values(rows, told.get("center", 0)), **told)


def _ply_values(rows: NDArray[np.void], center: ArrayLike = 0) -> Float32:
    names = rows.dtype.names or ()
    if not is_splat(names):
        raise MemoryFileError("a PLY without Gaussians; expected f_dc_0, scale_0, rot_0")

    def columns(of: tuple[str, ...]) -> Float32:
        return np.stack([rows[name].astype(np.float32) for name in of], axis=1)

    count = sum(name.startswith("f_rest_") for name in names)
    terms = count // 3
    if 3 * terms != count or terms not in RESTS or not {*numbered("f_rest", count)} <= {*names}:
        raise MemoryFileError(
            f"{count} properties f_rest; expected 0, 9, 24 or 45 of them, harmonics of whole "
            "degrees for three colours; save it again"
        )
    sh = columns(numbered("f_dc", 3))[:, None]
    if terms:
        rest = columns(numbered("f_rest", count)).reshape(len(rows), 3, terms)
        sh = np.concatenate([sh, rest.transpose(0, 2, 1)], axis=1)
    positions = np.stack([rows[axis] for axis in "xyz"], axis=1) - np.asarray(center)
    log_scales = columns(tuple(name for name in numbered("scale", 3) if name in names))
    if log_scales.shape[1] == 2:  # 2D Gaussian Splatting's, which are flat
        flat = log_scales.min(axis=1, keepdims=True) - FLAT
        log_scales = np.concatenate([log_scales, flat], axis=1)
    return _rows(
        positions, log_scales, columns(numbered("rot", 4)),
        logits=rows["opacity"], sh=sh,
    )  # fmt: skip


def told_by(comments: Iterable[str]) -> dict[str, Any]:
    """What comments of a file say of its origin, what is up, and how to draw it.

    Brush writes "SplatRenderMode: mip", Postshot "antialiased 1".
    """
    told: dict[str, Any] = {}
    for comment in comments:
        name, _, value = comment.lower().partition(" ")
        if name in ("origin", "up"):
            with suppress(ValueError):
                vector = np.array([float(number) for number in value.split()])
                if vector.shape == (3,) and np.isfinite(vector).all():
                    told[name] = vector if name == "origin" else unit(vector)
        elif name == "splatrendermode:":
            told["mode"] = value.strip() if value.strip() in MODES else ""
        elif name == "antialiased":
            told["mode"] = "mip" if value.strip() == "1" else ""
    return told


def _read_splat(path: Path) -> Splats:
    data = read_bytes(path)
    if len(data) % SPLAT_ROW.itemsize:
        raise MemoryFileError(
            f"{len(data)} bytes; expected {SPLAT_ROW.itemsize} for each Gaussian; it is truncated"
        )
    rows = np.frombuffer(data, SPLAT_ROW)
    colors, turns = rows["rgba"] / 255, rows["q"] / 128.0 - 1
    logits = _logits(colors[:, 3])
    return _splats(
        _rows(rows["xyz"], _logarithms(rows["size"]), turns, logits=logits, sh=_dc(colors[:, :3]))
    )


def _read_sog(path: Path) -> Splats:
    meta, parts = read_sog(path)
    logits = parts["logits"] if "logits" in parts else _logits(parts["opacities"])
    values = _rows(
        parts["positions"], parts["log_scales"], parts["quaternions"], logits=logits, sh=parts["sh"]
    )
    return _splats(values, up=unit(meta.get("up")), mode="mip" if meta.get("antialias") else "")


def _read_ksplat(path: Path) -> Splats:
    """The sections of a file, at any of three levels of compression."""
    data = read_bytes(path)
    sections, level = struct.unpack_from("<I12xH", data, 4)
    if level > 2 or data[0] != 0:
        raise MemoryFileError(
            f"ksplat version {data[0]}, compression {level}; expected version 0, compression 0 to 2"
        )
    low, high = struct.unpack_from("<2f", data, 36)
    low, high = (low, high) if low < high else (-KSPLAT_RANGE, KSPLAT_RANGE)
    offset = KSPLAT_HEAD + KSPLAT_SECTION * sections
    parts = list[tuple[Float32, Float64]]()
    for number in range(sections):
        place = KSPLAT_HEAD + KSPLAT_SECTION * number
        part, offset = _ksplat_section(data, place, offset, level=level, sh_range=(low, high))
        parts.append((part, np.zeros(3)))
    return _splats(_joined(parts)[0])


def _ksplat_section(
    data: bytes, place: int, offset: int, *, level: int, sh_range: tuple[float, float]
) -> tuple[Float32, int]:
    """Rows of the section with its head at ``place`` and its data at ``offset``; where it ends."""
    used, count, size, buckets = struct.unpack_from("<4I", data, place)
    edge, bucket_bytes, steps = struct.unpack_from("<fH2xI", data, place + 16)
    full, partly, degree = struct.unpack_from("<IIH", data, place + 32)
    if degree > 3 or used > count or max(full, full * size) > used or not (level == 0 or steps > 0):
        raise ValueError("sections that contradict their head")
    whole, half, byte = ("<f4", "<f4", "<f4") if level == 0 else ("<u2", "<f2", "<f2")
    byte = "u1" if level == 2 else byte
    terms = TERMS[degree] - 1
    row = np.dtype([("xyz", whole, 3), ("size", half, 3), ("q", half, 4), ("rgba", "u1", 4),
                    ("sh", byte, (3 * terms,))])  # fmt: skip
    lengths = np.frombuffer(data, "<u4", partly, offset)
    offset += 4 * partly
    centers = np.frombuffer(data, "<f4", buckets * bucket_bytes // 4, offset)
    centers = centers.reshape(buckets, -1)[:, :3] if buckets else np.zeros((1, 3), np.float32)
    offset += buckets * bucket_bytes
    rows = np.frombuffer(data, row, used, offset)
    xyz = rows["xyz"].astype(np.float64)
    if level and used:
        ends = np.cumsum(np.concatenate([np.full(full, size, np.int64), lengths]))
        bucket = np.searchsorted(ends, np.arange(used), side="right")
        xyz = (xyz - steps) * (edge / 2 / steps) + centers[bucket]
    sh = rows["sh"].astype(np.float32)
    if level == 2:
        sh = sh_range[0] + sh * ((sh_range[1] - sh_range[0]) / 255)
    colors = rows["rgba"] / 255
    by_term = np.concatenate(
        [_dc(colors[:, :3])[:, None], *(sh[:, 3 * first : 3 * last].reshape(used, 3, -1)
         .transpose(0, 2, 1) for first, last in pairwise(RESTS[: degree + 1]))], axis=1,
    )  # fmt: skip
    logits = _logits(colors[:, 3])
    values = _rows(xyz, _logarithms(rows["size"]), rows["q"], logits=logits, sh=by_term)
    return values, offset + count * row.itemsize


def _unpacked(path: Path, *, form: str) -> Float32:
    """Rows of a file that a package unpacks in a child process; opacities are of 8 bits there."""
    reader = "unpacked"
    if form == "spz" and not installed("gaussforge"):
        reader = "spz"  # of Open3D, which takes seconds to start
    else:
        require("gaussforge", extra="export", purpose=f"{path}: Gaussians as {form}")
    items = read_apart(f"{__name__}:{reader}", path, form=form)
    parts = [arrays["values"] for _, arrays in items]
    if not parts:
        raise MemoryFileError("no Gaussians; expected some")
    values = np.concatenate(parts)
    values[:, LOGIT] = np.clip(values[:, LOGIT], _logits(0), _logits(1))
    return values


def unpacked(path: Path, *, form: str) -> Iterator[Item]:
    """Rows of a file of gaussforge's formats, for ``read_apart``."""
    import gaussforge

    yield {"bytes_per_byte": BYTES_PER_BYTE}, {}
    # As a PLY: what has no harmonics, version 0.6 cannot hand over as arrays.
    data = _with_color_ranges(path) if form == "compressed.ply" else read_bytes(path)
    told = gaussforge.GaussForge().convert(data, form, "ply")
    if not told.get("data"):  # of some damaged files, without an error
        said = str(told.get("error", "no Gaussians")).removeprefix(f"{form} read failed: ")
        raise MemoryFileError(f"{said}; expected a whole {form}; save it again")
    with TemporaryDirectory() as folder:
        file = Path(folder) / "unpacked.ply"
        file.write_bytes(told["data"])
        del told
        yield from _sent(_ply_values(read_ply(file)))


def _with_color_ranges(path: Path) -> bytes:
    """A compressed PLY whose chunks tell ranges of colours; from 0 to 1 where older ones do not."""
    header, data = read_header(path), read_bytes(path)
    chunks = header.elements[0]
    if len(chunks.columns) != OLD_RANGES:
        return data
    size = header.offset + 4 * OLD_RANGES * chunks.count
    rows = np.frombuffer(data[header.offset : size], "<f4").reshape(chunks.count, OLD_RANGES)
    colors = np.broadcast_to(np.repeat([0, 1], 3), (chunks.count, 6))
    told = "".join(f"property float {end}_{color}\n" for end in ("min", "max") for color in "rgb")
    head = data[: header.offset].replace(b"element vertex", told.encode() + b"element vertex", 1)
    return head + np.concatenate([rows, colors], axis=1, dtype="<f4").tobytes() + data[size:]


def spz(path: Path, *, form: str) -> Iterator[Item]:
    """Rows of an SPZ, for ``read_apart``."""
    from gvtools.o3d import o3d

    o3d.utility.set_max_threads(1)
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    yield {"bytes_per_byte": BYTES_PER_BYTE}, {}
    cloud = o3d.t.io.read_point_cloud(str(path))
    if "f_dc" not in cloud.point:
        raise MemoryFileError("damaged; expected a whole SPZ; save it again")
    parts = {name: cloud.point[name].numpy()
             for name in ("positions", "scale", "rot", "opacity", "f_dc", "f_rest")
             if name in cloud.point}  # fmt: skip
    parts["scale"] = _logarithms(parts["scale"])
    parts.setdefault("f_rest", np.zeros((len(parts["f_dc"]), 0)))
    yield from _sent(*parts.values())


def _sent(*parts: NDArray[Any]) -> Iterator[Item]:
    """Positions, log scales, quaternions, logits, coefficients of degree 0 and above, piecewise."""
    parts = tuple(part.reshape(len(parts[0]), -1) for part in parts)
    for first in range(0, len(parts[0]), ROWS):
        rows = [part[first : first + ROWS] for part in parts]
        yield {}, {"values": np.concatenate(rows, axis=1, dtype=np.float32)}


def _read_spz(path: Path) -> Splats:
    with path.open("rb") as file:
        head = file.read(1 << 12)
    if head[:2] == b"\x1f\x8b":
        head = zlib.decompressobj(31).decompress(head, SPZ_HEADER.size)
    magic, version, count, degree, _, flags = SPZ_HEADER.unpack_from(head)
    if magic != SPZ_MAGIC or not 1 <= version <= SPZ_VERSION:
        raise MemoryFileError(
            f"SPZ version {version}; expected version 1 to {SPZ_VERSION}; "
            f"{other_version(version, SPZ_VERSION, 'save it again')}"
            if magic == SPZ_MAGIC
            else "no SPZ; expected a gzip stream, or NGSP in front"
        )
    values = _unpacked(path, form="spz")
    if len(values) != count or values.shape[1] < SH + 3 * TERMS[min(degree, 3)]:
        raise MemoryFileError(
            f"{len(values)} Gaussians; its header says {count} of degree {degree}; it is damaged"
        )
    return _splats(values, mode="mip" if flags & ANTIALIASED else "", axes=TO_RUB)


def _joined(parts: list[tuple[Float32, Float64]]) -> tuple[Float32, Float64]:
    """Rows of several sets with origins of their own: with that of the first, and it."""
    if not parts:
        raise MemoryFileError("no Gaussians; expected some")
    origin, width = parts[0][1], max(values.shape[1] for values, _ in parts)
    rows = np.zeros((sum(len(values) for values, _ in parts), width), np.float32)
    first = 0
    for values, own in parts:
        rows[first : first + len(values), : values.shape[1]] = values
        rows[first : first + len(values), :LOG_SCALE] += (own - origin).astype(np.float32)
        first += len(values)
    return rows, origin


def _read_glb(path: Path) -> Splats:
    tree, body = read_gltf(path)
    up, back = glb_axes(tree)
    parts = []
    for node, matrix in drawn_nodes(tree):
        for part in tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            extension = part.get("extensions", {}).get(KHR)
            if extension is None:
                continue
            if extension.get("extensions") or extension.get("kernel", "ellipse") != "ellipse":
                raise MemoryFileError(
                    f"Gaussians that are compressed or no ellipsoids ({str(extension)[:80]}); "
                    f"expected plain {KHR}; save it without compression"
                )
            if extension.get("colorSpace", SRGB) != SRGB:
                raise MemoryFileError(
                    f"colours in {extension['colorSpace']!r:.40}; expected {SRGB}; save it in sRGB"
                )
            rows = _glb_rows(tree, body, part["attributes"])
            parts.append(place_gaussians(rows, rigid_poses(back) @ matrix))
            if sum(len(values) for values, _ in parts) * LEAST_BYTES > len(body):
                raise ValueError("nodes that draw a set several times")
    values, center = _joined(parts)
    return _splats(values, center=center, up=up)


def _glb_rows(tree: dict[str, Any], body: bytes, attributes: Mapping[str, int]) -> Float32:
    def array(name: str) -> Float32:
        return glb_numbers(tree, body, attributes[name])

    sh = [
        array(f"{KHR}:SH_DEGREE_{degree}_COEF_{term}")
        for degree in range(4)
        if f"{KHR}:SH_DEGREE_{degree}_COEF_0" in attributes
        for term in range(2 * degree + 1)
    ]
    if len(sh) not in TERMS:
        raise ValueError(f"{len(sh)} coefficients of a colour")
    return _rows(
        array("POSITION"), _logarithms(array(f"{KHR}:SCALE")),
        np.roll(array(f"{KHR}:ROTATION"), 1, axis=1), logits=_logits(array(f"{KHR}:OPACITY")),
        sh=np.stack(sh, axis=1),
    )  # fmt: skip


def _read_usd(path: Path) -> Splats:
    require("pxr", extra="export", purpose=f"{path}: {path.suffix}")
    facts, parts = zip(*read_apart(USD, path), strict=True)
    placed = [place_gaussians(part["values"], part["matrix"]) for part in parts if "values" in part]
    values, center = _joined(placed)
    return _splats(values, center=center, up=unit(facts[0].get("up")))


def usd(path: Path) -> Iterator[Item]:
    """What is up, and what each prim of Gaussians or of points holds, for ``read_apart``.

    Rows and frame of each ParticleField3DGaussianSplat; positions and linear colours of each
    UsdGeom.Points, in the file's frame, before an export turned that upright.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom

    yield {"bytes_per_byte": USD_BYTES_PER_BYTE}, {}
    layer = Sdf.Layer.OpenAsAnonymous(str(path))
    if layer is None or layer.GetCompositionAssetDependencies():
        raise MemoryFileError("damaged, or names other files; expected one USD layer")
    cache, stage = UsdGeom.XformCache(), Usd.Stage.Open(layer)
    told, axis = layer.customLayerData, UsdGeom.GetStageUpAxis(stage)
    back, up = turn_back(told.get("turn")), unit(told.get("up"))
    if not {"turn", "up"} & {*told}:
        # Many programs keep the prim that turns, but no data of the layer.
        turns = [np.array(cache.GetLocalToWorldTransform(prim))[:3, :3]
                 for prim in stage.Traverse() if prim.GetName() == USD_ROOT]  # fmt: skip
        back = turns[0] / np.cbrt(np.linalg.det(turns[0])) if turns else back
    # Where an export turned the scene, up is the stage's axis; earlier ones only told it.
    if "turn" in told or (up is None and told.get("up") != Gf.Vec3d(*UNKNOWN)):
        up = back @ (0, axis == "Y", axis == "Z")
    yield {"up": None if up is None else up.tolist()}, {}
    back = rigid_poses(back)
    for prim in stage.Traverse():
        matrix = back @ np.array(cache.GetLocalToWorldTransform(prim)).T
        if prim.IsA(UsdGeom.Points):
            local = np.asarray(UsdGeom.Points(prim).GetPointsAttr().Get(), np.float64)
            positions = local.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
            colors = UsdGeom.Gprim(prim).GetDisplayColorAttr().Get()
            parts = {"positions": positions} | ({} if colors is None else {"colors": colors})
            yield {}, {name: np.asarray(part, np.float64) for name, part in parts.items()}
        if prim.GetTypeName() != "ParticleField3DGaussianSplat":
            continue

        def array(name: str, width: int, prim: Any = prim) -> NDArray[Any]:
            # Of half precision where there is none of single.
            values = prim.GetAttribute(name).Get()
            if values is None or not len(values):
                values = prim.GetAttribute(f"{name}h").Get()
            return np.asarray(values if values is not None else []).reshape(-1, width)

        positions = array("positions", 3)
        terms = TERMS[prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()]
        values = _rows(
            positions, _logarithms(array("scales", 3)),
            np.roll(array("orientations", 4), 1, axis=1), logits=_logits(array("opacities", 1)),
            sh=array("radiance:sphericalHarmonicsCoefficients", 3 * terms),
        )  # fmt: skip
        yield {}, {"values": values, "matrix": matrix}


READERS: Mapping[str, Callable[[Path], Splats]] = {
    ".ply": _read_ply,
    ".spz": _read_spz,
    ".sog": _read_sog,
    ".json": _read_sog,
    ".splat": _read_splat,
    ".ksplat": _read_ksplat,
    **dict.fromkeys(GLTF_ENDS, _read_glb),
    **dict.fromkeys(USD_ENDS, _read_usd),
}
