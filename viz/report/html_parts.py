"""Pieces of a page; every text is escaped here, so that no file's content becomes markup."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from viz.report.contact_sheet import Tile

STYLE = Path(__file__).with_name("report.css")
# A page that a browser holds to asking nobody for anything.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"

# What a figure that could not be had is shown as.
NONE = "–"


def text(value: object) -> str:
    """Anything as text: None as a dash, floats with four significant digits, lines kept."""
    if value is None or value != value:
        return NONE
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, int) and not isinstance(value, bool):
        # Narrow spaces between thousands.
        return f"{value:,}".replace(",", "\u202f")
    return escape(str(value), quote=True).replace("\n", "<br>")


def document(title: str, body: str) -> str:
    """A whole page under a title, which holds its style and asks the network for nothing."""
    style = STYLE.read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{text(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f"<h1>{text(title)}</h1>\n{body}\n</body>\n</html>\n"
    )


def table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, caption: str = "") -> str:
    """A table that scrolls by itself where the page is narrower.

    Args:
        columns: headings.
        rows: each as long as the headings, a name first.
        caption: above it.
    """
    head = "".join(f'<th scope="col">{text(column)}</th>' for column in columns)
    body = []
    for name, *values in rows:
        cells = "".join(f"<td>{text(value)}</td>" for value in values)
        body.append(f'<tr><th scope="row">{text(name)}</th>{cells}</tr>')
    # A caption of the table itself would scroll with it.
    content = paragraph(caption, "quiet") if caption else ""
    return (
        f'{content}<div class="wide" tabindex="0"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def figure(uri: str, alt: str) -> str:
    """A drawn figure."""
    return f'<figure class="plot"><img src="{text(uri)}" alt="{text(alt)}"></figure>'


def tile(shown: Tile) -> str:
    """A thumbnail with its label."""
    return (
        f'<figure><img src="{text(shown.uri)}" alt="{text(shown.alt)}" width="{shown.width}" '
        f'height="{shown.height}"><figcaption>{text(shown.label)}</figcaption></figure>'
    )


def paragraph(content: str, kind: str = "") -> str:
    """A paragraph, of a CSS class or of none."""
    return f'<p class="{kind}">{text(content)}</p>' if kind else f"<p>{text(content)}</p>"


def folded(summary: str, content: str) -> str:
    """Content that a click opens."""
    return f"<details><summary>{text(summary)}</summary>{content}</details>"


def section(name: str, heading: str, *content: str) -> str:
    """A section with a heading, to which ``#name`` leads."""
    return f'<section id="{name}"><h2>{text(heading)}</h2>{"".join(content)}</section>'


def bulleted(items: Iterable[str]) -> str:
    """A list."""
    return f"<ul>{''.join(f'<li>{text(item)}</li>' for item in items)}</ul>"
