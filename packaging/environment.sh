#!/usr/bin/env bash
# Makes .venv: a Python of at least 3.10, the pinned versions, the package (editable) with its
# development tools. Does nothing when that is already done and nothing it depends on has changed;
# a broken environment is made anew. PYTHON names the interpreter to use.
set -euo pipefail
cd "$(dirname "$0")/.."

venv=.venv
stamp=$venv/gvtools.stamp
export PIP_DISABLE_PIP_VERSION_CHECK=1

recent() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1
}

find_python() {
    local candidate
    if [ -n "${PYTHON:-}" ]; then
        recent "$PYTHON" && echo "$PYTHON" && return
        echo "PYTHON=$PYTHON is $("$PYTHON" --version 2>&1 || true); expected Python >= 3.10" >&2
        return 1
    fi
    for candidate in python3 python3.14 python3.13 python3.12 python3.11 python3.10 python; do
        recent "$candidate" && echo "$candidate" && return
    done
    echo "python3 is $(python3 --version 2>&1 || true), and no newer one is on the path;" \
        "expected Python >= 3.10; install one, or name it: make PYTHON=/path/to/python3" >&2
    return 1
}

# The stamp also records where the tree lies, since an environment does not survive a move.
wanted() {
    { pwd -P; cksum constraints.txt setup.cfg pyproject.toml packaging/environment.sh; }
}

works() {
    "$venv/bin/python" -c 'import pip, sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1
}

if [ -f "$stamp" ] && works && [ "$(cat "$stamp")" = "$(wanted)" ] \
    && "$venv/bin/python" -c 'import importlib.metadata as m; m.version("gvtools")' 2>/dev/null
then
    exit 0
fi

if ! works; then
    python=$(find_python) || exit 2
    [ -e "$venv" ] && echo "$venv does not work; it is made anew"
    rm -rf "$venv"
    echo "making $venv with $("$python" --version)"
    "$python" -m venv "$venv" || {
        rm -rf "$venv"
        echo "$python cannot make virtual environments;" \
            "on Debian and Ubuntu: apt-get install -y python3-venv" >&2
        exit 2
    }
fi
rm -f "$stamp"
echo "installing the pinned packages (a few minutes the first time)"
"$venv/bin/python" -m pip install --quiet -c constraints.txt -e ".[dev]"
wanted > "$stamp.partial"
mv "$stamp.partial" "$stamp"
