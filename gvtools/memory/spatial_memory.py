"""The persistent memory: coloured points in voxels, fused view by view, removable by round."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gvtools.cameras import Cameras, rigid_poses
from gvtools.errors import DegenerateError, GvError, MemoryFileError, OptionError, ShapeError
from gvtools.kernels import KernelSet
from gvtools.memory import fusion
from gvtools.memory.back_projection import BackProjectionOptions, back_project
from gvtools.memory.culling import in_free_space
from gvtools.memory.fusion import FuseReport
from gvtools.memory.splat.api import SplatOptions
from gvtools.memory.splat.cpu import resolve
from gvtools.memory.store.local_frame import LocalFrame
from gvtools.memory.store.observations import LAYOUT, rows_of
from gvtools.memory.store.store import MemoryOptions, Store
from gvtools.memory.store.tile import COLUMNS, DOUBLINGS, of_views
from gvtools.memory.store.tile_set import IN_RAM
from gvtools.memory.store.views import PointSet
from gvtools.memory.store.voxel_index import rounded_origin

__all__ = ["FuseReport", "MemoryOptions", "SpatialMemory", "TiledMemory"]

if TYPE_CHECKING:
    import open3d as o3d

    from gvtools.guidance import Guidance

# Nearest neighbours are looked up for this many points when a cloud gives no spacing.
NEIGHBOUR_SAMPLES = 20_000
# How far float colours may leave 0 to 1.
COLOR_SLACK = 0.01
# How far a point may be moved out of free space, and in what steps, as shares of its depth.
FARTHEST, STEP = 2.0, 1.02
# RAM for an observation: columns, index, its share of segments and of the log of agreements.
OBSERVATION_BYTES = 64


class SpatialMemory(Store):
    """A coloured point cloud that grows view by view.

    ``cloud`` is its store: an Open3D point cloud that shares the arrays which kernels write.

    Space is divided into voxels, wider ones (``MemoryOptions.voxels_per_footprint``) where it was
    seen coarsely; a voxel keeps several observations, each of which remembers the view it came
    from. Observations are appended and, once their round is over, never changed but for the
    confidence that later rounds add, so that a round can be forgotten exactly. With a budget, see
    TiledMemory, observations may lie in tiles on disk. See Store for the arguments.
    """

    def observe(
        self,
        rgb: NDArray[np.uint8] | NDArray[np.floating],
        depth: NDArray[np.float32] | None,
        camera: Cameras,
        *,
        round: int,
        mask: NDArray[np.bool_] | None = None,
        confidence: NDArray[np.float32] | None = None,
        generated: bool = False,
        options: BackProjectionOptions | None = None,
        pixel_binning: float = 0.0,
    ) -> FuseReport:
        """Lift the pixels of one view to points and fuse them.

        Args:
            rgb: (H, W, 3) uint8, as a photograph has it, or float from 0 to 1, as a completion.
            depth: (H, W) z-depth, scene units; 0, NaN and inf mean none.
            camera: a batch of one, of the same image size, in the world frame.
            round: see ``fuse``, as ``generated``.
            mask: (H, W), True = use.
            confidence: (H, W) of the source, > 0; None means 1.
            pixel_binning: see ``back_project``.

        Raises:
            OptionError: ``round`` lies before the last one.
            ShapeError: no depth, colours of another type or range, or images and camera disagree
                in size, or the camera is unusable.
        """
        if depth is None:
            raise ShapeError(
                f"{camera.names[0]}: no depth; expected (H, W) z-depth; a project without recorded "
                "depth gets it by gvtools.reconstruct"
            )
        rgb = to_uint8(rgb, camera.names[0])
        points = back_project(
            rgb, depth, camera, frame=self.frame, confidence=confidence, mask=mask,
            options=options, levels=self.levels, pixel_binning=pixel_binning, generated=generated,
        )  # fmt: skip
        report = self.fuse(points, round=round, generated=generated)
        return replace(report, dropped=dict(points.dropped))

    def behind_free_space(
        self, depth: NDArray[np.float32], camera: Cameras, *, where: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """Depth (H, W), moved back ``where`` an observed ray saw its place to be free.

        It becomes at most FARTHEST times as large; 0 where all of that is free.
        """
        where = where & (depth > 0)
        rows, columns = np.nonzero(where)
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
        pose = self.frame.local_from_cam(camera.world_from_cam[0])
        rays = pixels @ np.linalg.inv(camera.K[0]).T @ pose[:3, :3].T
        views, tolerance = self.observed_grids(), self.options.free_space_tolerance
        near = depth[where].astype(np.float64)
        moved, left, factor = near.copy(), np.arange(len(near)), 1.0
        while len(left):
            moved[left] = near[left] * factor
            points = (pose[:3, 3] + rays[left] * moved[left, None]).astype(np.float32)
            left = left[in_free_space(points, views, tolerance=tolerance)]
            factor *= STEP
            if factor > FARTHEST:
                moved[left] = 0
                break
        out = depth.copy()
        out[where] = moved
        return out

    def fuse(
        self, points: PointSet, *, round: int, generated: bool = False, scanned: bool = False
    ) -> FuseReport:
        """Take one view's points in.

        Args:
            points: in this memory's frame.
            round: 0 to 65535; not smaller than any round already there.
            generated: by a completer: they enter neither voxels that hold observed content nor
                space that an observed ray saw to be free.
            scanned: of a scan: they are observed, but shown only where no camera's observations
                are, with which they never merge.

        Raises:
            OptionError: ``round`` lies before the last one or out of range.
            ShapeError: the points are in another frame.
            ProjectError: the disk is full; what was there before is intact.
        """
        return fusion.fuse(self, points, round=round, generated=generated, scanned=scanned)

    def project(self, cameras: Cameras, *, options: SplatOptions | None = None) -> Guidance:
        """Project the memory into cameras of one size; see gvtools.memory.projection.project."""
        from gvtools.memory.projection import project

        return project(self, cameras, options=options)

    def overview(self, most: int | None = None) -> SpatialMemory:
        """A memory in RAM for what works on a whole memory; this one if it is there already.

        If all observations fit, it equals this memory without tiles, to the bit except for the
        order of agreements within a round. Otherwise it is made of thinned copies, in which each
        view keeps one observation for each cube of 4, or of 16, voxels a side; confidence that
        later rounds added to these stays if such a round is forgotten.

        ``most`` observations of a memory in tiles; None: as many as half of the budget holds.
        """
        if self.in_ram:
            return self
        if most is None:
            most = int(IN_RAM * (self.tiles.budget or 0)) // OBSERVATION_BYTES
        out = self.blank()
        for view in self.views:
            out.views.append(view)
        with self.tiles.lock:
            if len(self) <= most:
                columns, length = self._all_columns(out), self.segments.rows()["length"]
            else:
                columns, length = self._thinned_columns(most)
        columns |= of_views(columns["view"], self.views)
        out.columns.replace(int(length.sum(dtype=np.int64)), columns.__getitem__)
        rows = self.segments.rows()
        out.segments.follow(length, rows["view"], rows["box"])
        out.whole.rebuild_index()
        return out

    def _all_columns(self, out: SpatialMemory) -> dict[str, NDArray[Any]]:
        """Every column in the order of the table; agreements go to ``out``."""
        columns: dict[str, NDArray[Any]] = {}
        for name in COLUMNS:
            kind, width = LAYOUT[name]
            columns[name] = np.empty((len(self), width) if width > 1 else len(self), kind)
        for tile in self.tiles.each():
            length = self.segments.length[tile.segments].astype(np.int64)
            at = rows_of(self.segments.start[tile.segments], length)
            for name, column in columns.items():
                column[at] = tile.column(name)
            for round_, (rows, weights, before) in tile.agreements():
                entry = (at[rows].astype(np.int32), weights, before)
                out.agreements.setdefault(round_, []).append(entry)
        return columns

    def _thinned_columns(self, most: int) -> tuple[dict[str, NDArray[Any]], NDArray[np.int32]]:
        """Columns of the finest thinned copies that fit, else of the coarsest; and (n,) lengths."""
        tiles, n = self.tiles, self.segments.count
        for doublings in DOUBLINGS:
            if sum(int(tile.thinned(doublings).start[-1]) for tile in tiles.each()) <= most:
                break
        kind = np.full(n, doublings, np.uint8)
        found = tiles.gather(self.segments, np.arange(n), doublings=kind)
        columns: dict[str, NDArray[Any]] = found.columns._asdict()
        columns["view"] = np.repeat(self.segments.view[:n], found.length)
        columns["level"] = np.repeat(tiles.places.level[:n], found.length)
        return columns, found.length

    def blank(self) -> SpatialMemory:
        """An empty memory in RAM of the same voxels, frame and options."""
        frame = self.frame
        return SpatialMemory(self.voxel, origin=frame.origin, axes=frame.axes, options=self.options)

    def save(self, path: Path | str) -> Path:
        """Write the memory to a file, or to a folder of tiles; what was there stays if that fails.

        Tiles go to the folder of the same name with the suffix ``.tiles``. Returns where it is.
        """
        from gvtools.memory.files import save_memory, save_tiles, tile_folder

        if not self.in_ram:
            return save_tiles(self, tile_folder(Path(path)))
        save_memory(self, Path(path))
        return Path(path)

    @classmethod
    def load(cls, path: Path | str) -> SpatialMemory:
        """Read a memory's file; see gvtools.memory.files."""
        from gvtools.memory.files import load_memory

        return load_memory(Path(path), cls)

    @classmethod
    def from_ply(cls, path: Path | str) -> SpatialMemory:
        """Read a coloured binary PLY as a memory, see ``from_point_cloud``."""
        from gvtools.memory.ply import read_point_cloud

        cloud = read_point_cloud(Path(path))
        try:
            return cls.from_point_cloud(cloud, name=Path(path).name)
        except GvError as error:
            raise MemoryFileError(f"{path}: {error}") from None

    @classmethod
    def from_point_cloud(
        cls,
        cloud: o3d.t.geometry.PointCloud,
        *,
        voxel: float | None = None,
        frame: LocalFrame | None = None,
        options: MemoryOptions | None = None,
        name: str = "cloud",
    ) -> SpatialMemory:
        """A memory of an Open3D point cloud: its points are fused, one observation a voxel.

        A cloud does not tell from where its points were seen: a camera in their midst stands for
        it, once for each combination of ``round``, ``view`` and source. Observations that
        a memory keeps apart by direction therefore merge: ``save`` and ``load``, or ``to("cpu")``,
        copy a memory as it is.

        Args:
            cloud: with ``positions`` and ``colors`` (uint8, or float from 0 to 1), and where it
                has them ``confidence`` (else 1), ``spacing`` (else the median distance between
                neighbours), ``generated`` and ``scanned`` (else observed by a camera), ``round``
                (else 0, and 1 for what was generated) and ``view`` (else one).
            voxel: edge of the voxels, scene units; None for the distance between neighbours.
            frame: that ``positions`` are in, as a memory's own ``cloud`` is in ``memory.frame``;
                None for the world's.
            options: None has one edge throughout: the points were seen as finely as they lie.
            name: of the camera.
        """
        columns = {key: cloud.point[key].cpu().numpy() for key in cloud.point}
        if "colors" not in columns or "positions" not in columns:
            raise ShapeError("no positions or no colours red, green, blue in the point cloud")
        finite = np.isfinite(columns["positions"]).all(axis=1)
        finite &= np.isfinite(columns["colors"]).all(axis=1)
        columns = {key: column[finite] for key, column in columns.items()}
        positions = columns["positions"].astype(np.float64)
        distance = _neighbour_distance(positions) or voxel or 0.0
        if not (distance > 0 and len(positions)):
            raise DegenerateError(f"{len(positions)} distinct points; expected at least two")
        edge = distance if voxel is None else voxel
        middle = positions.mean(axis=0)
        if frame is None:
            frame = LocalFrame.at(rounded_origin(middle, edge))
            positions = positions - frame.origin
        memory = cls(
            edge, origin=frame.origin, axes=frame.axes,
            options=options or MemoryOptions(voxels_per_footprint=0.0),
        )  # fmt: skip
        columns["positions"] = positions.astype(np.float32)
        memory._fuse_groups(columns, distance, name)
        if not len(memory):
            raise DegenerateError(
                f"none of its {len(positions)} points has a positive, finite confidence and spacing"
            )
        return memory

    def _fuse_groups(self, columns: dict[str, NDArray], distance: float, name: str) -> None:
        """Fuse a cloud's points, round by round and view by view."""
        count = len(columns["positions"])
        column = {key: values.reshape(count, -1)[:, 0] for key, values in columns.items()}
        colors = to_uint8(columns["colors"], name)
        generated = column.get("generated", np.zeros(count)) != 0
        scanned = column.get("scanned", np.zeros(count)) != 0
        round_ = column.get("round", generated).astype(np.int64)
        view = column.get("view", np.zeros(count)).astype(np.int64)
        spacing = column.get("spacing", np.full(count, distance)).astype(np.float32)
        confidence = column.get("confidence", np.ones(count)).astype(np.float32)
        (middle,) = self.frame.to_world(columns["positions"].mean(axis=0, dtype=float)[None])
        pose = rigid_poses(np.eye(3), -middle)
        keys = np.stack([round_, generated, scanned, view], axis=1)
        groups, group = np.unique(keys, axis=0, return_inverse=True)
        for i, (number, made, by_scan, row) in enumerate(groups.tolist()):
            label = f"{name} {row}" if "view" in column else name
            camera = Cameras.alike(np.eye(3), pose, size=(1, 1), names=(label,))
            rows = np.flatnonzero(group.reshape(-1) == i)
            points = PointSet(
                columns["positions"][rows], colors[rows], confidence[rows],
                spacing[rows], camera, self.frame, None, {},
            )  # fmt: skip
            self.fuse(points, round=number, generated=bool(made), scanned=bool(by_scan))


