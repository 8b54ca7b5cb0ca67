"""Rendered views of a memory: pictures, figures and films.

The files of a view are NAME.rgb.png, NAME.depth.npz, NAME.valid.png and NAME.confidence.png. A
confidence c is drawn as the grey level 255 c / (1 + c): 1 is mid grey, and every c has its own side
of it. ``depth.npz`` holds the key ``depth``, float32, scene units, 0 = none.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvtools.appearance.appearance import Appearance
from gvtools.cameras import Cameras, concatenate
from gvtools.completers.base import create, run_completer
from gvtools.errors import OptionError
from gvtools.evaluation.images import FIGURES, Lpips, better_reading, view_figures
from gvtools.files import replaced_when_written
from gvtools.guidance import Guidance
from gvtools.memory.panoramas import Rig
from gvtools.memory.spatial_memory import SpatialMemory
from gvtools.memory.splat.api import SplatOptions
from gvtools.optional import require
from gvtools.runs.run import at_run_poses, load_appearance, load_memory, said_of_path
from gvtools.runs.target_files import to_bytes, write_png
from gvtools.scenes.inspection import spread
from gvtools.scenes.pixel_contradictions import frame_there
from gvtools.scenes.scene import Frame, Scene
from gvtools.scenes.transforms import read_camera_path
from gvtools.trajectories import PATHS, named_path
from pipelines.options import check_ending
from pipelines.reconstruction.rounds import CachedProjection, Clock, complete_targets
from pipelines.reconstruction.settings import RunSettings
from pipelines.spherical_metadata import mark_mp4, write_panorama
from viz.viewer.render import picture_of

# Other pictures fit where so much of the squared error is left; no scene's own has this PSNR.
NEARER, OTHER_SCENE = 0.7, 11


def render_view(
    memory: SpatialMemory,
    camera: Cameras,
    options: SplatOptions | None = None,
    *,
    appearance: Appearance | None = None,
    rig: Rig | None = None,
    fill: Callable[[Guidance], Guidance] | None = None,
) -> tuple[Guidance, float]:
    """One projection, with the colours of an appearance if there is one, and its seconds.

    Args:
        rig: of another lens than the camera's.
        fill: completes a pinhole camera's projection.
    """

    def view(face: Cameras) -> Guidance:
        guidance = memory.project(face, options=options)
        if appearance is not None:
            guidance = appearance.recolor(guidance, appearance.picture(face))
        return guidance if fill is None else fill(guidance)

    start = time.perf_counter()
    guidance = view(camera) if rig is None else rig.joined(map(view, rig.cameras(camera)), camera)
    return guidance, time.perf_counter() - start


def complete_views(
    memory: SpatialMemory, cameras: Iterable[Cameras], *, appearance: Appearance | None
) -> None:
    """Complete the views of pinhole cameras by ``inpaint`` in turn, and fuse what it filled.

    So what was filled looks the same from all of them, and from those between.
    """
    targets = [CachedProjection(memory, camera, appearance=appearance) for camera in cameras]
    for _ in complete_targets(
        targets, memory.rounds[-1] + 1, memory=memory, completer=create("inpaint"), context=(),
        config=RunSettings(), clock=Clock(),
    ):  # fmt: skip
        pass


def filled(guidance: Guidance) -> Guidance:
    """A projection, a batch of one, with its holes filled by ``inpaint``, as generated."""
    if guidance.valid.all() or not guidance.valid.any():
        return guidance
    completion = run_completer(create("inpaint"), (), guidance)
    return replace(
        guidance, rgb=completion.rgb, depth=completion.depth, valid=completion.depth > 0,
        generated=guidance.generated | ~guidance.valid,
    )  # fmt: skip


def measure(
    name: str,
    guidance: Guidance,
    frame: Frame | None,
    *,
    seconds: float,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """The figures of one view; those that need a picture are None without one.

    A picture's mask limits every comparison and leaves the coverage as it is. On all pixels, holes
    count as black.
    """
    figures: dict[str, Any] = {"view": name, "coverage": guidance.coverage, "seconds": seconds}
    figures |= dict.fromkeys(FIGURES)
    if frame is None:
        return figures
    generated = guidance.generated[0] & guidance.valid[0]
    return figures | view_figures(
        guidance.rgb[0],
        frame,
        observed=guidance.valid[0] & ~generated,
        generated=generated,
        depth=guidance.depth[0],
        lpips=lpips,
    )


def other_pictures(scene: Scene | None, shown: Mapping[str, Guidance], psnr: float | None) -> str:
    """What a project's pictures seem to be that are not those of views that are shown, or ""."""
    if scene is None or psnr is None or psnr < OTHER_SCENE:
        return "" if psnr is None else f"of another scene ({psnr:.1f} dB)"
    pictures, truths, ratios = [], [], []
    for name, guidance in shown.items():
        rgb, valid, at = to_bytes(guidance.rgb[0]), guidance.valid[0], scene.names.index(name)
        frames = [frame_there(scene, (at + step) % len(scene)) for step in (0, 1, -1)]
        around = [frame for frame in frames if frame and frame.rgb.shape == rgb.shape]
        if len(around) == 3 and valid.any():
            off = [np.subtract(frame.rgb, rgb, dtype=np.float32)[valid] for frame in around]
            own, *others = np.mean(np.square(off), axis=(1, 2))
            ratios.append(np.array(others) / max(own, 1))
            pictures.append(rgb)
            truths.append(Frame(around[0].rgb, mask=valid))
    least = np.median(ratios, axis=0) if ratios else np.ones(2)
    if min(least) < NEARER:
        way = "after" if least[0] < least[1] else "before"
        return f"renumbered: what is shown is nearer to the picture {way} each view's own"
    return better_reading(pictures, truths)


