"""gvtools: posed photographs or RGB-D in, a coloured point-cloud memory that grows, numbers out.

The names below are what a user of the library writes. Each is loaded when it is first used, so
``import gvtools`` itself takes milliseconds and loads neither torch nor Open3D.

>>> import numpy as np
>>> import gvtools
>>> camera = gvtools.Cameras.pinhole(64, 48, focal=60.0)
>>> rgb = np.full((48, 64, 3), 200, np.uint8)
>>> depth = np.full((48, 64), 2.0, np.float32)
>>> memory = gvtools.SpatialMemory(voxel=0.05)
>>> report = memory.observe(rgb, depth, camera, round=0)  # a grey wall, 2 units ahead
>>> float(memory.project(camera).depth[0, 24, 32].round(3))
2.0
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# This package's front stands on top of all layers: it only re-exports, and no module of the
# project imports these names from it. One entry points upwards, to pipelines.api, which composes
# the library into runs. import-linter sees neither imports by name nor those for type checkers, so
# tests/test_public_api.py holds that this is the only one, and that nothing goes through it.
if TYPE_CHECKING:
    from gvtools.cameras import Cameras
    from gvtools.completers.base import Completer, Completion, ContextView, complete
    from gvtools.completers.base import register as register_completer
    from gvtools.errors import GvError
    from gvtools.evaluation.trajectories import absolute_errors as ate
    from gvtools.evaluation.trajectories import relative_errors as rpe
    from gvtools.guidance import Guidance
    from gvtools.memory.projection import project
    from gvtools.memory.spatial_memory import SpatialMemory, TiledMemory
    from gvtools.runs.run import load_run
    from gvtools.scenes.project import open_project
    from gvtools.trajectory_files import read_poses
    from pipelines.api import evaluate, reconstruct

# Where each public name is defined; the same as the imports above.
_SOURCES = {
    "Cameras": "gvtools.cameras:Cameras",
    "Completer": "gvtools.completers.base:Completer",
    "Completion": "gvtools.completers.base:Completion",
    "ContextView": "gvtools.completers.base:ContextView",
    "Guidance": "gvtools.guidance:Guidance",
    "GvError": "gvtools.errors:GvError",
    "SpatialMemory": "gvtools.memory.spatial_memory:SpatialMemory",
    "TiledMemory": "gvtools.memory.spatial_memory:TiledMemory",
    "ate": "gvtools.evaluation.trajectories:absolute_errors",
    "complete": "gvtools.completers.base:complete",
    "evaluate": "pipelines.api:evaluate",
    "load_run": "gvtools.runs.run:load_run",
    "open_project": "gvtools.scenes.project:open_project",
    "project": "gvtools.memory.projection:project",
    "read_poses": "gvtools.trajectory_files:read_poses",
    "reconstruct": "pipelines.api:reconstruct",
    "register_completer": "gvtools.completers.base:register",
    "rpe": "gvtools.evaluation.trajectories:relative_errors",
}

__all__ = [
    "Cameras",
    "Completer",
    "Completion",
    "ContextView",
    "Guidance",
    "GvError",
    "SpatialMemory",
    "TiledMemory",
    "__version__",
    "ate",
    "complete",
    "evaluate",
    "load_run",
    "open_project",
    "project",
    "read_poses",
    "reconstruct",
    "register_completer",
    "rpe",
]


def __getattr__(name: str) -> Any:
    if name not in _SOURCES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _SOURCES[name].split(":")
    if not module.startswith("gvtools."):
        from gvtools.packages import hidden

        problem = hidden()
        if problem is not None:
            raise ImportError(problem)
    value = globals()[name] = getattr(import_module(module), attribute)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
