"""Trajectory files: TUM (timestamped quaternions), KITTI (rows of 3x4 matrices), EuRoC (CSV).

Which column is which, and the unit of the time stamps, the names in a file's head tell, else the
numbers; never the file's suffix. They hold poses to world, in scene units, and nothing of the
camera itself: the intrinsics and the image size come from given cameras. TUM's and KITTI's poses
are those of a camera with OpenCV axes, EuRoC's those of the inertial unit.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import ROTATION_ROUNDING, Cameras, invert_rigid, rigid_poses, rigid_transform
from gvtools.errors import ProjectError, ShapeError
from gvtools.notebook import html_table, path_sketch
from gvtools.untrusted import load_array, read_text, reading

Float64 = NDArray[np.float64]

# A quaternion written with few digits may be this far from unit length; farther, it is none.
QUATERNION_TOLERANCE = 1e-2
# Views of a path look so nearly [degrees] where the scene's cameras do; farther off they do not.
ALIKE, OTHER = 30, 50
EUROC = 17  # numbers in a line of EuRoC's ground truth
# Of a matrix, without or with its last row and a number or time of its own in front.
MATRICES = (12, 13, 16, 17)
# Where time, position and quaternion (x, y, z, w) stand, and what the columns are called.
_COLUMNS = {"tum": (0, 1, 2, 3, 4, 5, 6, 7), "euroc": (0, 1, 2, 3, 5, 6, 7, 4)}
_NAMES = {"tum": "timestamp tx ty tz qx qy qz qw", "euroc": "nanoseconds, x, y, z, qw, qx, qy, qz"}
_DECIMAL = re.compile(r"[+-]?\d+(,\d+)?(e[+-]?\d+)?", re.IGNORECASE)
_ZERO = re.compile(r"[+-]?0*\.?0*(e[+-]?\d+)?", re.IGNORECASE)
_LOST = {f"{sign}{word}" for sign in ("", "+", "-") for word in ("nan", "inf", "infinity")}
_UNIT = re.compile(r"\s*[\[(]\s*([^\])]*?)\s*[\])]")
_PART = re.compile(r"(?:\w+_)?(n|nano)?sec(?:s|onds)?")
_TIME = re.compile(r"(?:\w+_)?(?:time|(?:time_?)?stamps?|n?secs?|seconds|t)(?:_(ns|us|ms|s))?")
_TURN = re.compile(r"(?:q|quat\w*?|rot\w*?|ori\w*?)(?:[._]\w+)??[._]?([xyzw])(?:_world\w*)?")
_PLACE = re.compile(r"(?:t|p|pos\w*?|trans\w*?)?(?:[._]\w+)??[._]?([xyz])(?:_world\w*)?")
_METRES = {"mm": 1e-3, "cm": 1e-2}
# Of a unit of time: seconds, the size of stamps since 1970, and the least median step from one pose
# to the next by which stamps of another beginning are known.
_UNITS = {"ns": (1e-9, 1e18, 1e6), "us": (1e-6, 1e15, 1e3), "ms": (1e-3, 1e12, np.inf)}


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses in the order of a file or project."""

    poses: Float64  # (N, 4, 4) float64, camera (or body) to world, scene units
    # N names; empty when poses are told apart by time or by order alone
    names: tuple[str, ...] = ()
    stamps: Float64 | None = None  # (N,) float64, seconds; None where there are no times
    notes: tuple[str, ...] = ()  # what was recognised, put in order or left out

    def __len__(self) -> int:
        return len(self.poses)

    def _repr_html_(self) -> str:
        places = self.poses[:, :3, 3]
        length = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
        rows = {"poses": f"{len(self):,}", "length": f"{length:.4g} scene units"}
        if self.stamps is not None:
            rows["time"] = f"{np.ptp(self.stamps):.4g} s" if len(self) else ""
        rows |= {f"note {number}": note for number, note in enumerate(self.notes, 1)}
        return html_table("Trajectory", rows, path_sketch(places))


