"""Matching of pictures, depth maps and poses by file name, number and time stamp."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from itertools import islice
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from gvtools.cameras import rigid_poses
from gvtools.errors import DegenerateError, ProjectError
from gvtools.scenes.images import IMAGE_SUFFIXES
from gvtools.scenes.scene import Finding, natural_key
from gvtools.trajectory_files import in_seconds
from gvtools.untrusted import is_file, named_file

Float64 = NDArray[np.float64]

# Stamps of the other list within the limit of one, on average, at most.
MOST_CANDIDATES = 100
# Files of a folder that absent ones are looked for among.
MOST_FILES = 200_000
NAMED_AT_MOST = 3  # a message names this many files and counts the rest


def named(items: Sequence[object]) -> str:
    """The first few of ``items`` and how many more, for a message."""
    shown = ", ".join(str(item) for item in items[:NAMED_AT_MOST])
    rest = len(items) - NAMED_AT_MOST
    return shown + (f" and {rest} more" if rest > 0 else "")


def natural(names: Iterable[str]) -> tuple[str, ...]:
    """Names in natural order, each once.

    >>> natural(["b10", "b9", "b9"])
    ('b9', 'b10')
    """
    return tuple(sorted(set(names), key=natural_key))


def scenes_holding(root: Path, *patterns: str) -> tuple[str, ...]:
    """Folders below ``root`` that hold something, as relative names in natural order."""
    found = (path.parent for pattern in patterns for path in root.glob(pattern))
    return natural(path.relative_to(root).as_posix() for path in found)


def given_folder(folder: Path, held: str) -> Path:
    """The folder that the caller gave for what lies beside a project, named in the plural."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ProjectError(f"{folder}: no such folder ({held} were expected there)")
    return folder


def pictures_in(folder: Path, suffixes: Collection[str] = IMAGE_SUFFIXES) -> list[Path]:
    """The folder's files of the suffixes in natural order of names; none where it is absent."""
    if not folder.is_dir():
        return []
    paths = (path for path in folder.iterdir() if path.suffix.lower() in suffixes)
    return sorted(paths, key=lambda path: natural_key(path.name))


def pictures_by_stem(folder: Path) -> dict[str, Path]:
    """The folder's pictures by name without suffix, since copies often have another suffix."""
    return {path.stem: path for path in pictures_in(folder)}


def numbers_in(folder: Path, template: str) -> set[int]:
    """Which numbers the files of a folder have whose names are like "rgb_{:05d}.jpg"."""
    before, after = re.split(r"\{.*\}", template)
    name = re.compile(f"{re.escape(before)}([0-9]+){re.escape(after)}")
    try:
        matches = [name.fullmatch(entry) for entry in os.listdir(folder)]
    except (FileNotFoundError, NotADirectoryError):
        return set()
    return {int(match[1]) for match in matches if match}


def pair_by_name(pictures: Sequence[Path], depths: Sequence[Path]) -> dict[Path, Path]:
    """For each picture its depth map: of the same stem, else of the same leading number."""
    stems = {path.stem: path for path in depths}
    if any(path.stem in stems for path in pictures):
        return {path: stems[path.stem] for path in pictures if path.stem in stems}
    leading = {_leading_number(path): path for path in depths}
    numbered = ((path, _leading_number(path)) for path in pictures)
    return {path: leading[number] for path, number in numbered if number in leading}


def _leading_number(path: Path) -> int | str:
    match = re.match(r"\D*(\d+)", path.stem)
    return int(match.group(1)) if match else path.stem


# A name's time, after what all share in front: seconds, seconds and nanoseconds, or a whole number
# of a finer unit, which no date is (20261127083015).
STAMP = re.compile(
    r"\d+\.\d+|(?P<prefix>.*?(?<!\d))(?:\d{9,10}\.\d+|\d{9,10}[_-]\d{9}|"
    r"(?!(?:19|20)\d\d[01]\d[0-3]\d{7}(?:\d{3})?$)\d{13,19})"
)
# What else than a picture's suffix the same frame's files end in, as 7-Scenes has them.
_KINDS = (".color", ".rgb")


def stem(name: str) -> str:
    """A picture's name without the suffixes that pictures have; other dots are part of it.

    >>> stem("cam0/1403.25.png"), stem("1403.5"), stem("frame-000001.color.png")
    ('cam0/1403.25', '1403.5', 'frame-000001')
    """
    name = unicodedata.normalize("NFC", name.replace("\\", "/"))
    for endings in (IMAGE_SUFFIXES, _KINDS):
        ending = next((end for end in endings if name.lower().endswith(end)), "")
        name = name[: len(name) - len(ending)]
    return name


