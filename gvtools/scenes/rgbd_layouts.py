"""RGB-D folders in the layouts of recorders and scanners, with poses and without.

- 7-Scenes, BundleFusion: ``frame-XXXXXX.{color.png|jpg, depth.png, pose.txt}`` in one folder.
- TUM RGB-D: ``rgb.txt``, ``depth.txt`` and ``groundtruth.txt`` with time stamps. Pictures and depth
  maps are joined by the nearest stamp, each used once; each picture gets the pose nearest in time.
- ScanNet as its exporter writes it: ``color``, ``depth``, ``pose`` and ``intrinsic``. Depth is of a
  camera of its own; frames that the tracker lost hold infinity.
- Redwood and Open3D: ``color``, ``depth`` and a ``.log`` trajectory, each block of which is the
  number of a picture in natural order and a pose.
- NeuralRGBD, Replica and RTAB-Map: see their classes.

``gvtools capture`` takes the same layouts less their poses: every frame then stands at the
identity.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from gvtools.errors import ProjectError
from gvtools.scenes.calibration import (
    Float64,
    finite_array,
    number_table,
    opencv_lens,
    opencv_pose,
    pinhole,
)
from gvtools.scenes.images import DEPTH_SUFFIXES, IMAGE_SUFFIXES
from gvtools.scenes.layout import Layout
from gvtools.scenes.matching import (
    associate,
    find_renamed,
    named,
    pair_by_name,
    pictures_in,
    pose_at,
    times_in,
)
from gvtools.scenes.photographs import NO_POSE, PosedFrame, first_size
from gvtools.scenes.rgbd import (
    Recording,
    RgbdFolder,
    RgbdOptions,
    given_intrinsics,
    under,
)
from gvtools.scenes.scene import Finding, counted
from gvtools.scenes.undistort import LensParameters
from gvtools.trajectory_files import in_seconds, read_poses
from gvtools.untrusted import expect, read_json, read_text, reading


class _SevenScenes(RgbdFolder):
    name = "7-Scenes"
    holds = "*.color.*, *.depth.png, *.pose.txt", "*.color.*, *.depth.png"
    assumed = False

    def matches(self, root: Path, *, posed: bool = True) -> bool:
        beside = "*.pose.txt" if posed else "*.depth.*"
        return any(root.glob(beside)) and any(root.glob("*.color.*"))

    def frames(self, root: Path, options: RgbdOptions) -> list[PosedFrame]:
        suffixes = (".color.png", ".color.jpg", ".color.jpeg")
        names = sorted(path.name for path in root.iterdir() if path.name.endswith(suffixes))
        return [self._frame(root, name[: name.rindex(".color.")], name) for name in names]

    def frames_of_poses(self, root: Path) -> list[PosedFrame]:
        stems = (path.name.removesuffix(".pose.txt") for path in root.glob("*.pose.txt"))
        return [self._frame(root, stem, f"{stem}.color.png") for stem in stems]

    def _frame(self, root: Path, stem: str, name: str) -> PosedFrame:
        maps = [root / f"{stem}.depth{suffix}" for suffix in DEPTH_SUFFIXES]
        depth = next(filter(Path.is_file, maps), maps[0])
        pose = str(root / f"{stem}.pose.txt")
        return PosedFrame(name, root / name, None, None, depth, where=pose)


TRUTH = "groundtruth.txt"
# fx, fy, cx, cy and k1, k2, p1, p2, k3 as published with TUM RGB-D; freiburg3 is rectified.
PUBLISHED = {
    "freiburg1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), ()),
}


class _Tum(RgbdFolder):
    name = "TUM"
    holds = "rgb.txt, depth.txt, groundtruth.txt", "rgb.txt, depth.txt"
    unit = 1 / 5000

    def matches(self, root: Path, *, posed: bool = True) -> bool:
        listed = all((root / f"{kind}.txt").is_file() for kind in ("rgb", "depth"))
        if not posed:
            return listed or self._associated(root) is not None
        named_by_time = all(_stamped_pictures(root / kind) for kind in ("rgb", "depth"))
        pictures = listed or self._associated(root) is not None or named_by_time
        return pictures and self._truth(root).is_file()

    def _truth(self, root: Path) -> Path:
        there = (root / f"{name}.txt" for name in ("gt", "trajectory", "poses"))
        return next(filter(Path.is_file, (root / TRUTH, *there)), root / TRUTH)

    def frames(self, root: Path, options: RgbdOptions) -> list[PosedFrame]:
        return [frame for _, frame in self._stamped(root, options)[0]]

    def _associated(self, root: Path) -> Path | None:
        """A list of pictures with their depth maps, as tools write it beside the two lists."""
        return next(iter(sorted(root.glob("assoc*.txt"))), None)

    def _stamped(
        self, root: Path, options: RgbdOptions
    ) -> tuple[list[tuple[float, PosedFrame]], list[Finding]]:
        lists, pairs = [root / f"{kind}.txt" for kind in ("rgb", "depth")], self._associated(root)
        listed = all(path.is_file() for path in lists)
        if pairs is not None and not listed:
            colors, depths = _associated_files(pairs)
            depth_of = {i: i for i in range(len(colors))}
            lists = [pairs, pairs]
        else:
            colors, depths = (
                _stamped_files(path) if path.is_file() else _stamped_pictures(root / path.stem)
                for path in lists
            )
            times, depth_times = (np.array([time for time, _ in x]) for x in (colors, depths))
            depth_of = associate(times, depth_times, options.max_time_difference)
        images, met = find_renamed(
            root, [root / name for _, name in colors], where=[str(lists[0])] * len(colors)
        )
        maps, others = find_renamed(
            root, [root / name for _, name in depths], where=[str(lists[1])] * len(depths),
            noun="depth maps",
        )  # fmt: skip
        frames = []
        for i, ((time, _), color) in enumerate(zip(colors, images, strict=True)):
            depth = maps[depth_of[i]] if i in depth_of else None
            where = f"{self._truth(root)}, time {time:.6f}"
            frames.append((time, PosedFrame(color.name, color, None, None, depth, where=where)))
        if not listed:
            source = pairs.name if pairs is not None else "the names of the files in rgb and depth"
            met.append(Finding("info", f"rgb.txt or depth.txt is absent: times are of {source}"))
        return sorted(frames, key=lambda item: (item[0], item[1].image)), [*met, *others]

    def uncalibrated(self, root: Path, options: RgbdOptions) -> Recording:
        for name, (values, distortion) in PUBLISHED.items():
            if name in root.resolve().name:
                lens = {"color_K": pinhole(values), "distortion": distortion or None}
                published = under(options, **lens)
                line = f"intrinsics: published for {name}"
                return Recording(root, published, findings=[Finding("info", line)])
        return super().uncalibrated(root, options)

    def posed(self, recording: Recording, *, strict: bool) -> Recording:
        limit = recording.options.max_time_difference
        path = self._truth(recording.root)
        truth = read_poses(path, layout="tum", lost=True)
        assert truth.stamps is not None
        order = np.argsort(truth.stamps, kind="stable")
        at = partial(pose_at, times=truth.stamps[order], poses=truth.poses[order], same=limit)
        stamped, met = self._stamped(recording.root, recording.options)
        frames = [replace(frame, pose=at(time)) for time, frame in stamped]
        # How far off those are that have none tells clocks that differ from poses that lack.
        off = [
            np.abs(truth.stamps - t).min()
            for (t, _), f in zip(stamped, frames, strict=True)
            if f.pose is None
        ]
        unposed = f"{NO_POSE} within {limit:g} s"
        if off:
            unposed += f" (the nearest is {min(off):.3g} to {max(off):.3g} s off)"
        notes = [Finding("warning", f"{path.name}: {note}") for note in truth.notes]
        if path.name != TRUTH:
            notes.append(Finding("info", f"{TRUTH} is absent: poses are of {path.name}"))
        findings = [*recording.findings, *met, *notes]
        return replace(recording, frames=frames, unposed=unposed, findings=findings)


def _stamped_pictures(folder: Path) -> list[tuple[float, str]]:
    """Time stamps and names, below the folder above, of pictures that are all named by time."""
    names = [f"{folder.name}/{path.name}" for path in pictures_in(folder)]
    times = times_in(names) if names else None
    return [] if times is None else list(zip(times.tolist(), names, strict=True))


def _associated_files(path: Path) -> tuple[list[tuple[float, str]], list[tuple[float, str]]]:
    """Pictures and depth maps of a list of pairs, each with its stamp, in either order."""
    lists: tuple[list[tuple[float, str]], list[tuple[float, str]]] = ([], [])
    for stamp, rest in _stamped_files(path):
        words = rest.split()
        with reading(path, "expected stamp, picture, stamp and depth map in each line"):
            pair = (stamp, words[0]), (float(words[1]), words[2])
        depth_first = "depth" in pair[0][1]
        lists[0].append(pair[depth_first])
        lists[1].append(pair[not depth_first])
    return lists


def _stamped_files(path: Path) -> list[tuple[float, str]]:
    """Time stamps and names of a list of TUM RGB-D."""
    entries = []
    with reading(path, "expected a time stamp in seconds and a file in each line"):
        for number, line in enumerate(read_text(path).splitlines(), start=1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            words = line.replace(",", " ").split(maxsplit=1)
            stamp = finite_array(words[:1], 1)
            if stamp is None or len(words) < 2:
                raise ValueError(f"line {number}: {line!r}")
            entries.append((float(stamp[0]), words[1].strip()))
    seconds = in_seconds(np.array([stamp for stamp, _ in entries]))
    return [(time, name) for time, (_, name) in zip(seconds.tolist(), entries, strict=True)]


# Where exporters like ScanNet's put each kind; poses that are named camera-from-world are not read.
FOLDERS = {
    "color": ("color", "colour", "rgb", "image", "images"),
    "depth": ("depth_filtered", "depth", "depths", "depth_map", "depth_maps"),
    "pose": ("pose", "poses", "camera_pose", "camera_poses", "c2w", "cam2world", "cam_to_world"),
}


class _ScanNet(RgbdFolder):
    name = "ScanNet"
    holds = "color, depth, pose, intrinsic", "color, depth, intrinsic"
    assumed = False

    def matches(self, root: Path, *, posed: bool = True) -> bool:
        # Exporters put the cameras in several places; Redwood's have a trajectory instead of poses.
        folders = [self._folder(root, "color"), self._folder(root, "depth")]
        if posed and not any(root.glob("*.log")):
            return bool(self._files(root, "pose")) and all(folder.is_dir() for folder in folders)
        folders += [root / "intrinsic", *([self._folder(root, "pose")] if posed else [])]
        return all(folder.is_dir() for folder in folders)

    def _folder(self, root: Path, kind: str) -> Path:
        there = {entry.name.lower(): entry for entry in root.glob("*") if entry.is_dir()}
        return next((there[name] for name in FOLDERS[kind] if name in there), root / kind)

    def _files(self, root: Path, kind: str) -> list[Path]:
        suffixes = {"depth": DEPTH_SUFFIXES, "pose": (".txt", ".npy")}
        return pictures_in(self._folder(root, kind), suffixes.get(kind, IMAGE_SUFFIXES))

    def frames(self, root: Path, options: RgbdOptions) -> list[PosedFrame]:
        colors, depths = self._files(root, "color"), self._files(root, "depth")
        depth_of, pose_of = (
            pair_by_name(colors, depths),
            pair_by_name(colors, self._files(root, "pose")),
        )
        return [
            self._frame(root, color, depth=depth_of.get(color), pose=pose_of.get(color))
            for color in colors
        ]

    def frames_of_poses(self, root: Path) -> list[PosedFrame]:
        colors = self._folder(root, "color")
        return [
            self._frame(root, colors / f"{path.stem}.jpg", pose=path)
            for path in self._files(root, "pose")
        ]

    def _frame(
        self, root: Path, color: Path, *, depth: Path | None = None, pose: Path | None = None
    ) -> PosedFrame:
        pose = pose or self._folder(root, "pose") / f"{color.stem}.txt"
        return PosedFrame(color.name, color, None, None, depth, where=str(pose))


class _Redwood(_ScanNet):
    """As ScanNet's, with the poses in one file."""

    name = "Redwood"
    holds = "color, depth, a .log trajectory", "color, depth"
    assumed = True

    def matches(self, root: Path, *, posed: bool = True) -> bool:
        folders = all(self._folder(root, kind).is_dir() for kind in ("color", "depth"))
        return folders and (not posed or bool(self._trajectories(root)))

    def _trajectories(self, root: Path) -> list[Path]:
        """The ``.log`` files, else those of other programs with a pose for each picture."""
        logs = sorted(root.glob("*.log"), key=lambda path: (path.name != "trajectory.log", path))
        forms = ("trajectory", "traj", "poses", "groundtruth")
        others = (root / f"{name}{suffix}" for name in forms for suffix in (".txt", ".npy"))
        return logs or list(filter(Path.is_file, others))

    def posed(self, recording: Recording, *, strict: bool) -> Recording:
        root, findings = recording.root, list(recording.findings)
        logs = self._trajectories(root)
        if len(logs) > 1:
            others = named([path.name for path in logs[1:]])
            findings.append(Finding("warning", f"poses are read from {logs[0].name}, not {others}"))
        frames = self.frames(root, recording.options)
        unpaired = len(self._files(root, "depth")) - sum(item.depth is not None for item in frames)
        findings += counted(unpaired, "depth maps belong to no picture")
        if logs[0].suffix == ".log":
            numbers, poses = read_log(logs[0])
        else:
            poses = list(read_poses(logs[0], lost=True).poses)
            numbers = list(range(len(poses)))
            findings.append(Finding("info", f"poses: {logs[0].name}, one a picture in order"))
        fits = len(set(numbers)) == len(numbers) and all(0 <= i < len(frames) for i in numbers)
        if not fits and len(numbers) != len(frames):
            raise ProjectError(
                f"{logs[0]}: {len(numbers)} poses numbered {named(numbers)} for {len(frames)} "
                "pictures; expected one pose a picture, or numbers of pictures counted from 0"
            )
        rows = numbers if fits else range(len(frames))
        for row, number, pose in zip(rows, numbers, poses, strict=True):
            frames[row] = replace(frames[row], pose=pose, where=f"{logs[0]}, pose {number}")
        return replace(recording, frames=frames, findings=findings)