def read_poses(path: str | Path, *, layout: str = "auto", lost: bool = False) -> Trajectory:
    r"""The poses of a trajectory file.

    Args:
        path: a text file, of which blank lines and those that start with # are passed over, or an
            ``.npy`` with an array of such rows or matrices.
        layout: "tum" (timestamp tx ty tz qx qy qz qw), "kitti" (12 or 16 numbers, a matrix by rows,
            with or without a number or time in front, or a line for each row), "euroc" (CSV:
            nanoseconds, x, y, z, qw, qx, qy, qz, and more that is not read) or "auto": the columns
            that the head names, else what the numbers tell.
        lost: whether lines with NaN or infinity, for which a tracker was lost, are left out; of
            matrices that order alone tells apart they are NaN.

    Returns:
        N poses in the order of the file, with stamps for TUM and EuRoC. Rotations that are off by
        more than rounded digits are replaced by the nearest ones.

    Raises:
        ProjectError: unreadable or empty; a line with another count of numbers, something that is
            no number, or a rotation that is none. The message names the line.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "path.txt"
    ...     _ = file.write_text("0.0 1 2 3 0 0 0 1\n0.1 1 2 4 0 0 0 1\n")
    ...     track = read_poses(file)
    >>> track.poses[1, :3, 3], track.stamps
    (array([1., 2., 4.]), array([0. , 0.1]))
    """
    path = Path(path)
    form, rows = _form(path, layout)
    told = [not (lost and _LOST.intersection(map(str.lower, words))) for _, words in rows]
    left_out = told.count(False)
    if not any(told):
        raise ProjectError(
            f"{path}: all {len(rows)} poses hold NaN or infinity; expected finite ones"
        )
    rows = [row for row, kept in zip(rows, told, strict=True) if kept]
    stamps, poses = _read(rows, form.columns, more=form.more, path=path)
    if form.columns is None and len(rows[0][1]) % 4 == 0:
        every = np.full((len(told), 4, 4), np.nan)
        every[told] = poses
        return Trajectory(every)
    unit = form.unit or unit_of(stamps)
    poses[:, :3, 3] *= form.metres
    seconds = stamps * _UNITS.get(unit, (1.0,))[0]
    if form.unit and not (np.abs(seconds).max() < 1e11 and 1e-6 < (_step(seconds) or 1) < 1e6):
        raise ProjectError(
            f"{path}: its head gives time stamps in {form.unit}, which {stamps[-1]:.17g} cannot "
            "be; mend the head"
        )
    notes = form.notes
    if left_out:
        notes = (*notes, f"{left_out} poses hold NaN or infinity: dropped")
    if unit and not form.unit and not form.more:
        notes = (*notes, f"time stamps read as {unit}")
    return Trajectory(poses, (), seconds, notes)


@dataclass(frozen=True)
class _Form:
    """How the lines of a file are read."""

    # Of time, position, quaternion (x, y, z, w) and the time's nanoseconds, if any; None: KITTI's.
    columns: tuple[int, ...] | None
    more: bool = False  # whether there may be more columns
    unit: str = ""  # of the time stamps, as the head names it
    notes: tuple[str, ...] = ()
    guessed: bool = False  # whether the order of eight numbers is told by nothing but these
    metres: float = 1.0  # a unit of places


