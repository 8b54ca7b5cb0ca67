"""Lines of Python of each room against .ci/budget.txt; ``--write`` sets it to 1 % above them.

A budget is raised in a commit of its own that says what a user gains.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BUDGET = ROOT / ".ci" / "budget.txt"


def rooms() -> dict[str, int]:
    """Lines of each package of gvtools and pipelines, of their own modules, of viz and tests."""
    lines: dict[str, int] = {}
    for top in ("gvtools", "pipelines", "viz", "tests"):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).parts
            deep = top in ("gvtools", "pipelines") and len(parts) > 2
            room = "/".join(parts[: 1 + deep])
            lines[room] = lines.get(room, 0) + len(path.read_text(encoding="utf-8").splitlines())
    return lines


def main() -> int:
    """Print the rooms that exceed their budget; status 1 if there are any."""
    found = rooms()
    if "--write" in sys.argv:
        text = "".join(
            f"{room} {-(-count * 101 // 1000) * 10}\n" for room, count in sorted(found.items())
        )
        BUDGET.write_text(text, encoding="utf-8")
    rows = (line.split() for line in BUDGET.read_text(encoding="utf-8").splitlines())
    budget = {room: int(count) for room, count in rows}
    over = [
        f"{room}: {count} lines; expected at most {budget.get(room, 0)} (.ci/budget.txt)"
        for room, count in found.items()
        if count > budget.get(room, 0)
    ]
    print("\n".join(over) or f"{sum(found.values()) - found['tests']} lines of product in budget")
    return bool(over)


if __name__ == "__main__":
    sys.exit(main())
