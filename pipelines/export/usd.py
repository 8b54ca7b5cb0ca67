"""Points as USD: ``UsdGeom.Points`` with widths and display colours.

Positions are float32 around the middle of the cloud; the parent's translation, in double, moves
them to the input's world frame. A scene unit is a metre, as glTF has it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gvtools.files import replaced_when_written
from pipelines.export.source import ExportOptions, Source, middle, points_summary

# Viewers are slow beyond it.
MAX_POINTS = 2_000_000
ROOT, CLOUD = "/gvtools", "/gvtools/memory"


def write(source: Source, path: Path, options: ExportOptions) -> str:
    """Write one point a voxel."""
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    memory = source.memory
    points = source.points(options, most=MAX_POINTS)
    columns, rows = memory.columns, points.rows
    center = middle(points.positions)
    stage = Usd.Stage.CreateInMemory()
    # Where a stage does not say, its unit is a centimetre: rooms would open far too small.
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    root = UsdGeom.Xform.Define(stage, ROOT)
    root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*center.tolist()))
    stage.SetDefaultPrim(root.GetPrim())
    stage.SetMetadata("comment", "gvtools memory, input world frame and axes, scene units")
    cloud = UsdGeom.Points.Define(stage, CLOUD)
    local = (points.positions - center).astype(np.float32)
    widths = np.maximum(columns.spacing[rows], np.float32(points.edge))
    cloud.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(local))
    cloud.CreateWidthsAttr(Vt.FloatArray.FromNumpy(widths))
    cloud.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    corners = np.stack([local.min(axis=0), local.max(axis=0)]).astype(np.float32)
    cloud.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
    primvars = UsdGeom.PrimvarsAPI(cloud)
    colors = _linear(points.colors)
    for name, kind, values in (
        ("displayColor", Sdf.ValueTypeNames.Color3fArray, Vt.Vec3fArray.FromNumpy(colors)),
        ("confidence", Sdf.ValueTypeNames.FloatArray,
         Vt.FloatArray.FromNumpy(columns.confidence[rows])),
        ("round", Sdf.ValueTypeNames.IntArray,
         Vt.IntArray.FromNumpy(columns.round[rows].astype(np.int32))),
        ("generated", Sdf.ValueTypeNames.IntArray,
         Vt.IntArray.FromNumpy(columns.generated[rows].astype(np.int32))),
        ("scanned", Sdf.ValueTypeNames.IntArray,
         Vt.IntArray.FromNumpy(memory.scanned[rows].astype(np.int32))),
    ):  # fmt: skip
        primvars.CreatePrimvar(name, kind, UsdGeom.Tokens.vertex).Set(values)
    with replaced_when_written(path, suffix=path.suffix.lower()) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise OSError("USD wrote no file")
    return f"{points_summary(points, memory)} in {path}, in the input's axes"


def _linear(colors: np.ndarray) -> np.ndarray:
    """Bytes of sRGB as the linear light that USD's colours are, (N, 3) float32."""
    share = np.arange(256) / 255
    table = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[colors]
