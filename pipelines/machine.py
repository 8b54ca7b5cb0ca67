"""Peak memory of the process and load of the machine, where the system tells them."""

from __future__ import annotations

import os


def load_average() -> float:
    """Processes that were at work or waited for a core in the last minute; NaN where not told."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")


def process_peak_bytes() -> int | None:
    """Peak memory (RSS) of this process, bytes; None where the system does not tell."""
    try:
        with open("/proc/self/status", encoding="ascii") as status:
            return next(int(line.split()[1]) * 1024 for line in status if line[:6] == "VmHWM:")
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:
        return None
    # Bytes on macOS; Linux, where these are kilobytes, was read above.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