class _NeuralRgbd(_Redwood):
    """Poses have OpenGL's axes, and the principal point is in the middle."""

    name = "NeuralRGBD"
    holds = "images, depth, poses.txt, focal.txt", "images, depth, focal.txt"

    def matches(self, root: Path, *, posed: bool = True) -> bool:
        return (root / "focal.txt").is_file() and super().matches(root, posed=posed)

    def calibration(self, root: Path, options: RgbdOptions) -> Recording:
        focal = float(number_table(root / "focal.txt", 1)[0, 0])
        size = first_size(frame.image for frame in self.frames(root, options)) or (0, 0)
        K = pinhole([focal, focal, size[0] / 2, size[1] / 2])
        return super().calibration(root, under(options, color_K=K))

    def posed(self, recording: Recording, *, strict: bool) -> Recording:
        read = super().posed(recording, strict=strict)
        turned = (f.pose if f.pose is None else opencv_pose(f.pose) for f in read.frames)
        pairs = zip(read.frames, turned, strict=True)
        return replace(read, frames=[replace(frame, pose=pose) for frame, pose in pairs])


class _Replica(_Redwood):
    """Replica as NICE-SLAM publishes it: pictures and depth maps share a folder."""

    name = "Replica"
    holds = "results/frame*, results/depth*, traj.txt", "results/frame*, results/depth*"

    def matches(self, root: Path, *, posed: bool = True) -> bool:
        pictures = any(root.glob("results/frame*")) and any(root.glob("results/depth*"))
        return pictures and (not posed or bool(self._trajectories(root)))

    def _files(self, root: Path, kind: str) -> list[Path]:
        suffixes, start = (
            (DEPTH_SUFFIXES, "depth") if kind == "depth" else (IMAGE_SUFFIXES, "frame")
        )
        found = pictures_in(root / "results", suffixes)
        return [path for path in found if path.name.startswith(start)]

    def calibration(self, root: Path, options: RgbdOptions) -> Recording:
        places = (root / "cam_params.json", root.resolve().parent / "cam_params.json")
        path = next(filter(Path.is_file, places), None)
        if path is None:
            return super().calibration(root, options)
        with reading(path, "expected fx, fy, cx, cy and scale of 'camera'"):
            told = read_json(path)["camera"]
            K = pinhole([float(told[name]) for name in ("fx", "fy", "cx", "cy")])
            unit = 1 / float(told["scale"])
        recording = super().calibration(root, under(options, color_K=K, depth_unit=unit))
        line = Finding("info", f"intrinsics and depth unit: {path.name}")
        return replace(recording, findings=[line, *recording.findings])