def summary(
    views: Sequence[dict[str, Any]], *, compared: bool, no_lpips: str | None
) -> dict[str, Any]:
    """Means over the views that have a figure (time: median), with reasons for what is missing.

    ``no_lpips`` is the reason why there is no LPIPS; None where there is.
    """
    out: dict[str, Any] = {}
    notes: dict[str, str] = {}
    for key in FIGURES:
        values = [view[key] for view in views if view[key] is not None]
        out[key] = statistics.fmean(values) if values else None
        if not compared:
            notes[key] = "not compared: add --against-images"
        elif key.startswith("lpips") and no_lpips is not None:
            notes[key] = no_lpips
        elif not values:
            notes[key] = _reason(key)
        elif len(values) < len(views):
            notes[key] = f"mean of {len(values)} of {len(views)} views; the others have no figure"
        if out[key] == float("inf"):
            notes[key] = "infinite: the pictures are equal"
    out["coverage"] = statistics.fmean(view["coverage"] for view in views)
    out["views"] = len(views)
    out["seconds_per_view"] = statistics.median(view["seconds"] for view in views)
    out["per_view"] = list(views)
    out["notes"] = notes
    return out


def _reason(key: str) -> str:
    if key.endswith("generated"):
        return "no generated content in view, or no reference there"
    if key.startswith("depth"):
        return "no reference depth where the memory is in view"
    return "no pixel to compare"


def write_view(
    folder: Path, stem: PurePosixPath, guidance: Guidance, *, panorama: bool = False
) -> None:
    """Write the four files of one view; sub-folders of ``stem`` are made, too.

    Of a panorama the picture is written as ``NAME.jpg`` besides: many viewers take no other.
    """
    confidence = guidance.confidence[0].astype(np.float64)
    pictures = {
        "rgb": to_bytes(guidance.rgb[0]),
        "valid": guidance.valid[0].astype(np.uint8) * 255,
        "confidence": np.round(255 * confidence / (1 + confidence)).astype(np.uint8),
    }
    base = folder / stem
    for kind, picture in pictures.items():
        with replaced_when_written(base.with_name(f"{base.name}.{kind}.png")) as temporary:
            (write_panorama if panorama and kind == "rgb" else write_png)(temporary, picture)
    if panorama:
        with replaced_when_written(base.with_name(f"{base.name}.jpg")) as temporary:
            write_panorama(temporary, pictures["rgb"], form="JPEG")
    path = base.with_name(f"{base.name}.depth.npz")
    with replaced_when_written(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, depth=guidance.depth[0].astype(np.float32))


