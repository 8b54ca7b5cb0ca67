"""A web viewer in a process of its own, beside the run that it shows."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from pipelines.console import Console

# The run that a viewer belongs to ends it; a terminal's Ctrl-C is not for it.
CHILD = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); import sys; "
    "from pipelines.cli import main; sys.exit(main())"
)


@contextmanager
def live_viewer(out: Path, console: Console, *options: str) -> Iterator[None]:
    """A web viewer of the run in ``out``, in a process of its own, as long as the block lasts.

    It only reads the folder. On a terminal it stays when the block has ended well, until Ctrl-C.
    ``options`` are more words of ``gvtools view``.
    """
    command = [sys.executable, "-c", CHILD, "view", str(out), "--live", *options]
    command += ["--quiet"] if console.quiet else []
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    # What it says has to go around a progress bar of this process.
    teller = threading.Thread(target=_tell, args=(process.stdout, console), daemon=True)
    teller.start()
    try:
        yield
        if console.interactive and process.poll() is None:
            console.line("the run is done; Ctrl-C ends the viewer")
            with suppress(KeyboardInterrupt):
                process.wait()
    finally:
        # It only reads, and libraries that it has loaded would report a milder signal at length.
        process.kill()
        process.wait()
        teller.join()


def _tell(lines: IO[str] | None, console: Console) -> None:
    for line in lines or ():
        console.line(line.rstrip("\n"))
