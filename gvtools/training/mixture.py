"""The mixture of the paper's fifteen data sets, as far as a folder of downloads holds it.

``configs/base_mixture.json`` names them with the square roots of their numbers of frames. A data
set lies in ROOT/NAME, estimates of its poses and depth (Pi3's, in the paper) in
ROOT/NAME_estimated; how often these stand for its own geometry, and when they have to, its spec
says.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gvtools.errors import GvError, OptionError
from gvtools.scenes.project import open_collection
from gvtools.settings import with_file
from gvtools.training.data import open_source
from gvtools.training.options import SHIPPED, SceneSource, TrainingSettings

MIXTURE = SHIPPED / "base_mixture.json"


@dataclass(frozen=True)
class MixedDataSet:
    """A data set of the mixture, and what of it is there."""

    name: str
    share: float  # of samples; 0 where it cannot be used
    note: str  # its scenes and whose geometry they have, or why it is left out


def with_data(
    config: TrainingSettings, root: Path
) -> tuple[TrainingSettings, tuple[MixedDataSet, ...]]:
    """The training on what of the mixture lies in ``root``, all of its samples, and what does."""
    if not root.is_dir():
        raise OptionError(f"--data {root}: not a folder; expected downloads, as {root}/hypersim")
    whole = with_file(TrainingSettings(), MIXTURE).data
    used: list[SceneSource] = []
    notes = {}
    for entry in whole.scenes:
        assert isinstance(entry, SceneSource) and entry.root and entry.estimated
        folder, estimates = root / entry.root, root / entry.estimated
        here = entry.replaced(
            root=str(folder), estimated=str(estimates) if estimates.is_dir() else None
        )
        if not folder.is_dir():
            notes[entry.root] = f"no folder {folder}"
            continue
        try:
            collection, _, own = open_source(here)
            if here.estimated:
                open_collection(here.estimated)
        except GvError as error:
            notes[entry.root] = str(error)
            continue
        used.append(here)
        geometry = f"{own:.0%} own geometry" if here.estimated else "own geometry alone"
        notes[entry.root] = f"{len(collection)} scene(s), {geometry}"
    total = sum(entry.weight or 0 for entry in used)
    shares = {Path(str(e.root)).name: (e.weight or 0) / total for e in used}
    found = tuple(MixedDataSet(name, shares.get(name, 0.0), note) for name, note in notes.items())
    if not used:
        raise OptionError(
            f"--data {root}: none of the {len(notes)} data sets can be used, first "
            f"{found[0].name}: {found[0].note}; expected downloads in folders of these names "
            "(docs/training_data.md)"
        )
    data = config.data.replaced(scenes=tuple(used), scene_share=whole.scene_share)
    return config.replaced(data=data), found
