# mypy: no-check-untyped-defs
from __future__ import annotations

import numpy as np
from quake_map import room, write_archive

from benchmarks.experiments.level_walks import unjudged, write_walks
from gvtools.scenes.project import open_project
from gvtools.training.samples import Observation, project_observation


def test_versions_of_judged_maps_are_left_out():
    maps = ("maps/castle2.bsp", "maps/cavern.bsp", "maps/q1.bsp", "maps/q12.bsp")
    assert unjudged(maps, ("maps/castle.bsp", "maps/q1.bsp")) == ["maps/cavern.bsp", "maps/q12.bsp"]


def test_walks_are_scenes_whose_views_agree(tmp_path):
    levels = write_archive(tmp_path / "levels", {"cellar": room(), "attic": room()})
    judged = write_archive(tmp_path / "judged", {"attic2": room(), "attic": room()})
    out, said = tmp_path / "out", []
    options = {"walks": 2, "views": 3, "size": 48, "say": said.append}
    folders = write_walks(levels, judged, out, **options)
    assert [folder.name for folder in folders] == ["cellar_0", "cellar_1"]
    assert said == ["cellar: 2 walks"]
    pictures = [(folder / "frame-000000.color.png").read_bytes() for folder in folders]
    assert pictures[0] != pictures[1]
    scene = open_project(folders[0])
    first, last = (scene[name] for name in scene.names[::2])
    frames = [view.load() for view in (first, last)]
    assert len(scene) == 3 and min(frame.depth.min() for frame in frames) > 0
    from gvtools.completers.base import ContextView

    given = ContextView(first.name, first.camera, frames[0].rgb, frames[0].depth)
    guidance = project_observation(Observation((given,), (first.camera,)), last.camera)
    known = guidance.valid[0]
    assert known.mean() > 0.3
    error = np.abs(guidance.depth[0] / frames[1].depth - 1)[known]
    assert np.median(error) < 0.01
    # What is there is kept.
    (folders[0] / "frame-000000.color.png").write_bytes(b"mine")
    write_walks(levels, judged, out, **options)
    assert (folders[0] / "frame-000000.color.png").read_bytes() == b"mine"
