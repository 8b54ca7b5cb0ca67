#!/usr/bin/env bash
# Open3D's wheel links a few libraries of the system, which slim images lack. Checks that they
# load; installs them where that is possible without asking (root and apt-get), and otherwise
# prints the line to run and ends with status 2.
set -euo pipefail

[ "$(uname -s)" = Linux ] || exit 0
python=${1:-python3}

declare -A package=(
    [libusb-1.0.so.0]=libusb-1.0-0
    [libGL.so.1]=libgl1
    [libEGL.so.1]=libegl1
    [libX11.so.6]=libx11-6
    [libgomp.so.1]=libgomp1
    [libudev.so.1]=libudev1
    [libidn2.so.0]=libidn2-0
)

missing() {
    "$python" - "${!package[@]}" <<'PYTHON'
import ctypes
import sys

for name in sorted(sys.argv[1:]):
    try:
        ctypes.CDLL(name)
    except OSError:
        print(name)
PYTHON
}

absent=$(missing)
[ -n "$absent" ] || exit 0

names=()
for library in $absent; do names+=("${package[$library]}"); done
echo "open3d needs system libraries that are not there:" $absent

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "installing ${names[*]}"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${names[@]}"
    absent=$(missing)
    [ -z "$absent" ] && exit 0
    echo "still not there after installing:" $absent >&2
    exit 2
fi

if command -v apt-get >/dev/null; then
    echo "run: sudo apt-get update && sudo apt-get install -y ${names[*]}" >&2
else
    echo "install them with the system's package manager (Debian calls them ${names[*]})" >&2
fi
exit 2
