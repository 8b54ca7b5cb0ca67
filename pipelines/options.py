"""Command-line options generated from the fields of settings."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, Union
from typing import get_args as parts_of
from typing import get_origin as origin_of

from pydantic import ConfigDict

from gvtools.errors import GvError, OptionError
from gvtools.files import write_json
from gvtools.settings import Settings
from gvtools.settings.base import Entry, entries
from gvtools.settings.documentation import accepts, text_of

if TYPE_CHECKING:
    from pipelines.console import Console

A = TypeVar("A", bound="Arguments")


class Arguments(Settings):
    """A command, or what several share: a field for each argument.

    The docstring is the command's summary. A field ends in "_" where its name is taken. What stands
    in brackets at the end of a field's text is its unit or what the help calls its value. "[A B]"
    takes two values, "[NAME ...]" any number after the option; other sequences are given by
    repeating the option. Mappings are no options.

    >>> from pydantic import Field
    >>> class Blur(Arguments):
    ...     positional = ("picture",)
    ...     picture: str = Field(description="To blur. [FILE]")
    ...     radius: float = Field(1.0, ge=0, description="Of the kernel. [px]")
    >>> parser = argparse.ArgumentParser()
    >>> Blur.add(parser)
    >>> print(parser.format_help().splitlines()[-1].strip())
    --radius PX  Of the kernel (number, at least 0; default 1 px)
    >>> Blur.read(parser.parse_args(["a.png", "--radius", "-2"]))
    Traceback (most recent call last):
        ...
    gvtools.errors.OptionError: --radius -2.0; expected at least 0
    """

    # Most are never asked for: the parser needs the fields alone.
    model_config = ConfigDict(defer_build=True)

    examples: ClassVar[tuple[str, ...]] = ()  # for the help, which begins with the docstring
    # Of a command that has several; their examples begin after the action's name.
    actions: ClassVar[Mapping[str, type[Arguments]]] = {}
    positional: ClassVar[tuple[str, ...]] = ()
    exclusive: ClassVar[tuple[tuple[str, ...], ...]] = ()  # of each, one option may be given
    # Settings of something else by the options that give them; ``settings`` has what was given.
    settings_of: ClassVar[Mapping[str, str]] = {}
    title: ClassVar[str] = ""  # the help's heading of a class's own options, or "HEADING: TEXT"

    @classmethod
    def key(cls, path: str) -> str:
        """What messages call an option."""
        name = path.partition(".")[0]
        return name.upper() if name in cls.positional else _flag(name)

    @classmethod
    def add(cls, parser: argparse.ArgumentParser) -> None:
        """Add the arguments to a parser, those of the class itself before those that it shares."""
        known = entries(cls)
        shared = {name for base in cls.__bases__ for name in getattr(base, "model_fields", ())}
        holders: dict[str, Any] = {"": parser}
        for names in cls.exclusive:
            holders |= dict.fromkeys(names, parser.add_mutually_exclusive_group())
        for name in cls.positional:
            form = _form(known[name], _default(cls, name))
            if form.pop("action", None) == "append":
                form["nargs"] = "+"
            elif not cls.model_fields[name].is_required():
                form["nargs"] = "?"
            parser.add_argument(name, **form)
        titles = {name: cls._title(name) for name in known if name not in cls.positional}
        for name in sorted(titles, key=lambda name: (titles[name] != "", name in shared)):
            if origin_of(known[name].kind) is dict:
                continue
            title = titles[name]
            if title not in holders:
                holders[title] = parser.add_argument_group(*title.split(": ", 1))
            holders.get(name, holders[title]).add_argument(
                _flag(name),
                dest=name,
                default=None,
                **({"required": True} if cls.model_fields[name].is_required() else {}),
                **_form(known[name], _default(cls, name)),
            )

    @classmethod
    def _title(cls, name: str) -> str:
        owners = (base for base in cls.__mro__ if name in getattr(base, "model_fields", ()))
        return next((vars(base)["title"] for base in owners if vars(base).get("title")), "")

    @classmethod
    def read(cls: type[A], args: argparse.Namespace) -> A:
        """The arguments that a parser found, checked."""
        values = {name: getattr(args, name, None) for name in cls.model_fields}
        if cls.settings_of:
            values["settings"] = given_settings(args, cls.settings_of)
        return cls(**{name: value for name, value in values.items() if value is not None})

    def run(self, console: Console) -> None:
        """Do what the command is for."""
        raise NotImplementedError

    def refuse(self, names: Iterable[str], why: str) -> None:
        """Refuse those of some options that were given, which the command cannot heed."""
        for name in names:
            if name in self.model_fields_set:
                raise OptionError(f"{self.key(name)}: {why}; leave it out")


class JsonArguments(Arguments):
    """Where figures are written."""

    json_: Path | None = None
    """Write the figures there, too. [FILE]"""

    def write_json(self, figures: Mapping[str, Any]) -> bool:
        """Write figures where ``--json`` wants them; whether it does."""
        if self.json_ is not None:
            write_json(self.json_, figures)
        return self.json_ is not None


def check_ending(path: Path, endings: Iterable[str], *, option: str = "--out") -> str:
    """The end of a file's name in small letters; refused where it is none of ``endings``."""
    ending = path.suffix.lower()
    if ending not in endings:
        expected = ", ".join(endings)
        raise OptionError(f"{option} {path}: expected a name that ends with {expected}")
    return ending


