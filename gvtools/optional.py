"""Optional packages, imported where they are needed; their absence names the extra to install."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from gvtools.errors import GvError, OptionError


def require(module: str, *, extra: str, purpose: str, instead: str = "") -> Any:
    """A module of an optional package; ``purpose``: what it is needed for, for the message.

    >>> require("lasso", extra="scan", purpose="reading knots", instead="or untie them")
    Traceback (most recent call last):
        ...
    gvtools.errors.OptionError: reading knots needs lasso, which is not installed; pip install \
'gvtools[scan]', or untie them
    """
    try:
        return import_module(module)
    except ImportError as found:
        absent = isinstance(found, ModuleNotFoundError) and str(found.name) in module
        why = "is not installed" if absent else f"cannot be imported ({found})"
    except AttributeError as found:  # of packages whose parts do not fit each other
        why = f"cannot be imported ({found})"
    raise OptionError(_advice(module, why, extra=extra, purpose=purpose, instead=instead))


def package_folder(
    module: str, *, extra: str, purpose: str, instead: str = "", error: type[GvError] = OptionError
) -> Path:
    """The folder of a package that is not imported; arguments as of ``require``."""
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        why = "is not installed"
        raise error(_advice(module, why, extra=extra, purpose=purpose, instead=instead))
    return Path(spec.origin).parent


def installed(module: str) -> bool:
    """Whether a package is there; whether it works on this machine shows in use."""
    try:
        return find_spec(module) is not None
    except ValueError:  # imported, and of no file
        return False


def _advice(module: str, why: str, *, extra: str, purpose: str, instead: str) -> str:
    package = module.partition(".")[0]
    text = f"{purpose} needs {package}, which {why}; pip install 'gvtools[{extra}]'"
    return f"{text}, {instead}" if instead else text