def _form(path: Path, layout: str) -> tuple[_Form, list[tuple[int, list[str]]]]:
    """The layout of a file, and its rows of data."""
    head, rows, commas = _rows(path)
    if layout not in ("auto", "kitti", *_COLUMNS):
        raise ProjectError(f"{path}: layout {layout!r}; expected auto, tum, kitti or euroc")
    count = len(rows[0][1])
    if head is not None and layout != "kitti":
        columns, unit, length = head
        order = "euroc" if columns[7] < columns[4] else "tum"
        if layout not in ("auto", order):
            raise ProjectError(
                f"{path}: layout {layout!r}, and its head names the columns as {order} has them "
                f"({_NAMES[order]}); leave --layout out, or mend the head"
            )
        notes = (f"places in {length}, as its head says: read as m",) if length in _METRES else ()
        return _Form(columns, True, unit, notes, metres=_METRES.get(length, 1.0)), rows
    matrix = count in MATRICES[:2] and not commas
    if count in MATRICES[2:]:
        matrix = all(map(_ZERO.fullmatch, rows[0][1][-4:-1]))
    if layout == "kitti" or (layout == "auto" and matrix):
        return _Form(None), rows
    if layout != "auto":
        return _Form(_COLUMNS[layout], layout == "euroc"), rows
    if count < 8 or (count not in (8, EUROC) and not commas):
        raise ProjectError(
            f"{path}:{rows[0][0]}: {count} numbers; expected 8 (tum: {_NAMES['tum']}), 12 or "
            f"16 (kitti: a matrix), or 8 and more with commas (euroc: {_NAMES['euroc']})"
        )
    return _by_numbers(path, rows, commas=commas), rows


def _by_numbers(path: Path, rows: list[tuple[int, list[str]]], *, commas: bool) -> _Form:
    """Whether lines without names are TUM's or EuRoC's."""
    try:
        numbers = np.array([words[:8] for _, words in rows], np.float64)
    except ValueError:
        numbers = np.zeros((1, 8))  # some line is wrong, which is said where it is read
    more = len(rows[0][1]) > 8
    if len(rows[0][1]) == 12 and np.abs(numbers[:, 0]).max() < 1 + QUATERNION_TOLERANCE:
        return _Form(None)
    fine = unit_of(numbers[:, 0]) == "ns"
    # A walk that starts at the identity, and real parts that are never negative, tell where those
    # stand; so do commas and nanoseconds together.
    turn = numbers[:, 4:]
    first, last = (bool((turn[:, at] >= 0).all() or (turn[:, at] <= 0).all()) for at in (0, 3))
    said = [order for order, at in (("euroc", 0), ("tum", 3)) if abs(turn[0, at]) > 1 - 1e-6]
    said = said or (["euroc"] if first and not last else ["tum"] if last and not first else [])
    order = "euroc" if more or (commas and fine) else "tum"
    mixed = commas != fine and not more
    if mixed and said:
        order = said[0]
    elif said and abs(turn[0]).max() > 1 - 1e-6 and said[0] != order:
        raise ProjectError(
            f"{path}: the columns look like {order}'s ({_NAMES[order]}), but its first pose is the "
            f"identity by those of {said[0]}; give --layout {order} or {said[0]}, or name the "
            "columns in a first line"
        )
    note = f"columns taken as {_NAMES[order]}; if they are not, give --layout"
    return _Form(_COLUMNS[order], more, "", (note,) if mixed else (), not more)


def unit_of(stamps: Float64) -> str:
    """The unit of time stamps that are none in seconds, by their size or their steps; else "".

    Nanoseconds since a machine was switched on may be as many as milliseconds since 1970.

    >>> unit_of(np.array([0, 33e6, 66e6])), unit_of(np.array([1.4e9, 1.4e9 + 1]))
    ('ns', '')
    >>> unit_of(1.4e12 + np.array([0, 33e6, 66e6])), unit_of(1.4e12 + np.array([0, 33, 66]))
    ('ns', 'ms')
    """
    size = float(np.abs(stamps).max(initial=0))
    for unit, (_, since, _) in _UNITS.items():
        if 0.9 * since < size < 5 * since and _step(stamps) < since / 1e6:
            return unit
    return next((unit for unit, (*_, step) in _UNITS.items() if _step(stamps) >= step), "")


def in_seconds(stamps: Float64) -> Float64:
    """Time stamps of the unit that ``unit_of`` tells, in seconds."""
    return stamps * _UNITS.get(unit_of(stamps), (1.0,))[0]


