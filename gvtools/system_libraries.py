"""Libraries of the system that Open3D's and pycolmap's wheels link, and slim systems lack.

Uses nothing but Python's own library, as it has to work where nothing else does.
"""

from __future__ import annotations

import ctypes
import sys

# By the name that the loader looks for: the package of Debian and Ubuntu that has it.
LIBRARIES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}


def missing_libraries() -> tuple[str, ...]:
    """Names of the libraries that cannot be loaded; none on other systems than Linux."""
    if not sys.platform.startswith("linux"):
        return ()
    return tuple(name for name in LIBRARIES if not _loads(name))


def advice(missing: tuple[str, ...]) -> str:
    """One line that names missing libraries and says how to install them.

    >>> advice(("libGL.so.1",))
    'missing system libraries: libGL.so.1; on Debian and Ubuntu run: apt-get install -y libgl1'
    """
    packages = " ".join(LIBRARIES[name] for name in missing)
    return (
        f"missing system libraries: {' '.join(missing)}; on Debian and Ubuntu run: apt-get "
        f"install -y {packages}"
    )


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    print("\n".join(f"{name} {LIBRARIES[name]}" for name in missing_libraries()))
