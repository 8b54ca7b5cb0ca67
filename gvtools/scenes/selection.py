"""View selections: which of a scene's views are context, and which are targets.

A selection is one of ``all``, ``every:K``, ``every:K+OFFSET``, ``first:N``, ``last:N``,
``range:A-B`` (indices from 0, both ends included), ``not:SPEC``, image names with commas between
them, or ``@file`` with one name a line. Where names have commas, the longest that fits is taken.
``train`` names all views in the folder ``train/``, such as a split of Blender's synthetic scenes.

Several views of one picture (``room@front.jpg``, ``room@left.jpg``, see ``undistort``) count as
one, so that a split never stands between them; ``room.jpg`` names all of them.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from gvtools.errors import OptionError
from gvtools.scenes.undistort import picture_of
from gvtools.untrusted import read_text

GRAMMAR = (
    "all, every:K, every:K+OFFSET, first:N, last:N, range:A-B, not:SPEC, names, folders of names, "
    "or @file"
)
_KEYWORDS = ("every", "first", "last", "range", "not")
_EXAMPLES = ("all", "every:2", "first:6", "last:6", "range:0-5", "not:first:6")
_FORMS = {
    "every": r"(\d+)(?:\+(\d+))?",
    "first": r"(\d+)",
    "last": r"(\d+)",
    "range": r"(\d+)-(\d+)",
}


def select(names: Sequence[str], spec: str) -> tuple[str, ...]:
    """The view names that ``spec`` selects, in the order of ``names``."""
    pictures: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        pictures.setdefault(picture_of(name), []).append(i)
    chosen = _chosen(names, pictures, spec.strip(), whole=spec)
    if not chosen:
        raise OptionError(f"selection {spec!r}: none of {len(names)} views; expected at least one")
    return tuple(names[i] for i in sorted(chosen))


def is_view_or_folder(names: Sequence[str], text: str) -> bool:
    """Whether a text is the name of a view, or of a folder of views."""
    return text in names or text in _folders(names)


def path_and_selection(text: str) -> tuple[str, str]:
    """The two parts of PATH[@SELECTION], "all" without one; paths that exist may hold an "@".

    >>> path_and_selection("runs/a@every:2"), path_and_selection("runs/a")
    (('runs/a', 'every:2'), ('runs/a', 'all'))
    """
    ends = [at for at, sign in enumerate(text + "@") if sign == "@"]
    end = next((end for end in reversed(ends) if end and path_exists(text[:end])), ends[0])
    return text[:end], text[end + 1 :] if end < len(text) else "all"


def path_exists(text: str) -> bool:
    """Whether there is such a file or folder; a text may be too long for a path."""
    try:
        return Path(text).exists()
    except (OSError, ValueError):
        return False


def _chosen(
    names: Sequence[str], pictures: Mapping[str, list[int]], spec: str, *, whole: str
) -> set[int]:
    """Numbers of views; ``pictures`` holds those of each picture."""
    everything = set(range(len(names)))
    if spec == "all":
        return everything
    index = {**_folders(names), **pictures, **{name: [i] for i, name in enumerate(names)}}
    if spec.startswith("@"):
        return _by_name(index, _lines(Path(spec[1:])), f"{spec[1:]}")
    # Views' own names win over a form that looks like them.
    if spec in index:
        return set(index[spec])
    keyword, colon, rest = spec.partition(":")
    if keyword == "not" and colon:
        return everything - _chosen(names, pictures, rest.strip(), whole=whole)
    listed = _listed(tuple(index), spec)
    if not colon or not index.keys().isdisjoint(listed):
        return _by_name(index, listed, f"selection {whole!r}")
    if keyword not in _FORMS:
        near = difflib.get_close_matches(keyword, _KEYWORDS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"expected {GRAMMAR}"
        raise OptionError(f"selection {whole!r}: unknown form {keyword!r}; {hint}")
    match = re.fullmatch(_FORMS[keyword], rest)
    if match is None:
        raise OptionError(f"selection {whole!r}: {rest!r} after {keyword!r}; expected {GRAMMAR}")
    numbers = [int(group) for group in match.groups(default="0")]
    rows = list(pictures.values())
    counted = _counted(keyword, numbers, len(rows), whole=whole)
    return {i for number in counted for i in rows[number]}


def _folders(names: Sequence[str]) -> dict[str, list[int]]:
    """Numbers of the views in each folder that names begin with."""
    folders: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        for end in (at for at, sign in enumerate(name) if sign == "/" and at):
            folders.setdefault(name[:end], []).append(i)
    return folders


def _counted(keyword: str, numbers: list[int], count: int, *, whole: str) -> Sequence[int]:
    first, second = numbers[0], numbers[-1]
    if keyword == "every" and first > 0:
        return range(second, count, first)
    if keyword == "range" and first <= second < count:
        return range(first, second + 1)
    if keyword in ("first", "last") and first <= count:
        return range(first) if keyword == "first" else range(count - first, count)
    raise OptionError(
        f"selection {whole!r}: there are {count} views; expected steps of 1 or more, at most "
        f"{count} views, and 0 <= A <= B <= {count - 1}"
    )


def _by_name(index: Mapping[str, list[int]], listed: Sequence[str], what: str) -> set[int]:
    wanted = [name for name in listed if name]
    unknown = [name for name in wanted if name not in index]
    if unknown:
        near = difflib.get_close_matches(unknown[0], [*index, *_EXAMPLES], n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"expected {GRAMMAR}"
        more = f" and {len(unknown) - 1} more" if len(unknown) > 1 else ""
        raise OptionError(f"{what}: no view named {unknown[0]!r}{more} among {len(index)}; {hint}")
    return {i for name in wanted for i in index[name]}


def _listed(names: Sequence[str], spec: str) -> list[str]:
    """The parts between commas, those of one view's name together."""
    known, parts, listed = set(names), spec.split(","), list[str]()
    most = 1 + max((name.count(",") for name in names), default=0)
    while parts:
        joined = (",".join(parts[:count]).strip() for count in range(min(most, len(parts)), 0, -1))
        name = next((name for name in joined if name in known), parts[0].strip())
        listed.append(name)
        del parts[: 1 + name.count(",")]
    return listed


def _lines(path: Path) -> list[str]:
    try:
        lines = read_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise OptionError(
            f"@{path}: unreadable ({error}); expected a text file with one view name a line"
        ) from None
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


def check_disjoint(context: Sequence[str], targets: Sequence[str]) -> None:
    """Refuse targets that are context as well, views of one picture included."""
    seen = {picture_of(name) for name in context}
    both = [name for name in targets if picture_of(name) in seen]
    if both:
        raise OptionError(
            f"context and targets overlap in {len(both)} views ({len(context)} context, "
            f"{len(targets)} targets; first {both[0]!r}); expected none; change one, or "
            "pass --allow-overlap"
        )