def _step(stamps: Float64) -> float:
    """The median step between time stamps that differ; 0 where all are one."""
    steps = np.diff(np.unique(stamps))
    return float(np.median(steps)) if len(steps) else 0.0


def in_time(track: Trajectory) -> Trajectory:
    """A trajectory in the order of its stamps, each once: the first pose of a repeated one.

    >>> track = Trajectory(np.tile(np.eye(4), (3, 1, 1)), (), np.array([2.0, 1.0, 2.0]))
    >>> in_time(track).stamps, in_time(track).notes
    (array([1., 2.]), ('1 of 3 time stamps not in order, sorted', '1 repeated, merged'))
    """
    if track.stamps is None:
        return track
    stamps, rows = np.unique(track.stamps, return_index=True)
    notes = list(track.notes)
    if late := int((np.diff(track.stamps) < 0).sum()):
        notes.append(f"{late} of {len(track)} time stamps not in order, sorted")
    if left := len(track) - len(rows):
        notes.append(f"{left} repeated, merged")
    names = tuple(track.names[row] for row in rows) if track.names else ()
    return Trajectory(track.poses[rows], names, stamps, tuple(notes))


def read_trajectory(
    path: str | Path, like: Cameras, *, layout: str = "auto", beside: Cameras | None = None
) -> Cameras:
    """Cameras on the poses of a trajectory file.

    Args:
        path: as of ``read_poses``.
        like: intrinsics and size: those of the first camera for all, or row by row when there are
            as many cameras as poses.
        layout: as of ``read_poses``.
        beside: cameras of the scene, which tell the order of quaternions that a file leaves open.

    Returns:
        V cameras in the order of their times; the names are the timestamps as written (TUM, EuRoC;
        a repeated one gets _1, _2, ...) or running numbers (KITTI).
    """
    path = Path(path)
    track = read_poses(path, layout=layout)
    names: list[str] = []
    repeats: dict[str, int] = {}
    form, rows = _form(path, layout)
    if form.guessed and beside is not None:
        scalar_last = form.columns == _COLUMNS["tum"]
        _check_order(path, track.poses, beside=beside, scalar_last=scalar_last)
    for _, words in rows:
        name = words[form.columns[0]] if form.columns else f"{len(names):06d}"
        name = ".".join([name, *(words[column].zfill(9) for column in (form.columns or ())[8:])])
        name = words[0] if form.columns is None and len(words) % 4 else name
        # Published ground truth holds repeated timestamps; names have to differ.
        repeats[name] = repeats.get(name, -1) + 1
        if repeats[name]:
            name = f"{name}_{repeats[name]}"
        names.append(name)
    cameras = _with_intrinsics(track.poses, like, names, path=path)
    if track.stamps is None:
        return cameras
    return cameras[np.argsort(track.stamps, kind="stable").tolist()]


def _check_order(path: Path, poses: Float64, *, beside: Cameras, scalar_last: bool) -> None:
    """Refuse quaternions that look where the scene's cameras do in the other order alone."""
    changed = reordered(poses[:, :3, :3], -1 if scalar_last else 1)
    apart = []
    for turns in (poses[:, :3, :3], changed):
        cosines = np.einsum("nij,vji->nv", turns, beside.cam_from_world[:, :3, :3]) / 2 - 0.5
        apart.append(np.median(np.degrees(np.arccos(cosines.clip(-1, 1).max(axis=1)))))
    if apart[1] < ALIKE and apart[0] > OTHER:
        first, last = ("last", "first") if scalar_last else ("first", "last")
        raise ProjectError(
            f"{path}: by quaternions with the scalar {first} it looks {apart[0]:.0f} degrees away "
            f"from the scene's cameras, with the scalar {last} {apart[1]:.0f}; name the columns in "
            "a first line, such as '# timestamp tx ty tz qw qx qy qz'"
        )