def times_in(names: Sequence[str]) -> Float64 | None:
    """(N,) seconds, where every picture is named by a time of its own; else None.

    What stands in front of the times has to be the same.

    >>> times_in(["cam0/1403636579763555584.png", "cam0/1403636579813555456.png"]).round(2)
    array([1.40363658e+09, 1.40363658e+09])
    """
    stems = [PurePosixPath(stem(name)).name for name in names]
    matches = [match for match in map(STAMP.fullmatch, stems) if match]
    if not len(names) == len(set(stems)) == len(matches) > 0:
        return None
    prefixes = {match["prefix"] or "" for match in matches}
    texts = [text[len(min(prefixes)) :].replace("_", ".").replace("-", ".") for text in stems]
    return in_seconds(np.array(texts, np.float64)) if len(prefixes) == 1 else None


def paired(first: Sequence[str], second: Sequence[str]) -> list[tuple[int, int]]:
    """Rows of one name in both, whole or without suffixes and with the folders of only one.

    >>> paired(["images/a.jpg", "images/b.jpg"], ["b.png", "c.png"])
    [(1, 0)]
    """
    other = {name: row for row, name in enumerate(second)}
    pairs = {row: other[name] for row, name in enumerate(first) if name in other}
    tails: dict[tuple[str, ...], list[int]] = {}
    wholes = [PurePosixPath(stem(name)).parts for name in second]
    for row, parts in enumerate(wholes):
        for start in range(len(parts)):
            tails.setdefault(parts[start:], []).append(row)
    taken: dict[int, int] = {row: i for i, row in pairs.items()}
    for i, name in enumerate(first):
        if i in pairs:
            continue
        parts = PurePosixPath(stem(name)).parts
        found = {row for start in range(len(parts)) for row in tails.get(parts[start:], [])
                 if start == 0 or wholes[row] == parts[start:]}  # fmt: skip
        for row in found:
            if len(found) > 1 or taken.setdefault(row, i) != i:
                both = [second[r] for r in sorted(found)[:2]] if len(found) > 1 else [
                    first[taken[row]], name
                ]  # fmt: skip
                raise DegenerateError(
                    f"association by name: {both[0]!r} and {both[1]!r} are one name; expected each "
                    "once; give folders of one camera"
                )
            pairs[i] = row
    return sorted(pairs.items())


def is_hidden(name: str) -> bool:
    """Whether a file or a folder above it is hidden, or one that systems make (``@eaDir``)."""
    return any(part[0] in ".@#$" or part == "__MACOSX" for part in name.split("/"))


def find_renamed(
    folder: Path,
    files: Sequence[Path],
    *,
    where: Sequence[str] | None = None,
    noun: str = "pictures",
    also: Path | None = None,
) -> tuple[list[Path], list[Finding]]:
    r"""Files that lists name in a folder; for one that is absent, the only one of nearly that name.

    It differs by the separator "\", case, Unicode form, signs written as in addresses ("%20") or
    suffix, and, where none is as listed, by folders in front of one of the two names. Absolute
    names may be those of another computer.
    A name that leads out of the folder and to no such file is refused where ``where`` says for each
    what names it; links are followed. Files may lie in a second folder, ``also``, as listed.
    """
    home, found = Path(os.path.abspath(folder)), list(files)
    names = [os.path.relpath(file, home) for file in files]
    places = [Path(os.path.abspath(item)) for item in (folder, also or folder)]
    whole = [Path(os.path.abspath(file)) for file in files]
    inside = [any(map(file.is_relative_to, places)) for file in whole]
    absent = [row for row, file in enumerate(files) if not (inside[row] and is_file(file))]
    if not absent:
        return found, []
    known = set(names) - {names[row] for row in absent}
    listed = set(names)
    walk = ((Path(top).relative_to(home), inner) for top, _, inner in os.walk(home))
    every = ((top / name).as_posix() for top, inner in walk for name in inner)
    there = [name for name in islice(every, MOST_FILES) if name not in listed]
    there = [name for name in there if not is_hidden(name)]
    taken: dict[str, list[int]] = {}
    levels = [_Tails(there, twice=twice) for twice in (None, False, True)]
    for row in absent:
        others = (level.only(names[row], whole=bool(known)) for level in levels)
        if (other := next(filter(None, others), None)) is not None:
            taken.setdefault(other, []).append(row)
    renamed = {rows[0]: name for name, rows in taken.items() if len(rows) == 1}
    for row in absent:
        if row in renamed:
            found[row] = folder / renamed[row]
        elif where is not None and (not inside[row] or "\0" in str(files[row])):
            named_file(home, whole[row], where=where[row], follow_links=True)
    if not renamed:
        return found, []
    row, name = next(iter(renamed.items()))
    line = (
        f"{len(renamed)} {noun} are named otherwise than listed ({names[row]!r}: {name!r}): taken, "
        "as each fits one name alone"
    )
    return found, [Finding("info", line)]


