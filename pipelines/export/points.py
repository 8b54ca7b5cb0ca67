"""Point clouds: PLY with all attributes, LAS 1.4 or LAZ, USD, glTF binary.

Positions keep their precision in georeferenced scenes: LAS has whole multiples of a step from an
offset; USD and glTF have float32 around the middle of the cloud, which the parent's translation, or
the node's, moves to the input's world frame for readers that compute in double. PLY and LAS have
the input's axes; glTF and USD stand upright where it is known what is up.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.errors import GvError
from gvtools.files import replaced_when_written
from gvtools.glb import UNKNOWN, UPRIGHT, pack_glb
from gvtools.memory.ply import export_memory_ply
from gvtools.ply import up_comment
from gvtools.runs.run import load_run
from gvtools.splat_files import USD_ROOT
from gvtools.splats import box_middle
from pipelines.export.formats import ExportOptions
from pipelines.export.source import ExportSource

# LAS: point format 7 has colours of 16 bits.
POINT_FORMAT, VERSION = 7, "1.4"
# Steps of coordinates in a voxel, at least, and the largest number of them.
STEPS_PER_VOXEL, MOST_STEPS = 10, 2**31 - 1
# Bytes of a record in a LAS's head, less its end.
MOST_WKT = 65_534
# glTF's extension that shows colours as they are.
UNLIT = "KHR_materials_unlit"
# 8 bits to 16: 255 becomes 65535.
TO_16_BITS = 257
# Viewers of USD and glTF are slow beyond it.
MAX_POINTS = 2_000_000
ROOT, CLOUD = f"/{USD_ROOT}", f"/{USD_ROOT}/memory"
NODE = "gvtools_memory"
FRAME = "input world frame and axes, scene units; any node around this one turns what is up to y"
# What is up is along an axis from this share of its length on.
LEVEL = 1 - 1e-9


def write_ply(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write every observation, or one a voxel where a number of points is given."""
    memory, observed = source.memory, options.observed
    points, edge = export_memory_ply(
        memory, path, max_points=options.max_points, observed=observed, up=source.up
    )
    thinned = f", thinned to voxels of {edge:.4g}" if edge else ""
    return f"{points} of {len(memory)} observations{thinned} in {path}"


def write_las(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write one point a voxel; LAS's own flag "synthetic" also says what a completer made."""
    import laspy

    memory = source.memory
    points = source.points(options)
    columns, rows = memory.columns, points.rows
    header = laspy.LasHeader(point_format=POINT_FORMAT, version=VERSION)
    header.generating_software = "gvtools"
    # What point formats from 6 on have to say.
    header.global_encoding.wkt = True
    crs, told = _crs(source)
    if crs:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(crs))
    for line in up_comment(source.up):
        header.vlrs.append(laspy.VLR("gvtools", 1, "what is up: x y z", line.encode()))
    header.offsets = np.round(points.middle)
    reach = float(np.abs(points.positions - header.offsets).max())
    # A power of ten, as other software writes it.
    step = 10.0 ** np.floor(np.log10(memory.voxel / STEPS_PER_VOXEL))
    while reach / step > MOST_STEPS:
        step *= 10
    header.scales = np.full(3, step)
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("confidence", "f4", "sum over the views that saw it"),
            laspy.ExtraBytesParams("spacing", "f4", "footprint of a pixel, units"),
            laspy.ExtraBytesParams("round", "u2", "that it came with"),
            laspy.ExtraBytesParams("generated", "u1", "1: made by a completer"),
            laspy.ExtraBytesParams("scanned", "u1", "1: of a scan, no photograph"),
        ]
    )
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.positions.T
    cloud.red, cloud.green, cloud.blue = points.colors.astype(np.uint16).T * TO_16_BITS
    cloud.return_number[:] = cloud.number_of_returns[:] = 1
    cloud.synthetic[:] = columns.generated[rows]
    for name in ("confidence", "spacing", "round", "generated"):
        cloud[name] = getattr(columns, name)[rows]
    cloud["scanned"] = memory.scanned[rows]
    with replaced_when_written(path) as temporary, temporary.open("wb") as file:
        cloud.write(file, do_compress=path.suffix.lower() == ".laz")
    return f"{source.points_summary(points)} in {path}, coordinates in steps of {step:g}{told}"


