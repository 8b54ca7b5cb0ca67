"""A run on a web page, also while it grows."""

from __future__ import annotations

import time
from collections.abc import Callable

from gvtools.errors import GvError, OptionError
from pipelines.console import Console
from pipelines.viewing.source import ViewSource
from viz.run_view.view import RunView

POLL_SECONDS = 1.0


def serve(
    source: ViewSource,
    *,
    host: str,
    port: int,
    max_points: int,
    round: int | None,
    mode: str,
    live: bool,
    console: Console,
) -> None:
    """Serve a run's web page until an interrupt.

    Args:
        source: of the run.
        host: address to serve at.
        port: the first one that is tried.
        max_points: points drawn of the whole at most.
        round: number of the first round shown; None takes the last.
        mode: colour mode to begin with, see viz.run_view.point_colors.
        live: wait for the first round, and show new ones as they come.
        console: told of the address, of new rounds and of problems.
    """
    from viz.web.server import is_loopback
    from viz.web.viewer import WebViewer

    if live:
        _wait_for_round(source, console)
    shown, number = read_round(source, round)
    viewer = WebViewer(shown, host=host, port=port, budget=max_points, round=number, mode=mode)
    try:
        console.line(f"{source.path}: look at {viewer.url} (Ctrl-C ends)")
        if not is_loopback(host):
            console.warn(f"--host {host}: whoever reaches this machine can see the run")
        lacking = source.lacking()
        if lacking:
            console.line(lacking)
            viewer.set_note(lacking)
        following = Following(source, shown, viewer.update, console=console)
        while True:
            time.sleep(POLL_SECONDS)
            if live:
                following.look()
    finally:
        viewer.stop()


def read_round(source: ViewSource, round: int | None) -> tuple[RunView, int]:
    """A run, and the round to begin with.

    Args:
        source: of the run.
        round: its number; None takes the last.
    """
    shown = source.read()
    if not len(shown.memory):
        raise OptionError(f"{source.path}: an empty memory; expected one that views were fused in")
    number = shown.last_round if round is None else round
    if not 0 <= number <= shown.last_round:
        raise OptionError(f"--round {number}: the run has rounds 0 to {shown.last_round}")
    return shown, number


class Following:
    """A viewer that goes along with a run that grows.

    Args:
        source: of the run.
        shown: the run as the viewer shows it by now.
        update: shows it as it has become.
        console: told of new rounds, and once of each problem.
    """

    def __init__(
        self,
        source: ViewSource,
        shown: RunView,
        update: Callable[[RunView], None],
        *,
        console: Console,
    ) -> None:
        self._source, self._update, self._console = source, update, console
        self._rounds = len(shown.reports)
        self._problem = ""

    def look(self) -> None:
        """Show the rounds that have come since; what cannot be read yet is tried again."""
        try:
            if self._source.rounds() == self._rounds:
                return
            shown = self._source.read()
        except GvError as error:
            if str(error) != self._problem:
                self._console.warn(str(error))
            self._problem = str(error)
            return
        self._problem = ""
        self._rounds = len(shown.reports)
        self._update(shown)
        self._console.line(f"round {shown.last_round} is there")


def _wait_for_round(source: ViewSource, console: Console) -> None:
    if not source.rounds():
        console.line(f"{source.path}: waiting for its first round")
    while not source.rounds():
        time.sleep(POLL_SECONDS)
