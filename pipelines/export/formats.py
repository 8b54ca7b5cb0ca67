"""The table of formats that ``gvtools export`` writes.

A format is one line here and one module with

    write(source, path, options) -> str

which writes ``source`` (see ``pipelines.export.source``) to ``path`` and returns the line that the
user is told. A format that fills a folder, or that shares its suffix, has a function
``foreign(path)`` beside it: what is there already and was not written by an export, or None.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from gvtools.errors import OptionError
from gvtools.optional import require

# What every point format takes, and what a mesh takes beside it.
POINTS = ("max_points", "observed")
MESH = ("observed", "method", "voxel", "max_triangles", "texture")


@dataclass(frozen=True)
class ExportFormat:
    """One line of the table.

    Attributes:
        name: as ``--format`` takes it.
        module: that writes it.
        holds: what the files are, for ``--help``.
        suffixes: that a file may have, and how such a file begins; empty: a folder is written, or
            the module knows.
        options: of ``ExportOptions`` that it heeds.
        needs: packages, as they are imported.
    """

    name: str
    module: str
    holds: str
    suffixes: Mapping[str, bytes] = field(default_factory=dict)
    options: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()

    def load(self) -> Any:
        """The module that writes it."""
        for package in self.needs:
            require(package, extra="export", purpose=f"--format {self.name}")
        return import_module(self.module)

    def check_path(self, path: Path, source: Path) -> None:
        """Whether the export may write there."""
        if self.suffixes:
            self._check_file(path, source)
            return
        found = import_module(self.module).foreign(path)
        if found is not None:
            raise OptionError(
                f"{found}: is there already and was not written by gvtools export; expected a free "
                "place or an earlier export; give another --out"
            )

    def _check_file(self, path: Path, source: Path) -> None:
        start = self.suffixes.get(path.suffix.lower())
        if start is None:
            expected = " or ".join(self.suffixes)
            raise OptionError(f"--out {path}: expected a name that ends with {expected}")
        if not path.is_file():
            return
        with path.open("rb") as file:
            alike = file.read(len(start)) == start
        if not alike or (source.is_file() and path.samefile(source)):
            what = "the input" if alike else f"no {path.suffix[1:].upper()} file"
            raise OptionError(f"{path}: is there already and is {what}; give another --out")


_ALL = (
    ExportFormat("ply", "pipelines.export.ply", "point cloud with all attributes",
                 {".ply": b"ply"}, POINTS),
    ExportFormat("splat", "pipelines.export.splat", "3D Gaussians, INRIA's PLY",
                 {".ply": b"ply"}, POINTS),
    ExportFormat("spz", "pipelines.export.spz", "3D Gaussians, compressed",
                 {".spz": b"\x1f\x8b"}, POINTS),
    ExportFormat("mesh", "pipelines.export.mesh", "triangles with vertex colours or a texture",
                 {".ply": b"ply", ".glb": b"glTF", ".obj": b"# gvtools"}, MESH, ("trimesh",)),
    ExportFormat("las", "pipelines.export.las", "point cloud for GIS",
                 {".las": b"LASF", ".laz": b"LASF"}, POINTS, ("laspy", "lazrs")),
    ExportFormat("usd", "pipelines.export.usd", "point cloud for Omniverse, Blender, Houdini",
                 {".usdc": b"PXR-USDC", ".usda": b"#usda"}, POINTS, ("pxr",)),
    ExportFormat("rrd", "pipelines.export.rrd", "recording of the whole run for rerun",
                 {".rrd": b"RRF2"}, ("max_points",), ("rerun",)),
    ExportFormat("glb", "pipelines.export.glb", "point cloud for web viewers",
                 {".glb": b"glTF"}, POINTS, ("trimesh",)),
    ExportFormat("colmap", "pipelines.export.colmap", "COLMAP model", options=("max_points",)),
    ExportFormat("transforms", "pipelines.export.transforms", "cameras as transforms.json",
                 options=("images",)),
)  # fmt: skip
FORMATS: Mapping[str, ExportFormat] = {each.name: each for each in _ALL}
