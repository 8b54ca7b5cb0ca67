"""pycolmap, whose import takes over the process's signals: Python's handlers are put back."""

from __future__ import annotations

import signal
import threading

_handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM,)}

import pycolmap  # noqa: E402

# Only the main thread may; where another imports first, a SIGTERM prints a stack of C++.
if threading.current_thread() is threading.main_thread():
    for _number, _handler in _handlers.items():
        if _handler is not None:
            signal.signal(_number, _handler)

__all__ = ["pycolmap"]