class _Tails:
    """Names by what they end in, freed of case and Unicode form, and of suffixes unless None."""

    def __init__(self, names: Sequence[str], *, twice: bool | None) -> None:
        self.twice = twice
        self.wholes = {name: self._parts(name) for name in names}
        self.tails: dict[tuple[str, ...], list[str]] = {}
        for name, parts in self.wholes.items():
            for start in range(len(parts)):
                self.tails.setdefault(parts[start:], []).append(name)

    def _parts(self, name: str) -> tuple[str, ...]:
        name = unquote(unicodedata.normalize("NFC", name.replace("\\", "/"))).casefold()
        for _ in range(0 if self.twice is None else 1 + self.twice):
            name = stem(name).removesuffix("_mask")
        return PurePosixPath(unicodedata.normalize("NFC", name)).parts

    def only(self, name: str, *, whole: bool) -> str | None:
        """The one name that shares most of its end, all of its parts with ``whole``."""
        parts = self._parts(name)
        for start in range(1 if whole else len(parts)):
            ending = self.tails.get(parts[start:], [])
            found = [other for other in ending if self.wholes[other] == parts[start:]]
            if found := found or (ending if start == 0 and not whole else []):
                return found[0] if len(found) == 1 else None
        return None


def associate(first: Float64, second: Float64, limit: float) -> dict[int, int]:
    """Pairs of nearest time stamps in seconds, each used once: index of ``first`` to ``second``."""
    order = np.argsort(second, kind="stable")
    low = np.searchsorted(second[order], first - limit, side="left")
    high = np.searchsorted(second[order], first + limit, side="right")
    if int((high - low).sum()) > MOST_CANDIDATES * (len(first) + len(second)):
        raise ProjectError(
            f"{int((high - low).sum())} pairs of {len(first)} and {len(second)} time stamps are "
            f"within {limit:g} s; expected a few of each; give a smaller max_time_difference"
        )
    candidates = sorted(
        (abs(first[i] - second[j]), i, int(j))
        for i in range(len(first))
        for j in order[low[i] : high[i]]
    )
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in candidates:
        if i not in pairs and j not in taken:
            pairs[i] = j
            taken.add(j)
    return pairs


def pose_at(
    time: float, times: Float64, poses: Float64, *, same: float, longest_gap: float = 0.0
) -> Float64 | None:
    """(4, 4) cam_from_world at a time: a stored pose, or one interpolated between its neighbours.

    A pose within ``same`` of the time is taken as it is. Else the camera's centre is interpolated
    linearly, its rotation spherically (slerp). None outside of the trajectory, and where the
    neighbours are more than ``longest_gap`` apart. ``times`` (N,) increase.
    """
    from scipy.spatial.transform import Rotation, Slerp

    after = int(np.searchsorted(times, time))
    near = [i for i in (after - 1, after) if 0 <= i < len(times)]
    nearest = min(near, key=lambda i: abs(times[i] - time))
    if abs(times[nearest] - time) <= same:
        return np.asarray(poses[nearest], np.float64)
    if len(near) < 2 or times[after] - times[after - 1] > longest_gap:
        return None
    pair = poses[after - 1 : after + 1]
    share = (time - times[after - 1]) / (times[after] - times[after - 1])
    centers = -np.einsum("nji,nj->ni", pair[:, :3, :3], pair[:, :3, 3])
    turn = Slerp([0, 1], Rotation.from_matrix(pair[:, :3, :3]))(share).as_matrix()
    return rigid_poses(turn, -turn @ (centers[0] + share * (centers[1] - centers[0])))