def _crs(source: ExportSource) -> tuple[str, str]:
    """WKT of the coordinate system of the run's scan where it is the memory's, and what is said."""
    try:
        run = source.path if source.path.is_dir() else source.path.parent
        scan = load_run(run).rounds[0].get("scan") or {}
        crs = str(scan.get("crs") or "")
        placement = np.array(scan["placement"]["world_from_scan"]) if crs else np.eye(4)
    except (GvError, LookupError, TypeError, AttributeError, ValueError):
        return "", ""
    if not np.array_equal(placement, np.eye(4)):
        return "", "; not in the scan's coordinate system (--cloud-placement moved it)"
    wkt, left_out = crs, f"; the scan's {crs[:60]} is left out: "
    if crs.startswith("EPSG:"):
        try:
            from pyproj import CRS
            from pyproj.exceptions import CRSError
        except ImportError:
            return "", left_out + "WKT of it needs pyproj (pip install pyproj)"
        wkt = ""
        # Numbers of heights are often those of older lists: then the one of the map alone.
        for code in (crs.partition("+")[0], crs):
            with suppress(CRSError):
                wkt = str(CRS.from_user_input(code).to_wkt("WKT1_GDAL"))
        if not wkt:
            return "", left_out + "pyproj knows no such number"
    if len(wkt) > MOST_WKT:
        return "", left_out + "too long"
    return wkt, f", in the scan's coordinate system ({wkt[:60]})" if wkt else ""


def write_usd(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write one point a voxel as ``UsdGeom.Points``; a scene unit is a metre, as glTF has it."""
    from pxr import Sdf, UsdGeom, Vt

    memory = source.memory
    points = source.points(options, most=MAX_POINTS)
    columns, rows = memory.columns, points.rows
    center = points.middle
    stage = usd_stage(center, source.up)
    cloud = UsdGeom.Points.Define(stage, CLOUD)
    local = (points.positions - center).astype(np.float32)
    widths = np.maximum(columns.spacing[rows], np.float32(points.edge))
    cloud.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(local))
    cloud.CreateWidthsAttr(Vt.FloatArray.FromNumpy(widths))
    cloud.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    corners = np.stack([local.min(axis=0), local.max(axis=0)]).astype(np.float32)
    cloud.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
    primvars = UsdGeom.PrimvarsAPI(cloud)
    colors = linear(points.colors / 255)
    for name, kind, values in (
        ("displayColor", Sdf.ValueTypeNames.Color3fArray, Vt.Vec3fArray.FromNumpy(colors)),
        ("confidence", Sdf.ValueTypeNames.FloatArray,
         Vt.FloatArray.FromNumpy(columns.confidence[rows])),
        *((name, Sdf.ValueTypeNames.IntArray, Vt.IntArray.FromNumpy(whole[rows].astype(np.int32)))
          for name, whole in (("round", columns.round), ("generated", columns.generated),
                              ("scanned", memory.scanned))),
    ):  # fmt: skip
        primvars.CreatePrimvar(name, kind, UsdGeom.Tokens.vertex).Set(values)
    with replaced_when_written(path, suffix=path.suffix.lower()) as temporary:
        save_usd(stage, temporary)
    return f"{source.points_summary(points)} in {path}{axes_of(source.up)}"


def turn_upright(up: NDArray[np.float64] | None) -> list[float]:
    """Quaternion x, y, z, w of the shortest turn that takes ``up`` to y; none where none is needed.

    >>> turn_upright(np.array([0.0, -1, 0])), turn_upright(np.array([0.0, 1, 0]))
    ([1.0, 0.0, 0.0, 0.0], [])
    """
    if up is None or up[1] > LEVEL:
        return []
    # Half around x where up is down.
    turn = np.array([-up[2], 0, up[0], 1 + up[1]]) if up[1] > -LEVEL else np.array([1.0, 0, 0, 0])
    return (turn / np.linalg.norm(turn)).tolist()


def axes_of(up: NDArray[np.float64] | None) -> str:
    """What is said of the axes of a GLB or USD."""
    if up is not None:
        return ", turned upright"
    return (
        ", in the input's axes: nothing tells what is up, and other programs may show it on its "
        "side or upside down (--up X Y Z turns it)"
    )


def usd_stage(center: NDArray[np.float64], up: NDArray[np.float64] | None) -> Any:
    """A stage whose root moves what it holds to ``center`` and turns it upright, see its data."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    # Where a stage does not say, its unit is a centimetre: rooms would open far too small.
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    root, told = UsdGeom.Xform.Define(stage, ROOT), dict[str, Any]()
    # USD knows y and z.
    upright = up is None or up[2] > LEVEL
    UsdGeom.SetStageUpAxis(stage, "Z" if upright else "Y")
    turn = [] if upright else turn_upright(up)
    if turn:
        x, y, z, w = turn
        root.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
        told["turn"] = Gf.Vec4d(*turn)
    told["up"] = Gf.Vec3d(*(UNKNOWN if up is None else up.tolist()))
    stage.GetRootLayer().customLayerData = told
    root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*center.tolist()))
    stage.SetDefaultPrim(root.GetPrim())
    stage.SetMetadata("comment", f"gvtools, scene units, input world frame and axes below {ROOT}")
    return stage