class _RtabMap(_ScanNet):
    """What ``rtabmap-export --images_id --poses_camera --poses_format 11`` writes.

    NAME_rgb/ID.jpg, NAME_depth/ID.png, NAME_calib/ID.yaml and poses with the ID at the line's end.
    """

    name = "RTAB-Map"
    holds = "*_rgb, *_depth, *_calib, *_poses.txt", "*_rgb, *_depth, *_calib"

    def matches(self, root: Path, *, posed: bool = True) -> bool:
        folders = all(self._folder(root, kind).is_dir() for kind in ("rgb", "depth", "calib"))
        return folders and (not posed or any(root.glob("*_poses.txt")))

    def _folder(self, root: Path, kind: str) -> Path:
        kind = "rgb" if kind == "color" else kind
        return min(root.glob(f"*_{kind}"), default=root / kind)

    def _frame(
        self, root: Path, color: Path, *, depth: Path | None = None, pose: Path | None = None
    ) -> PosedFrame:
        path = self._folder(root, "calib") / f"{color.stem}.yaml"
        lens = opencv_lens(path) if path.is_file() else None
        return PosedFrame(color.name, color, lens, None, depth, where=str(path))

    def calibration(self, root: Path, options: RgbdOptions) -> Recording:
        lens = next((f.lens for f in self.frames(root, options) if f.lens is not None), None)
        K = pinhole(lens.values[:4]) if isinstance(lens, LensParameters) else None
        if K is not None:
            K[:2, 2] -= 0.5
        bent = list(lens.values[4:9]) if isinstance(lens, LensParameters) else []
        recording = super().calibration(root, under(options, color_K=K, distortion=bent or None))
        if K is None or options.color_K is not None:
            return recording
        return replace(recording, findings=[Finding("info", "intrinsics: each picture's own")])

    def posed(self, recording: Recording, *, strict: bool) -> Recording:
        path = min(recording.root.glob("*_poses.txt"))
        with reading(path, "expected 'timestamp x y z qx qy qz qw id' in each line"):
            track, ids = read_poses(path), np.loadtxt(path, ndmin=2)[:, 8].astype(int)
        # Pictures are named by ID, or by time without --images_id.
        times = track.stamps if track.stamps is not None else ids
        keys = [*map(str, ids), *(f"{time:.3f}" for time in times)]
        poses = dict(zip(keys, [*track.poses, *track.poses], strict=True))
        frames = []
        for frame in self.frames(recording.root, recording.options):
            stem = frame.image.stem
            key = f"{float(stem):.3f}" if re.fullmatch(r"\d+\.\d+", stem) else stem
            frames.append(replace(frame, pose=poses.get(key), where=f"{path}, {stem}"))
        return replace(recording, frames=frames)


