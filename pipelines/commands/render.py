"""``gvtools render`` and ``film``: a saved memory as pictures, figures and films."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from gvtools.errors import OptionError
from gvtools.runs.layout import file_stems
from gvtools.settings import with_texts
from pipelines.commands.arguments import EMPTY, LensArguments, LpipsArguments, SceneArguments
from pipelines.options import JsonArguments

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gvtools.cameras import Cameras
    from gvtools.memory.spatial_memory import SpatialMemory
    from gvtools.memory.splat.api import SplatOptions
    from gvtools.scenes.scene import Scene
    from pipelines.console import Console


# Views of which it is looked at whether other pictures fit them better.
LOOKED = 8


class RenderCommand(LensArguments, LpipsArguments, SceneArguments, JsonArguments):
    """Project a saved memory into cameras, and measure it against their pictures."""

    examples = (
        "gvtools render runs/kitchen --cameras scans/kitchen --views every:20 --out renders",
        "gvtools render runs/kitchen --cameras scans/kitchen --views every:20+10 --against-images "
        "--out renders --json figures.json",
        "gvtools render runs/kitchen --cameras scans/kitchen --views first:1 "
        "--lens equirectangular --out panoramas",
    )
    positional = ("memory",)

    memory: Path
    """A memory.npz or a run. [MEMORY_OR_RUN]"""
    cameras: Path
    """A project whose cameras to take, a transforms.json such as 'gvtools view' saves, or a TUM or
    KITTI trajectory (camera as the memory's first view). [PROJECT]"""
    views: str = "all"
    """Which. [SPEC]"""
    out: Path | None = None
    """For the pictures; with --against-images it may be left out, for the figures alone. [DIR]"""
    complete: bool = False
    """Fill what the memory leaves open (inpaint)."""
    against_images: bool = False
    """Compare with the project's own pictures."""
    set: tuple[str, ...] = ()
    """A setting of the projection, such as splat.depth_band=0.03. [splat.KEY=VALUE]"""
    backend: str | None = None
    """Short for --set splat.backend=NAME (cpu, torch, ...). [NAME]"""
    device: str | None = None
    """Short for --set splat.device=NAME (auto, cpu, cuda). [NAME]"""

    def run(self, console: Console) -> None:
        from gvtools.memory.panoramas import WIDEST_STILL
        from gvtools.runs.run import load_appearance, load_memory
        from gvtools.scenes.inspection import spread
        from pipelines import rendering

        if self.out is None and not self.against_images:
            raise OptionError("--out: nothing would be left; give a folder, or --against-images")
        short = {"backend": self.backend, "device": self.device}
        given = [f"splat.{key}={value}" for key, value in short.items() if value is not None]
        options = splat_options([*given, *self.set])
        memory, appearance = load_memory(self.memory), load_appearance(self.memory)
        if not len(memory.views):
            raise OptionError(f"{self.memory}: {EMPTY}")
        cameras, scene, poses = self._cameras(memory)
        if poses:
            console.line(poses)
        rig, cameras = self.rig(cameras, memory, widest=WIDEST_STILL)
        stems = file_stems(cameras.names)
        if self.complete:
            faces = rig.faces_of(cameras) if rig else cameras
            rendering.complete_views(memory, faces, appearance=appearance)
        lpips, no_lpips = self.open_lpips() if self.against_images else (None, None)
        # The first projection compiles or loads the kernels and is not timed.
        memory.project(cameras[0], options=options)
        views, shown = [], dict[str, Any]()
        looked = [cameras.names[row] for row in spread(len(cameras), LOOKED)]
        for camera in console.track(list(cameras), "rendering"):
            (name,) = camera.names
            guidance, seconds = rendering.render_view(
                memory, camera, options, appearance=appearance, rig=rig,
                fill=rendering.filled if self.complete else None,
            )  # fmt: skip
            frame = scene[name].load() if scene is not None and self.against_images else None
            shown |= {} if frame is None or name not in looked else {name: guidance}
            if self.out is not None:
                panorama = self.lens == "equirectangular"
                rendering.write_view(self.out, stems[name], guidance, panorama=panorama)
            views.append(rendering.measure(name, guidance, frame, seconds=seconds, lpips=lpips))
            if rig is not None:
                views[-1]["coverage"] = float(guidance.valid[0][rig.inside].mean())
        figures = rendering.summary(views, compared=self.against_images, no_lpips=no_lpips)
        if other := rendering.other_pictures(scene, shown, figures["psnr_valid"]):
            console.warn(f"the pictures of {self.cameras} seem to be {other}")
        if poses:
            figures["poses"] = poses
        if not self.write_json(figures):
            columns = ("view", "psnr", "ssim", "psnr_valid", "ssim_valid", "depth_rel_valid",
                       "coverage", "seconds")  # fmt: skip
            mean = {**figures, "view": "all", "seconds": figures["seconds_per_view"]}
            console.table(columns, [[row[column] for column in columns] for row in [*views, mean]])
            for reason in dict.fromkeys(figures["notes"].values()):
                keys = [key for key, note in figures["notes"].items() if note == reason]
                console.line(f"{', '.join(keys)}: {reason}")
        if self.out is not None:
            console.line(f"{len(views)} views in {self.out}")

    def _cameras(self, memory: SpatialMemory) -> tuple[Cameras, Scene | None, str]:
        """The chosen cameras, their project, if it is one, and what is said of its poses."""
        import numpy as np

        from gvtools.cameras import concatenate
        from gvtools.runs.run import at_run_poses, said_of_path
        from gvtools.scenes.selection import select

        scene, poses = None, said_of_path(self.cameras, self.memory)
        cameras = self._path(memory) if self.cameras.is_file() else None
        if cameras is None:
            scene, poses = at_run_poses(self.open_scene(self.cameras), self.memory, memory)
            cameras = scene.cameras
        if self.against_images:
            if scene is None:
                raise OptionError(
                    f"--against-images: {self.cameras} is a trajectory without pictures; give a "
                    "project"
                )
            if self.lens != "perspective" or self.width:
                raise OptionError(
                    "--against-images: compares pictures as the project has them; leave --lens and "
                    "--width out"
                )
        cameras = cameras[list(map(cameras.names.index, select(cameras.names, self.views)))]
        if self.lens == "perspective" and self.width:
            heights = np.maximum(np.rint(cameras.height * self.width / cameras.width), 1)
            pairs = zip(cameras, heights.astype(int).tolist(), strict=True)
            cameras = concatenate([camera.resized(self.width, height) for camera, height in pairs])
        return cameras, scene, poses

    def _path(self, memory: SpatialMemory) -> Cameras | None:
        """The cameras of a file without pictures; None for a project."""
        from gvtools.cameras import concatenate
        from gvtools.scenes.layout import holds_views
        from gvtools.scenes.transforms import read_camera_path

        # A PLY's view has no camera of its own.
        from_ply = self.memory.suffix.lower() == ".ply"
        photographed = () if from_ply else memory.views.photographed
        if not photographed and not holds_views(self.cameras):
            raise OptionError(
                f"--cameras {self.cameras}: a trajectory takes its camera from the memory's views, "
                f"and {self.memory} has none of a photograph; give a run, its memory.npz, or a "
                "project as --cameras"
            )
        captured = concatenate([view.camera for view in photographed]) if photographed else None
        return read_camera_path(self.cameras, captured)


def splat_options(texts: Sequence[str]) -> SplatOptions:
    """The projection's options, changed by ``splat.KEY=VALUE`` texts."""
    from pipelines.reconstruction.settings import RunSettings

    for text in texts:
        if not text.strip().startswith("splat."):
            raise OptionError(f"--set {text!r}: render takes splat.KEY=VALUE alone")
    return with_texts(RunSettings(), texts).splat


class FilmCommand(LensArguments):
    """Write a film of a path through a memory."""

    examples = (
        "gvtools film runs/kitchen --path spiral:240 --out kitchen.mp4",
        "gvtools film runs/kitchen --path orbit:120 --compare observed,completed --out both.mp4",
        "gvtools film runs/kitchen --path interpolate:60 --growth --width 480 --out growth.gif",
        "gvtools film runs/kitchen --path interpolate:240 --lens equirectangular --out around.mp4",
    )
    positional = ("memory",)
    exclusive = (("complete", "depth", "compare"),)

    memory: Path
    """A run or a memory.npz. [RUN_OR_MEMORY]"""
    path: str = "interpolate"
    """orbit:N, spiral:N, interpolate:N (N frames, 120 by default), cameras (the captured views), a
    TUM or KITTI file, a transforms.json such as 'gvtools view' saves, or a project (these also
    PATH@SELECTION). [PATH]"""
    out: Path
    """FILE.mp4, FILE.gif or FILE.webp. [FILE]"""
    fps: float = Field(24.0, ge=0.01, le=240)
    """Frames a second. [N]"""
    round: int | None = None
    """The memory as it was after round R. [R]"""
    complete: bool = False
    """Fill what the memory leaves open (inpaint)."""
    depth: bool = False
    """Depth in colours, near is red."""
    compare: str | None = None
    """Panels side by side, of memory, observed, completed, depth. [A,B]"""
    growth: bool = False
    """The path once for each round, as memory was then."""

    def run(self, console: Console) -> None:
        from gvtools.memory.panoramas import WIDEST_FRAME
        from gvtools.runs.run import load_memory
        from pipelines import rendering

        rendering.check_suffix(self.out)
        if self.growth:
            self.refuse(("round",), "--growth shows every one")
        panels = _panels(self)
        memory = load_memory(self.memory, up_to=self.round)
        if not len(memory):
            raise OptionError(f"{self.memory}: {EMPTY}")
        width = self.width if self.lens == "perspective" else None
        cameras = rendering.film_cameras(
            memory, self.path, width=width, run=self.memory, say=console.line
        )
        rig, cameras = self.rig(cameras, memory, widest=WIDEST_FRAME)
        columns, rows = rig.size if rig else (int(cameras.width[0]), int(cameras.height[0]))
        rounds = memory.rounds if self.growth else (self.round,)
        del memory
        start, projecting = time.perf_counter(), 0.0

        def frames() -> Iterator[NDArray[np.uint8]]:
            nonlocal projecting
            for number in rounds:
                renderer = rendering.FilmRenderer(self.memory, cameras, up_to=number, rig=rig)
                of_round = f" of round {number}" if self.growth else ""
                for index in console.track(range(len(cameras)), f"drawing frames{of_round}"):
                    frame = renderer.frame(index, panels, captions=len(panels) > 1)
                    if self.growth and len(panels) == 1:
                        frame = rendering.captioned(frame, f"round {number}")
                    yield frame
                projecting += renderer.projecting

        panorama = self.lens == "equirectangular" and len(panels) == 1
        left_out = rendering.write_film(self.out, frames(), fps=self.fps, panorama=panorama)
        if left_out:
            console.warn(
                f"{self.out}: {left_out} frames left out: browsers show what stands for less than "
                f"{rendering.LEAST_SHOWN} ms ten times as long; give --fps "
                f"{1000 // rendering.LEAST_SHOWN} or fewer, or an .mp4"
            )
        count = len(cameras) * len(rounds)
        each = (time.perf_counter() - start) / count
        console.line(
            f"{self.out}: {count} frames of {len(panels) * columns}x{rows}, "
            f"{count / self.fps:.1f} s; {each:.3f} s a frame, of which "
            f"projecting {projecting / count:.3f}"
        )


def _panels(args: FilmCommand) -> tuple[str, ...]:
    from pipelines.rendering import PANELS

    if args.complete:
        return ("completed",)
    if args.depth:
        return ("depth",)
    if args.compare is None:
        return ("memory",)
    panels = tuple(args.compare.split(","))
    unknown = [panel for panel in panels if panel not in PANELS]
    if unknown or len(panels) < 2:
        raise OptionError(
            f"--compare {args.compare!r}; expected two or more of {', '.join(PANELS)}, by commas"
        )
    return panels