Picture = NDArray[np.uint8]

CAPTURED = "cameras"
FRAMES = 120
FORMS = (
    f"{', '.join(f'{name}:N' for name in PATHS)}, {CAPTURED} (the captured views in order), a "
    "trajectory file (TUM or KITTI), a transforms.json such as 'gvtools view' saves, or a project, "
    "these as PATH or PATH@SELECTION"
)
# memory: the whole memory. observed: without completers' points. completed: the memory, holes
# filled by ``inpaint``. depth: of the memory, near is red, far is blue.
PANELS = ("memory", "observed", "completed", "depth")
# For "completed", so many frames of the path are completed and fused before the film is drawn, so
# that filled regions look the same from all frames.
KEY_FRAMES = 12
# The colours of depth span these percentiles of the depth of so many frames.
RANGE_FRAMES, RANGE = 9, (2.0, 98.0)
SUFFIXES = (".mp4", ".gif", ".webp")
# Number of the primaries and of the transfer of HD television (H.273).
BT709 = 1
# The least time that browsers show a frame of an animation for as they are told [ms].
LEAST_SHOWN = 20
# x264's constant rate factor: 18 is visually almost lossless, 23 is its default.
QUALITY = 18
WEBP_QUALITY = 80


def film_cameras(
    memory: SpatialMemory,
    path: str,
    *,
    width: int | None = None,
    run: Path | None = None,
    say: Callable[[str], object] = str,
) -> Cameras:
    """The cameras of a film's frames, all of one even size, as video coders need it.

    Args:
        memory: ``orbit`` and the like are computed from its observed views; the first of these
            gives intrinsics and size to paths that have none.
        width: of the frames, pixels; None keeps the cameras' width.
        run: whose refined poses the views of a project take, which ``say`` tells.
    """
    views = [view.camera for view in memory.views.photographed]
    if not views:
        raise OptionError("a memory without observed views; give a run or its memory.npz")
    cameras = _path_cameras(memory, concatenate(views), path, run=run, say=say)
    first = cameras[0]
    columns, rows = int(first.width[0]), int(first.height[0])
    if (cameras.width != columns).any() or (cameras.height != rows).any():
        # A film has one size: all frames take the first camera's intrinsics and size.
        K = np.repeat(first.K, len(cameras), axis=0)
        cameras = replace(cameras, K=K, width=np.array(columns), height=np.array(rows))
    if width is not None:
        columns, rows = width, max(16, round(rows * width / columns))
        cameras = cameras.resized(columns, rows)
    return cameras.cropped(0, 0, width=columns // 2 * 2, height=rows // 2 * 2)


def _path_cameras(
    memory: SpatialMemory,
    captured: Cameras,
    path: str,
    *,
    run: Path | None,
    say: Callable[[str], object],
) -> Cameras:
    name, _, count = path.partition(":")
    if name in PATHS:
        if count and not (count.isdecimal() and int(count) >= 1):
            raise OptionError(f"--path {path!r}; expected {name}:N with N >= 1")

        def depth() -> tuple[Cameras, float] | None:
            middle = captured[len(captured) // 2]
            guidance = memory.project(middle)
            if not guidance.valid.any():
                return None
            return middle, float(np.median(guidance.depth[guidance.valid]))

        return named_path(name, captured, count=int(count or FRAMES), depth=depth)
    if path == CAPTURED:
        return captured
    from gvtools.scenes.project import open_project
    from gvtools.scenes.selection import path_and_selection, path_exists, select

    place, selection = path_and_selection(path)
    if not path_exists(place):
        raise OptionError(f"--path {path!r}; expected {FORMS}")

    cameras = read_camera_path(Path(place), captured, selection=selection)
    poses = "" if run is None else said_of_path(Path(place), run)
    if cameras is None:
        scene = open_project(Path(place))
        scene, poses = (scene, "") if run is None else at_run_poses(scene, run, memory)
        cameras = scene.subset(select(scene.names, selection)).cameras
    if poses:
        say(poses)
    return cameras


class FilmRenderer:
    """Draws the frames of one film, of a run's folder or a memory file.

    All ``cameras`` have one size; the memory is drawn as it was after round ``up_to``, None: the
    last. ``rig`` is of another lens than theirs.
    """

    def __init__(
        self, path: Path, cameras: Cameras, *, up_to: int | None = None, rig: Rig | None = None
    ) -> None:
        self.path, self.cameras, self.up_to, self.rig = path, cameras, up_to, rig
        self.memory = load_memory(path, up_to=up_to)
        self.appearance: Appearance | None = load_appearance(path)
        # Seconds spent on projecting the memory and drawing the Gaussians.
        self.projecting = 0.0

    def frame(self, index: int, panels: Sequence[str], *, captions: bool = False) -> Picture:
        """(H, W, 3) one frame, its panels side by side, each with its name or without."""
        pictures = [self._panel(index, panel) for panel in panels]
        if self.rig is not None:
            for picture in pictures:
                picture[~self.rig.inside] = 0
        if captions:
            pictures = [captioned(*pair) for pair in zip(pictures, panels, strict=True)]
        return np.concatenate(pictures, axis=1)

    def _panel(self, index: int, panel: str) -> Picture:
        camera = self.cameras[index]
        if panel == "observed":
            return picture_of(self._projected(self._observed, camera))
        if panel == "completed":
            return picture_of(self._projected(self._completed, camera, fill=filled))
        guidance = self._projected(self.memory, camera)
        return self._depth(guidance) if panel == "depth" else picture_of(guidance)

    def _projected(
        self, memory: SpatialMemory, camera: Cameras, *,
        fill: Callable[[Guidance], Guidance] | None = None,
    ) -> Guidance:  # fmt: skip
        guidance, seconds = render_view(
            memory, camera, appearance=self.appearance, rig=self.rig, fill=fill
        )
        self.projecting += seconds
        return guidance

    def _depth(self, guidance: Guidance) -> Picture:
        from matplotlib import colormaps

        near, far = self._range
        with np.errstate(divide="ignore"):
            share = (1 / guidance.depth[0] - 1 / far) / (1 / near - 1 / far)
        colors = colormaps["turbo"](np.clip(np.nan_to_num(share), 0, 1))[..., :3]
        picture = to_bytes(colors)
        picture[~guidance.valid[0]] = 255
        return picture

    @cached_property
    def _observed(self) -> SpatialMemory:
        """The memory after its first round, which holds observations only."""
        return load_memory(self.path, up_to=self.memory.rounds[0])

    @cached_property
    def _completed(self) -> SpatialMemory:
        """The memory with key frames of the path completed and fused."""
        memory = load_memory(self.path, up_to=self.up_to)
        complete_views(memory, self._spread_cameras(KEY_FRAMES), appearance=self.appearance)
        return memory

    @cached_property
    def _range(self) -> tuple[float, float]:
        """Depths at the ends of the colour map, scene units."""
        seen = [self.memory.project(camera) for camera in self._spread_cameras(RANGE_FRAMES)]
        known = np.concatenate([guidance.depth[guidance.valid] for guidance in seen])
        if not len(known):
            raise OptionError("depth: the memory is in view of no frame; give another --path")
        near, far = np.percentile(known, RANGE)
        return float(near), float(max(far, near * 1.001))

    def _spread_cameras(self, most: int) -> list[Cameras]:
        """At most so many of the cameras, evenly along the path; of a rig twice so many faces."""
        most = most if self.rig is None else max(1, 2 * most // len(self.rig.faces))
        chosen = self.cameras[spread(len(self.cameras), most)]
        return list(chosen) if self.rig is None else self.rig.faces_of(chosen)


def captioned(picture: Picture, text: str) -> Picture:
    """The picture with a line of text in its upper left corner."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    size = max(10, picture.shape[0] // 24)
    font = ImageFont.load_default(size)
    draw = ImageDraw.Draw(image)
    edge = size // 2
    draw.text((edge, edge), text, fill="white", font=font, stroke_width=2, stroke_fill="black")
    return np.asarray(image)


def check_suffix(path: Path) -> None:
    """Refuse a file name that no film can be written to, before anything is drawn."""
    if check_ending(path, SUFFIXES) == ".mp4":
        purpose, instead = f"--out {path}: MP4", "or write a .gif or .webp"
        require("av", extra="film", purpose=purpose, instead=instead)


def write_film(
    path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: float, panorama: bool = False
) -> int:
    """Write frames of one even size to a file with one of SUFFIXES; it appears when whole.

    An MP4 of panoramas says so. Returns how many frames were left out (see ``shown_frames``).
    """
    with replaced_when_written(path) as temporary:
        if path.suffix.lower() != ".mp4":
            return _write_animation(temporary, frames, form=path.suffix[1:].upper(), fps=fps)
        _write_mp4(temporary, frames, fps=fps)
        if panorama:
            mark_mp4(temporary)
        return 0


def _write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: float) -> None:
    import av
    from av.video.reformatter import ColorRange, Colorspace

    rate = Fraction(fps).limit_denominator(1001)
    # "faststart" moves the index to the front, so that browsers play it while it loads.
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": str(QUALITY)})
        # The pixel format that every player can decode.
        stream.pix_fmt = "yuv420p"
        # Of what players otherwise guess by the picture's size.
        coder = stream.codec_context
        coder.color_range, coder.colorspace = ColorRange.MPEG, Colorspace.ITU709
        coder.color_primaries, coder.color_trc = BT709, BT709
        for number, frame in enumerate(frames):
            if number == 0:
                stream.height, stream.width = frame.shape[:2]
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            picture = picture.reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
            )
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def _write_animation(
    path: Path, frames: Iterable[NDArray[np.uint8]], *, form: str, fps: float
) -> int:
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    options = {"quality": WEBP_QUALITY} if form == "WEBP" else {}
    shown, durations = shown_frames(len(images), fps=fps, unit=10 if form == "GIF" else 1)
    first, *others = (images[number] for number in shown)
    with path.open("wb") as file:
        first.save(
            file, format=form, save_all=True, append_images=others, duration=durations, loop=0,
            **options,
        )  # fmt: skip
    return len(images) - len(shown)


def shown_frames(frames: int, *, fps: float, unit: int) -> tuple[list[int], list[int]]:
    """Frames of an animation that are shown, and for how many ms each: ``frames`` / ``fps`` in all.

    Browsers show what stands for less than ``LEAST_SHOWN`` ms for ten times as long, so frames are
    left out instead. ``unit``: ms that durations are multiples of.

    >>> shown_frames(6, fps=60, unit=10)
    ([0, 1, 3, 4], [20, 30, 20, 30])
    """
    begins = [unit * round(1000 * number / fps / unit) for number in range(frames + 1)]
    shown = [0]
    for number in range(1, frames):
        late = begins[number] - begins[shown[-1]] >= LEAST_SHOWN
        if late and begins[frames] - begins[number] >= LEAST_SHOWN:
            shown.append(number)
    times = [begins[number] for number in shown] + [max(begins[frames], LEAST_SHOWN)]
    return shown, [after - before for before, after in pairwise(times)]
