"""The completer that completes nothing: what memory does not know stays empty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gvtools.completers.base import Completer, Completion, ContextView, check_views
from gvtools.guidance import Guidance


class NoneCompleter(Completer):
    """Returns the guidance as it is; invalid pixels are 0 in colour, depth and confidence."""

    name = "none"

    def complete(
        self, context: Sequence[ContextView], guidance: Guidance, *, seed: int = 0
    ) -> Completion:
        """Pass the valid pixels through; see ``Completer.complete``."""
        check_views(context, guidance)
        valid = guidance.valid
        return Completion(
            np.where(valid[..., None], guidance.rgb, np.float32(0)),
            np.where(valid, guidance.depth, np.float32(0)),
            np.where(valid, np.minimum(guidance.confidence, 1), 0).astype(np.float32),
        )
