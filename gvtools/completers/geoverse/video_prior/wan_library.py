"""Wan's two networks by diffusers, imported when first needed.

Nothing else of diffusers is used: no pipeline, no scheduler, and so no transformers.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import nn

from gvtools.errors import CheckpointError

COMPONENTS = {"transformer": "WanVACETransformer3DModel", "vae": "AutoencoderKLWan"}


def network_class(component: str) -> Any:
    """The class of "transformer" or "vae".

    Raises:
        CheckpointError: diffusers is absent, too old, or does not work.
    """
    name = COMPONENTS[component]
    with _broken_torchvision_hidden() as hidden:
        try:
            import diffusers
            from diffusers.utils import import_utils

            if hidden:
                # Whoever imported diffusers before has let it believe otherwise.
                import_utils._torchvision_available = False
            return getattr(diffusers, name)
        except (ImportError, AttributeError, RuntimeError) as error:
            raise CheckpointError(
                f"the video prior needs diffusers' {name}, which cannot be imported "
                f"({str(error).strip().splitlines()[-1]}); pip install 'gvtools[wan]', or switch "
                "the video prior off"
            ) from error


def empty_network(component: str, config: Mapping[str, Any]) -> nn.Module:
    """A network of a diffusers config, on the meta device: shapes, no numbers, no memory.

    Args:
        component: "transformer" or "vae".
        config: as in the component's config.json.

    Raises:
        CheckpointError: diffusers is absent, or makes no network of the config.
    """
    kind = network_class(component)
    try:
        with torch.device("meta"):
            network: nn.Module = kind.from_config(dict(config))
    except Exception as error:
        raise CheckpointError(
            f"no {COMPONENTS[component]} comes of this configuration ({error}); take the "
            "config.json that belongs to the weights"
        ) from error
    return network


def read_config(folder: Path) -> dict[str, Any]:
    """A component's config.json.

    Raises:
        CheckpointError: absent, or not a JSON object.
    """
    path = folder / "config.json"
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error.strerror or error}); expected the config.json of a "
            "network in diffusers' form"
        ) from error
    except ValueError as error:
        raise CheckpointError(f"{path}: not JSON ({error}); download it again") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{path}: a {type(config).__name__}; expected a JSON object")
    return config


@contextmanager
def _broken_torchvision_hidden() -> Iterator[bool]:
    """Where torchvision does not fit torch, diffusers would fail on it, and can do without.

    Gives whether that is so.
    """
    try:
        import torchvision  # noqa: F401
    except Exception:
        for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
            del sys.modules[name]
        # None makes the import system, and diffusers with it, take the package as not installed.
        sys.modules["torchvision"] = None  # type: ignore[assignment]
        try:
            yield True
        finally:
            del sys.modules["torchvision"]
        return
    yield False
