#!/usr/bin/env bash
# Open3D's wheel links a few libraries of the system, which slim images lack; the list is
# gvtools/system_libraries.py. Checks that they load; installs them where that is possible without
# asking (root and apt-get), and otherwise prints the line to run and ends with status 2.
set -euo pipefail

python=${1:-python3}
list=$(dirname "$0")/../gvtools/system_libraries.py

absent=$("$python" "$list")
[ -n "$absent" ] || exit 0

names=$(awk '{print $2}' <<<"$absent" | xargs)
echo "open3d needs system libraries that are not there:" $(awk '{print $1}' <<<"$absent")

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "installing $names"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $names
    absent=$("$python" "$list")
    [ -z "$absent" ] && exit 0
    echo "still not there after installing:" $absent >&2
    exit 2
fi

if command -v apt-get >/dev/null; then
    echo "run: sudo apt-get update && sudo apt-get install -y $names" >&2
else
    echo "install them with the system's package manager (Debian calls them $names)" >&2
fi
exit 2