def read_log(path: Path) -> tuple[list[int], list[Float64]]:
    """The first integers and (4, 4) matrices of a ``.log`` trajectory's blocks, as read."""
    with reading(path, "expected blocks of three integers and four lines of four numbers"):
        words = read_text(path).split()
        expect(len(words) % 19 == 0, f"{len(words)} numbers, not 19 a block")
        blocks = np.array(words, np.float64).reshape(-1, 19)
        return [int(word) for word in words[::19]], list(blocks[:, 3:].reshape(-1, 4, 4))


SEVENSCENES_FOLDER, SCANNET_FOLDER = _SevenScenes(), _ScanNet()
# ScanNet before Redwood: both have colour and depth folders.
_FOLDERS = (
    SEVENSCENES_FOLDER, _Tum(), SCANNET_FOLDER, _NeuralRgbd(), _Redwood(), _Replica(), _RtabMap()
)  # fmt: skip
SEVENSCENES, TUM, SCANNET, _, REDWOOD, REPLICA, RTABMAP = LAYOUTS = tuple(
    Layout.of_folder(folder.name, folder.holds[0], matches=folder.matches, read=folder.read)
    for folder in _FOLDERS
)
UNPOSED = tuple(f"{folder.name} ({folder.holds[1]})" for folder in _FOLDERS)


def _unposed(root: Path) -> RgbdFolder | None:
    return next((folder for folder in _FOLDERS if folder.matches(root, posed=False)), None)


def count_unposed(root: Path) -> int:
    """How many RGB-D frames a folder holds that is no project; 0 where it holds none."""
    folder = _unposed(root)
    return 0 if folder is None else len(folder.frames(root, RgbdOptions()))


def read_unposed(root: Path, options: RgbdOptions) -> Recording | None:
    """The frames with depth of a folder, all at the identity; None where it is of no layout."""
    folder = _unposed(root)
    if folder is None:
        return None
    recording = folder.calibration(root, options)
    found = folder.frames(root, recording.options)
    frames = [
        replace(frame, pose=np.eye(4), where=str(frame.image))
        for frame in found
        if frame.image.is_file() and frame.depth is not None and frame.depth.is_file()
    ]
    line = f"of {len(found)} pictures have no depth map: left out"
    findings = [*recording.findings, *counted(len(found) - len(frames), line)]
    return replace(recording, frames=frames, given=given_intrinsics(options), findings=findings)
