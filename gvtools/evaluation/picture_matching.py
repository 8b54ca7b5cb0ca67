"""Which picture stands for which view: by name, or by order where names do not match.

Names are compared in lower case, without the file extension, without folders where that finds more
partners, and without a prefix or suffix that most pictures share (``generated_NAME.png``,
``NAME.rgb.png``). By order, both are sorted naturally by name (2 before 10), and the first picture
stands for the first view and so on; that needs as many pictures as views.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from gvtools.errors import OptionError
from gvtools.scenes.scene import natural_key

RULES = ("auto", "name", "order")
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm")


@dataclass(frozen=True)
class Matching:
    """Pictures and the views that they stand for.

    Attributes:
        rule: "name" or "order".
        picture_of: for each view the index of its picture; None where there is none.
        missing: names of the views without a picture.
        left_over: names of the pictures that stand for none of the views.
    """

    rule: str
    picture_of: tuple[int | None, ...]
    missing: tuple[str, ...]
    left_over: tuple[str, ...]


def match_pictures(
    pictures: Sequence[str],
    views: Sequence[str],
    *,
    rule: str = "auto",
    alphabetical: bool = False,
    what: str = "pictures",
) -> Matching:
    """Match pictures with views.

    Args:
        pictures: names, folders included.
        views: names of the views that are to be judged.
        rule: "name", "order", or "auto": by name where any name matches, by order where none does
            and there are as many pictures as views.
        alphabetical: whether numbers in the pictures' names count the views in alphabetical order
            (img10 before img2); "auto" is "order" then.
        what: the pictures, as error messages call them.

    >>> match_pictures(["r_2.png", "r_10.png"], ["2.jpg", "10.jpg"])
    Matching(rule='name', picture_of=(0, 1), missing=(), left_over=())
    >>> match_pictures(["00001.png", "00000.png"], ["a.jpg", "b.jpg"]).picture_of
    (1, 0)
    """
    if rule not in RULES:
        raise OptionError(f"--match {rule!r}; expected one of {', '.join(RULES)}")
    if not pictures:
        raise OptionError(f"{what}: no picture; expected one for each of {len(views)} views")
    # Pictures that are numbered alphabetically must not be taken for views whose names are numbers.
    by_name = rule == "name" or (rule == "auto" and not alphabetical)
    named = _by_name(pictures, views, what) if by_name else None
    found = 0 if named is None else sum(number is not None for number in named)
    if rule == "name" and not found:
        raise OptionError(
            f"{what}: none of {len(pictures)} pictures (first {pictures[0]!r}) is named like one "
            f"of {len(views)} views (first {views[0]!r}); rename them, or give --match order"
        )
    partial = 0 < found < min(len(pictures), len(views))
    if rule == "auto" and partial and len(pictures) == len(views):
        raise OptionError(
            f"{what}: {found} of {len(pictures)} pictures are named like views, the others are "
            "not, and the order would give other partners; say --match name or --match order"
        )
    if named is not None and found:
        return _matching("name", named, pictures=pictures, views=views)
    if len(pictures) != len(views):
        raise OptionError(
            f"{what}: {len(pictures)} pictures (first {pictures[0]!r}) for {len(views)} views "
            f"(first {views[0]!r}); expected names like the views', or as many pictures as views"
        )
    partners: list[int | None] = [None] * len(views)
    in_order = sorted(range(len(views)), key=views.__getitem__) if alphabetical else None
    for view, picture in zip(
        in_order or _natural_order(views), _natural_order(pictures), strict=True
    ):
        partners[view] = picture
    return _matching("order", partners, pictures=pictures, views=views)


def _matching(
    rule: str,
    partners: Sequence[int | None],
    *,
    pictures: Sequence[str],
    views: Sequence[str],
) -> Matching:
    used = {number for number in partners if number is not None}
    return Matching(
        rule,
        tuple(partners),
        tuple(view for view, number in zip(views, partners, strict=True) if number is None),
        tuple(name for number, name in enumerate(pictures) if number not in used),
    )


def _natural_order(names: Sequence[str]) -> list[int]:
    return sorted(range(len(names)), key=lambda number: natural_key(names[number]))


def _by_name(pictures: Sequence[str], views: Sequence[str], what: str) -> list[int | None]:
    """For each view the index of the picture with its name; None where there is none.

    Names are compared with and without folders; what finds most partners is taken.
    """
    tried: list[list[list[int]]] = [[[] for _ in views]]
    for view_keys in (_paths(views), _last_parts(views)):
        if len(set(view_keys)) == len(view_keys):
            for picture_keys in (_paths(pictures), _last_parts(pictures)):
                tried.append(_partners(picture_keys, view_keys))
    best = max(tried, key=lambda lists: sum(bool(numbers) for numbers in lists))
    for view, numbers in zip(views, best, strict=True):
        if len(numbers) > 1:
            listed = ", ".join(repr(pictures[number]) for number in numbers[:2])
            raise OptionError(
                f"{what}: {len(numbers)} pictures of the view {view!r} ({listed}); expected one; "
                "give a folder with one picture a view"
            )
    return [numbers[0] if numbers else None for numbers in best]


def _partners(pictures: Sequence[str], views: Sequence[str]) -> list[list[int]]:
    """For each view the indices of the pictures that have its name between a prefix and a suffix.

    Prefix and suffix are those that most pictures have, none if possible. No view has a picture
    where several pairs of them are equally frequent.
    """
    index = {view: number for number, view in enumerate(views)}
    pattern, affixes = _any_of(views), Counter[tuple[str, str]]()
    for picture in pictures:
        affixes.update(
            {(picture[: m.start(1)], picture[m.end(1) :]) for m in pattern.finditer(picture)}
        )
    out: list[list[int]] = [[] for _ in views]
    most = max(affixes.values(), default=0)
    commonest = [pair for pair, count in affixes.items() if count == most]
    if len(commonest) != 1 and ("", "") not in commonest:
        return out
    before, behind = ("", "") if ("", "") in commonest else commonest[0]
    for number, picture in enumerate(pictures):
        inner = picture[len(before) : len(picture) - len(behind)]
        if before + inner + behind == picture and inner in index:
            out[index[inner]].append(number)
    return out


def _any_of(views: Sequence[str]) -> re.Pattern[str]:
    """Matches any view's name as a whole word, the longest first; group 1 is the name."""
    names = "|".join(re.escape(view) for view in sorted(views, key=len, reverse=True))
    return re.compile(rf"(?=(?<![a-z0-9])({names})(?![a-z0-9]))")


def _paths(names: Sequence[str]) -> list[str]:
    return [_without_ending(name.replace("\\", "/")).lower() for name in names]


def _last_parts(names: Sequence[str]) -> list[str]:
    return [_without_ending(PurePosixPath(name.replace("\\", "/")).name).lower() for name in names]


def _without_ending(name: str) -> str:
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if path.suffix.lower() in IMAGE_ENDINGS else name
