"""The table of formats that ``gvtools export`` writes.

A format is one line here and one function

    write(source, path, options) -> str

which writes ``source`` (see ``pipelines.export.source``) to ``path`` and returns the line that the
user is told.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from gvtools.errors import OptionError
from gvtools.optional import require
from gvtools.settings import Settings
from pipelines.options import check_ending

# How files of SPZ begin, of version 4 and older, and what is read of a file to know its format.
SPZ, HEAD_BYTES = (b"NGSP", b"\x1f\x8b"), 64
# What every point format takes, and what a mesh takes beside it.
POINTS = ("max_points", "observed", "up")
SPLATS = (*POINTS, "spz_version")
MESH = ("observed", "up", "method", "voxel", "least_piece", "max_triangles", "texture")
FormatName = Literal[
    "ply", "splat", "spz", "html", "mesh", "las", "usd", "rrd", "glb", "colmap", "transforms"
]


class ExportOptions(Settings):
    """What a user asks of an export, beside its format and place."""

    max_points: int | None = Field(None, ge=1)
    """Thin to at most N points, one a voxel (ply: all; colmap: 200000; html: 400000; rrd: 1
    million; glb, usd: 2 million; otherwise the memory's voxels). [N]"""
    observed: bool = False
    """Leave out what a completer made."""
    up: tuple[float, float, float] | None = None
    """What is up in the world frame, for files to tell (from the photographs or the file).
    [X Y Z]"""
    method: Literal["tsdf", "poisson"] = "tsdf"
    """Mesh: how it is made."""
    voxel: float | None = Field(None, gt=0)
    """Mesh: edge of the voxels that it is made in, scene units (from the memory's). [EDGE]"""
    least_piece: float = Field(0.001, ge=0, le=1)
    """Mesh: leave out connected pieces below this share of the largest one's area; 0 keeps all.
    [SHARE]"""
    max_triangles: int | None = Field(None, ge=1)
    """Mesh: simplify to at most N triangles. [N]"""
    texture: int | None = Field(None, ge=64, le=4096)
    """Mesh (.glb, .obj): colours from the run's photographs, in a picture of SIDE x SIDE; one
    triangle for 80 of its pixels, unless --max-triangles says otherwise. [SIDE]"""
    spz_version: int = Field(4, ge=2, le=4)
    """Splat, SPZ: version of the file, for programs that do not read the newest. [VERSION]"""
    images: str = "images"
    """Transforms: where the observed views' pictures are, beside the file; undistorted ones, if the
    project's were distorted. [DIR]"""


@dataclass(frozen=True)
class ExportFormat:
    """One line of the table; functions are named ``module.function`` of ``pipelines.export``."""

    name: FormatName
    writer: str
    holds: str  # what the files are, for ``--help``
    # That a file may have, and how such a file begins; none of what fills a folder.
    suffixes: Mapping[str, bytes | tuple[bytes, ...]] = field(default_factory=dict)
    options: tuple[str, ...] = ()  # of ``ExportOptions`` that it heeds
    needs: tuple[str, ...] = ()  # packages, as they are imported
    # Of a format without suffixes: what is at a path already and was not written by an export.
    foreign: str = ""

    def load(self) -> Callable[..., str]:
        """The function that writes it."""
        for package in self.needs:
            require(package, extra="export", purpose=f"--format {self.name}")
        writer: Callable[..., str] = _function(self.writer)
        return writer

    def check_path(self, path: Path, source: Path) -> None:
        """Refuse a place where the export may not write."""
        if not self.suffixes:
            there = _function(self.foreign)(path)
            if there is not None:
                raise OptionError(
                    f"{there}: is there already and was not written by gvtools export; expected a "
                    "free place or an earlier export; give another --out"
                )
            return
        start = self.suffixes[check_ending(path, self.suffixes)]
        if not path.is_file():
            return
        with path.open("rb") as file:
            alike = file.read(HEAD_BYTES).startswith(start)
        if not alike or (source.is_file() and path.samefile(source)):
            what = "the input" if alike else f"no {path.suffix[1:].upper()} file of this format"
            raise OptionError(f"{path}: is there already and is {what}; give another --out")


def _function(name: str) -> Any:
    module, _, function = name.partition(".")
    return getattr(import_module(f"pipelines.export.{module}"), function)


_ALL = (
    ExportFormat("ply", "points.write_ply", "point cloud with all attributes",
                 {".ply": b"ply"}, POINTS),
    ExportFormat("splat", "splats.write_splats", "3D Gaussians, in the format of the suffix",
                 {".ply": b"ply", ".spz": SPZ, ".sog": b"PK", ".splat": b"", ".ksplat": b"\0",
                  ".glb": b"glTF", ".usdc": b"PXR-USDC", ".usda": b"#usda"}, SPLATS),
    ExportFormat("spz", "splats.write_splats", "the same as splat", {".spz": SPZ}, SPLATS),
    ExportFormat("html", "html.write_html", "one page to share, which draws the 3D Gaussians",
                 {".html": b"<!DOCTYPE html>\n<!-- gvtools export -->"}, POINTS),
    ExportFormat("mesh", "mesh.write_mesh", "triangles with vertex colours or a texture",
                 {".ply": b"ply", ".glb": b"glTF", ".obj": b"# gvtools"}, MESH),
    ExportFormat("las", "points.write_las", "point cloud for GIS",
                 {".las": b"LASF", ".laz": b"LASF"}, POINTS, ("laspy", "lazrs")),
    ExportFormat("usd", "points.write_usd", "point cloud for Omniverse, Blender, Houdini",
                 {".usdc": b"PXR-USDC", ".usda": b"#usda"}, POINTS, ("pxr",)),
    ExportFormat("rrd", "rrd.write_rrd", "recording of the whole run for rerun",
                 {".rrd": b"RRF2"}, ("max_points", "up"), ("rerun",)),
    ExportFormat("glb", "points.write_glb", "point cloud for web viewers",
                 {".glb": b"glTF"}, POINTS),
    ExportFormat("colmap", "cameras.write_colmap", "COLMAP model",
                 options=("max_points",), foreign="cameras.foreign_model"),
    ExportFormat("transforms", "cameras.write_transforms", "cameras as transforms.json",
                 options=("images", "up"), foreign="cameras.foreign_transforms"),
)  # fmt: skip
FORMATS: Mapping[str, ExportFormat] = {each.name: each for each in _ALL}