def reordered(rotations: Float64, places: int) -> Float64:
    """(..., 3, 3) of the quaternions (x, y, z, w) of rotations, rolled by so many places."""
    from scipy.spatial.transform import Rotation

    turned = np.roll(Rotation.from_matrix(rotations).as_quat(), places, axis=-1)
    return np.asarray(Rotation.from_quat(turned).as_matrix())


def _rows(
    path: Path,
) -> tuple[tuple[tuple[int, ...], str, str] | None, list[tuple[int, list[str]]], bool]:
    """Columns and unit that a head names, line numbers and words, whether commas part them."""
    if path.suffix == ".npy":
        with reading(path, "expected an array of N poses, 4x4 or 3x4 each; save it again"):
            array = load_array(path).astype(np.float64)
            table = array.reshape(len(array), -1)
        return None, [(at, [f"{x:.17g}" for x in row]) for at, row in enumerate(table, 1)], False
    try:
        text = read_text(path).replace('"', "")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise ProjectError(f"{path}: cannot be read as a trajectory ({reason})") from error
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    data = next((i for i, (_, line) in enumerate(lines) if not line.lstrip().startswith("#")), 0)
    named = next(filter(None, (_head(line) for _, line in reversed(lines[: data + 1]))), None)
    if named is not None and _head(lines[data][1]) is not None:
        data += 1
    kept = [(number, line) for number, line in lines[data:] if not line.lstrip().startswith("#")]
    if not kept:
        raise ProjectError(f"{path}: no poses; expected one line for each camera")
    for number, line in kept[:1]:
        words = re.split(r"[;\s]+", line.strip(" \t;"))
        if len(words) > 3 and any("," in w for w in words) and all(map(_DECIMAL.fullmatch, words)):
            raise ProjectError(
                f"{path}:{number}: numbers with decimal commas, such as {words[1][:40]!r}; "
                "expected decimal points; export it again with another locale"
            )
    rows = [(number, re.split(r"[,;\s]+", line.strip(" \t,;"))) for number, line in kept]
    return named, _joined(rows), bool(re.search("[,;]", kept[0][1]))