class TiledMemory(SpatialMemory):
    """A SpatialMemory with a budget of RAM: what outgrows it is kept in tiles on disk.

    It begins like any memory, wholly in RAM; once it takes more than half of its budget, its
    observations move to tiles, which cover cubes of space. Observations are the same to the bit,
    whatever the budget. Pictures are, too, unless a block (16 voxels a side) of wide voxels is
    larger than its tile; then colours are summed in another order there.

    Args:
        options: with a ``budget``; the others as those of Store.
        scratch: folder for the files of tiles that are not in RAM; None takes the system's for
            temporary files. They are deleted with the memory; ``save`` keeps them.

    >>> memory = TiledMemory(voxel=0.05, options=MemoryOptions(budget="400MB"))
    >>> len(memory), memory.in_ram
    (0, True)
    """

    def __init__(
        self,
        voxel: float,
        *,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        axes: ArrayLike | None = None,
        options: MemoryOptions | None = None,
        scratch: Path | None = None,
    ) -> None:
        super().__init__(voxel, origin=origin, axes=axes, options=options)
        _check_budget(self.options)
        self.tiles.budget, self.tiles.scratch = self.options.budget, scratch

    @classmethod
    def load(
        cls, path: Path | str, *, budget: int | None = None, scratch: Path | None = None
    ) -> TiledMemory:
        """Read a memory that was saved as a file or as tiles.

        Args:
            path: the path given to ``save``, or the folder of tiles.
            budget: bytes; None takes the budget saved with tiles.
            scratch: see TiledMemory; if given, the saved folder may be removed afterwards.
        """
        from gvtools.memory.files import load_memory, load_tiles, tile_folder

        folder = tile_folder(Path(path))
        if folder.is_dir():
            return load_tiles(cls, folder, budget=budget, scratch=scratch)
        _check_budget(MemoryOptions(budget=budget))
        memory = load_memory(Path(path), cls, budget=budget, scratch=scratch)
        memory.page_if_large()
        return memory


