"""pycolmap, whose import takes over the process's signals: Python's handlers are put back."""

from __future__ import annotations

import signal
import threading

_handler = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

# Only the main thread may; where another imports first, a SIGTERM prints a stack of C++.
if _handler is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _handler)

__all__ = ["pycolmap"]