def _joined(rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Matrices that have a line for each row, in one line each; numbers in front are left out."""
    lengths = [len(words) for _, words in rows]
    for step in (4, 5):
        pattern = [*lengths[: step - 4], 4, 4, 4, 4]
        alike = pattern[0] < 5 and lengths == pattern * (len(rows) // step)
        if alike and all(map(_ZERO.fullmatch, rows[step - 1][1][:3])):
            starts = range(step - 4, len(rows), step)
            return [(rows[k][0], [w for _, line in rows[k : k + 4] for w in line]) for k in starts]
    return rows


def _head(line: str) -> tuple[tuple[int, ...], str, str] | None:
    """Columns as ``_Form`` has them, and the units of time and place."""
    line = _UNIT.sub(r"[\1]", line.strip().lstrip("#%").strip().lower())
    found: dict[str, int] = {}
    parts: dict[bool, int] = {}
    unit = length = ""
    for column, word in enumerate(re.split(r"\s*[,;]\s*|\s+", line)):
        name, _, given = word.rstrip("]").partition("[")
        name = "_".join(name.split(".")[-2:])
        if match := _PART.fullmatch(name):
            parts.setdefault(bool(match[1]), column)
        if (match := _TURN.fullmatch(name)) and "q" + match[1] not in found:
            found["q" + match[1]] = column
        elif (match := _TIME.fullmatch(name)) and "time" not in found:
            found["time"] = column
            given = match[1] or given
            unit = {"n": "ns", "u": "us", "µ": "us", "m": "ms", "s": "s"}.get(given[:1], "")
        elif (match := _PLACE.fullmatch(name)) and match[1] not in found:
            found[match[1]], length = column, given
    keys = ["time", "x", "y", "z", "qx", "qy", "qz", "qw"]
    if len(parts) == 2:  # of a time's seconds and the nanoseconds that belong to them
        found["time"], found["fraction"], unit = parts[False], parts[True], "s"
        keys.append("fraction")
    if set(keys) <= set(found):
        return tuple(found[key] for key in keys), unit, length
    return None


def _read(
    rows: list[tuple[int, list[str]]], columns: tuple[int, ...] | None, *, more: bool, path: Path
) -> tuple[Float64, Float64]:
    """Stamps, and (N, 4, 4) poses."""
    if columns is None:
        stamps, poses = np.empty(len(rows)), np.empty((len(rows), 4, 4))
        for i, (number, words) in enumerate(rows):
            where = f"{path}:{number}"
            stamps[i], poses[i] = _matrix(words, len(rows[0][1]), where=where)
            try:
                nearest, defect = rigid_transform(poses[i], what=where)
            except ShapeError as error:
                raise ProjectError(str(error)) from None
            if defect > ROTATION_ROUNDING:
                poses[i] = nearest
        return stamps, poses
    values = np.empty((len(rows), len(columns)))
    for i, (number, words) in enumerate(rows):
        if len(words) > max(columns) and (len(words) == 8 or more):
            words = [words[column] for column in columns]
        values[i] = _numbers(words, len(columns), where=f"{path}:{number}")
    turns = values[:, 4:8]
    norms = np.linalg.norm(turns, axis=1)
    if (wrong := np.flatnonzero(np.abs(norms - 1) > QUATERNION_TOLERANCE)).size:
        raise ProjectError(
            f"{path}:{rows[wrong[0]][0]}: a quaternion of length {norms[wrong[0]]:.6g}; expected 1 "
            "(order qx qy qz qw)"
        )
    from scipy.spatial.transform import Rotation

    poses = rigid_poses(Rotation.from_quat(turns).as_matrix(), values[:, 1:4])
    fraction = 1e-9 * values[:, 8:].sum(axis=1)
    # A whole time in nanoseconds beside that in seconds says the same again.
    return values[:, 0] + fraction * (np.abs(fraction).max() < 1), poses


def _matrix(words: list[str], count: int, *, where: str) -> tuple[float, Float64]:
    """What stands in front, and the (4, 4) matrix of 12 or 16 numbers."""
    if count not in MATRICES:
        _numbers(words, 12, where=where)
    values = _numbers(words, count, where=where)
    matrix = np.eye(4)
    matrix[: count // 4 if count > 13 else 3] = values[count % 4 :].reshape(-1, 4)
    if matrix[3].tolist() != [0, 0, 0, 1]:
        raise ProjectError(f"{where}: the last row is {matrix[3].tolist()}; expected 0 0 0 1")
    return float(values[0]), matrix


def _numbers(words: list[str], count: int, *, where: str) -> Float64:
    """The numbers of a line, all finite."""
    if len(words) != count:
        raise ProjectError(f"{where}: {len(words)} numbers; expected {count} as in the layout")
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise ProjectError(
            f"{where}: {str(error)[:200]}; expected {count} numbers, or a first line that names "
            f"the columns ({_NAMES['tum']})"
        ) from None
    if not np.isfinite(values).all():
        raise ProjectError(f"{where}: NaN or infinity; remove the line or mend it")
    return values


def _with_intrinsics(poses: Float64, like: Cameras, names: list[str], *, path: Path) -> Cameras:
    """The poses with the intrinsics of ``like``: one for all, or one each."""
    if len(like) < 1:
        raise ProjectError(f"{path}: no camera to take the intrinsics from; give at least one")
    rows = np.arange(len(poses)) if len(like) == len(poses) else np.zeros(len(poses), np.int64)
    rigid = np.array([rigid_transform(pose, what=str(path))[0] for pose in poses])
    return Cameras(
        like.K[rows], invert_rigid(rigid), like.width[rows], like.height[rows], tuple(names)
    )