def _check_budget(options: MemoryOptions) -> None:
    if options.budget is None:
        raise OptionError("memory.budget none; expected bytes, such as 4GB; use SpatialMemory")


def to_uint8(colors: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """Colours (..., 3) as uint8: a photograph's as they are, float ones from 0 to 1 scaled."""
    if colors.dtype == np.uint8:
        return colors
    found = str(colors.dtype)
    if colors.dtype.kind == "f":
        low, high = float(colors.min(initial=0)), float(colors.max(initial=0))
        # Interpolated colours may leave the range by a rounding; NaN fails both comparisons.
        if low >= -COLOR_SLACK and high <= 1 + COLOR_SLACK:
            return np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
        found = f"{found} from {low:g} to {high:g}"
    raise ShapeError(f"{name}: colours {found}; expected uint8, or float from 0 to 1")


def _neighbour_distance(positions: NDArray[np.float64]) -> float:
    """The median distance of points to their nearest other, scene units; 0 without two."""
    from gvtools.o3d import o3d

    if len(positions) < 2:
        return 0.0
    near = positions - positions.mean(axis=0)
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(near))
    search.knn_index()
    sample = near[:: max(1, len(near) // NEIGHBOUR_SAMPLES)]
    _, squared = search.knn_search(o3d.core.Tensor(np.ascontiguousarray(sample)), 2)
    apart = np.sqrt(squared.numpy()[:, 1])
    apart = apart[apart > 0]
    return float(np.median(apart)) if apart.size else 0.0


def compile_kernels(backend: str = "cpu") -> None:
    """Compile, or load from numba's cache, what lifting, fusing and projecting need."""
    memory = SpatialMemory(0.1)
    rgb, depth = np.zeros((16, 16, 3), np.uint8), np.full((16, 16), 2, np.float32)
    trust, mask = np.ones((16, 16), np.float32), np.ones((16, 16), np.bool_)
    options = SplatOptions(nearest_views=1, backend=backend)
    for number, x in enumerate((0.0, 0.5, 1.0)):
        pose = rigid_poses(np.eye(3), (x, 0, 0))
        camera = Cameras.pinhole(16, 16, focal=16.0, cam_from_world=pose, name=f"{number}")
        memory.observe(
            rgb, depth - np.float32(x), camera, round=number, confidence=trust, mask=mask,
            generated=number == 2, pixel_binning=1.0,
        )  # fmt: skip
        memory.project(camera, options=options)


KERNELS = KernelSet("memory", compile_kernels, resolve)
