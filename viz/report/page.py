"""The report of a run: one HTML file that holds its pictures, and asks the network for nothing."""

from __future__ import annotations

from viz.plots.canvas import check_rounds
from viz.report import sections
from viz.report.content import RunReport
from viz.report.html_parts import bulleted, document, paragraph, section, text


def report_html(report: RunReport) -> str:
    """The page."""
    check_rounds(report.rounds)
    parts = {
        "growth": ("Growth", sections.growth(report)),
        "figures": ("Observed and generated", sections.figures(report)),
        "pictures": ("Pictures", sections.pictures(report)),
        "trajectories": ("Trajectories", sections.trajectories(report)),
        "time": ("Time", sections.time(report)),
        "settings": ("Settings", sections.settings(report)),
    }
    shown = {name: part for name, part in parts.items() if part[1]}
    links = "".join(f'<a href="#{name}">{text(head)}</a>' for name, (head, _) in shown.items())
    body = "\n".join(section(name, head, content) for name, (head, content) in shown.items())
    return document(
        report.title,
        f"{_facts(report)}\n<nav>{links}</nav>\n{_warnings(report)}\n{_key_figures(report)}\n{body}",
    )


def _facts(report: RunReport) -> str:
    content = "; ".join(f"{name} {value}" for name, value in report.facts)
    return paragraph(content, "quiet")


def _warnings(report: RunReport) -> str:
    if not report.warnings:
        return ""
    return f'<div class="warnings"><strong>Warnings</strong>{bulleted(report.warnings)}</div>'


def _key_figures(report: RunReport) -> str:
    last = report.rounds[-1]
    seconds = sum(entry["seconds"].get("total") or 0 for entry in report.rounds)
    covered = [view["coverage"] for entry in report.rounds for view in entry["views"]]
    found = report.measures.figures
    cards = [
        ("observations", last["points"]),
        *(
            (f"of them {source}", f"{last[source] / max(1, last['points']):.1%}")
            for source in ("scanned", "generated")
            if source == "generated" or last.get(source)
        ),
        (
            "coverage before a round",
            f"{sum(covered) / len(covered):.1%}" if covered else None,
        ),
        *(
            (f"PSNR, {where}", f"{found[f'psnr{region}']:.2f} dB")
            for region, where in sections.REGIONS.items()
            if found.get(f"psnr{region}") is not None
        ),
        ("seconds of all rounds", f"{seconds:.1f}"),
    ]
    return (
        '<div class="key">'
        + "".join(
            f"<div><b>{text(value)}</b><span>{text(name)}</span></div>" for name, value in cards
        )
        + "</div>"
    )
