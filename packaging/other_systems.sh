#!/usr/bin/env bash
# Resolve what gvtools needs for macOS (arm64, 14 or newer) and Windows (x86-64), from wheels alone.
# Nothing is installed; needs uv (pip install uv).
set -euo pipefail
cd "$(dirname "$0")/.."
needed=$(mktemp)
trap 'rm -f "$needed"' EXIT
python3 - > "$needed" <<'PYTHON'
import configparser

setup = configparser.ConfigParser()
setup.read("setup.cfg")
extras = setup["options.extras_require"]
print(setup["options"]["install_requires"])
for name in ("web", "export", "film", "phones", "data", "scan", "lpips"):
    print(extras[name])
PYTHON
for system in aarch64-apple-darwin x86_64-pc-windows-msvc; do
    for version in 3.10 3.12 3.14; do
        count=$(MACOSX_DEPLOYMENT_TARGET=14.0 uv pip compile --quiet --only-binary :all: \
            --python-platform "$system" --python-version "$version" "$needed" | grep -c ==)
        echo "$system, Python $version: $count wheels"
    done
done