def save_usd(stage: Any, path: Path) -> None:
    """Write a stage's own layer."""
    if not stage.GetRootLayer().Export(str(path)):
        raise OSError("USD wrote no file")


def linear(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Colours of sRGB in [0, 1] as the linear light that USD's and glTF's are, little-endian."""
    light = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return light.astype("<f4")


def write_glb(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write one point a voxel with its colour; the node's extras tell origin, frame and up."""
    points = source.points(options, most=MAX_POINTS)
    save_glb(
        path,
        points.positions,
        {"COLOR_0": linear(points.colors / 255)},
        name=NODE, up=source.up, extras={"voxel": points.edge},
        primitive={"mode": 0, "material": 0}, materials=[unlit()], extensionsUsed=[UNLIT],
    )  # fmt: skip
    return f"{source.points_summary(points)} in {path}{axes_of(source.up)}"


def save_glb(
    path: Path,
    positions: NDArray[np.floating[Any]],
    attributes: Mapping[str, NDArray[Any]],
    *,
    name: str,
    up: NDArray[np.float64] | None,
    extras: Mapping[str, Any] | None = None,
    **rest: Any,
) -> None:
    """Write a GLB whose node moves positions (N, 3) around 0 to where they are, see ``pack_glb``.

    Its extras tell that move, the frame, what is up, and how a node around it turns that to y.
    """
    center = box_middle(positions.astype(np.float64))
    told, around = {"origin": center.tolist(), "frame": FRAME, **(extras or {})}, None
    told["up"] = UNKNOWN if up is None else up.tolist()
    turn = turn_upright(up)
    if turn:
        told["turn"], around = turn, {"name": UPRIGHT, "rotation": turn}
    node = {"name": name, "translation": center.tolist(), "extras": told}
    local = (positions - center).astype(np.float32)
    packed = pack_glb({"POSITION": local, **attributes}, node=node, around=around, **rest)
    with replaced_when_written(path) as temporary:
        temporary.write_bytes(packed)


def unlit(**physical: Any) -> dict[str, Any]:
    """A material that no light shines on."""
    physical |= {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"pbrMetallicRoughness": physical, "extensions": {UNLIT: {}}}
