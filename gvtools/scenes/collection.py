"""Collections of scenes by name, each opened when it is needed."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from gvtools.errors import ProjectError
from gvtools.files import digest
from gvtools.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class SceneCollection:
    """Scenes by name; picklable where its reader is."""

    title: str  # what messages and logs call it
    names: tuple[str, ...]  # in order
    # Opens the scene of a name; ProjectError where nothing of it can be read.
    read: Callable[[str], Scene]
    # Views with depth of each scene; None where only opening a scene tells.
    counts: tuple[int, ...] | None = None
    # Changes when what is in it does, as far as that is known without opening scenes.
    digest: str = ""
    data_set: str = ""  # which one it is of, as ``load_spec`` takes it; "" for none
    opened: bool = False  # whether its scenes are open already, so that reading one costs nothing

    def __post_init__(self) -> None:
        if not self.names:
            raise ProjectError(f"{self.title}: no scene; expected at least one")

    def __len__(self) -> int:
        return len(self.names)

    def subset(self, names: Sequence[str]) -> SceneCollection:
        """Some of the scenes, in the order of the collection."""
        for name in names:
            if name not in self.names:
                near = difflib.get_close_matches(name, self.names, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"first: {self.names[0]!r}"
                raise ProjectError(
                    f"{self.title}: no scene {name!r} among {len(self.names)}; {hint}"
                )
        rows = [row for row, name in enumerate(self.names) if name in set(names)]
        counts = None if self.counts is None else tuple(self.counts[row] for row in rows)
        chosen = tuple(self.names[row] for row in rows)
        return replace(
            self, names=chosen, counts=counts, digest=digest([self.digest, list(chosen)])
        )


def of_scenes(scenes: Sequence[Scene], *, title: str = "") -> SceneCollection:
    """Scenes that are open already, as a collection; they are named after their folders."""
    opened = {scene.root.name: scene for scene in scenes}
    if len(opened) != len(scenes):
        opened = {str(scene.root): scene for scene in scenes}
    if len(opened) != len(scenes):
        raise ProjectError("two scenes have the same folder; give each of them once")
    title = title or next(iter(opened), "scenes")
    counts = tuple(sum(view.has_depth for view in scene) for scene in scenes)
    content = digest([[name, list(scene.names)] for name, scene in opened.items()])
    read = opened.__getitem__
    return SceneCollection(title, tuple(opened), read, counts, content, opened=True)