def _flag(name: str) -> str:
    return f"--{name.rstrip('_').replace('_', '-')}"


def _default(cls: type[Settings], name: str) -> Any:
    field = cls.model_fields[name]
    return None if field.is_required() else field.get_default(call_default_factory=True)


def add_settings(
    parser: argparse._ActionsContainer,
    settings: Settings,
    options: Mapping[str, str],
    *,
    metavars: Mapping[str, str] | None = None,
) -> None:
    """An option for each of some settings; one that is not given is None.

    Type, choices, range, unit and help are the field's, the default is that of ``settings``. An
    optional boolean, or one that is true, gets ``--no-NAME`` as well.

    Args:
        options: dotted settings by the options' names in ``args``.
        metavars: of options, where the unit or the type does not say enough.
    """
    for name, key in options.items():
        holder: Any = settings
        *sections, field = key.split(".")
        for section in sections:
            holder = getattr(holder, section)
        form = _form(
            entries(type(holder))[field], getattr(holder, field), metavar=(metavars or {}).get(name)
        )
        parser.add_argument(_flag(name), dest=name, default=None, **form)


def given_settings(args: argparse.Namespace, options: Mapping[str, str]) -> dict[str, Any]:
    """Values by setting, of those options of ``add_settings`` that were given."""
    values = {key: getattr(args, name) for name, key in options.items()}
    return {key: value for key, value in values.items() if value is not None}


def _form(entry: Entry, value: Any, *, metavar: str | None = None) -> dict[str, Any]:
    """Arguments of ``add_argument`` for a field beside its name."""
    kinds = [entry.kind]
    if origin_of(entry.kind) in (Union, UnionType):
        kinds = [kind for kind in parts_of(entry.kind) if kind is not NoneType]
    kind, plain = kinds[0], len(kinds) == 1
    notes = [accepts(entry).removesuffix(", or none")] if kind in (int, float) else []
    form: dict[str, Any] = {}
    if kind is bool:
        one_way = value is False and not entry.optional
        form["action"] = "store_true" if one_way else argparse.BooleanOptionalAction
    elif origin_of(kind) is Literal and plain:
        form["choices"] = parts_of(kind)
    else:
        names = {int: "N", float: "X", Path: "PATH"}
        # A setting that may be none takes that word, too: the settings read it.
        form["type"] = kind if plain and kind in names and not entry.optional else str
        unit = entry.unit.upper() if entry.unit.islower() else entry.unit
        form["metavar"] = metavar or unit or names.get(kind)
        words = (form["metavar"] or "").split()
        if words[1:] == ["..."]:
            form |= {"nargs": "+", "metavar": words[0]}
        elif len(words) > 1:
            form |= {"nargs": len(words), "metavar": tuple(words)}
        elif origin_of(kind) is tuple and parts_of(kind)[-1] is ...:
            form["action"] = "append"
    if value not in (None, ()) and kind is not bool:
        unit = entry.unit if entry.unit.islower() else ""
        notes.append(f"default {text_of(value)} {unit}".rstrip())
    about = f" ({'; '.join(notes)})" if notes else ""
    return {**form, "help": f"{entry.doc.removesuffix('.')}{about}".replace("%", "%%")}


class HelpSettings(argparse.Action):
    """Like ``--help``, of the settings that ``settings`` makes of what was given before."""

    def __init__(
        self, *, settings: Callable[[argparse.Namespace], Sequence[Settings]], **options: Any
    ) -> None:
        super().__init__(**options, nargs=0, help="list all settings")
        self._settings = settings

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, *args: object
    ) -> None:
        """Print them to standard output and end the program with status 0."""
        from gvtools.settings import listing

        try:
            print(listing(*self._settings(namespace)))
        except GvError as error:
            parser.error(str(error))
        parser.exit()


def add_command(
    parsers: Any, name: str, command: type[Arguments], *, whole: bool = True, before: str = ""
) -> argparse.ArgumentParser:
    """The parser of a command or an action; without its arguments, unless ``whole``.

    ``before`` is what its examples leave out: the program's name and the command's.
    """
    text = " ".join((command.__doc__ or "").split()).removesuffix(".")
    lines = "\n".join(f"  {before}{line}".rstrip() for line in command.examples)
    parser: argparse.ArgumentParser = parsers.add_parser(
        name,
        help=text[:1].lower() + text[1:],
        description=f"examples:\n{lines}\n\n{text}.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(command_class=command)
    if not whole:
        return parser
    command.add(parser)
    if command.actions:
        actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
        for action, its_class in command.actions.items():
            added = add_command(actions, action, its_class, before=f"{parser.prog} {action} ")
            # As of every command; given before the action they hold as well.
            for option, what in (("quiet", "print nothing but warnings"), ("debug", "tracebacks")):
                added.add_argument(
                    f"--{option}", action="store_true", default=argparse.SUPPRESS, help=what
                )
    return parser
