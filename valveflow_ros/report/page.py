"""The page: sections of text, tables and pictures in one self-contained file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

from valveflow_ros.report.figure import Figure
from valveflow_ros.report.library import packed_plotly, read_text

# Nothing may be loaded from anywhere: the browser itself sees to it.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    'img-src data: blob:; font-src data:'
)


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page.

    Attributes
    ----------
    title : str
        Plain text.
    parts : list
        HTML (str) and pictures in the order in which they stand.
    """

    title: str
    parts: list[str | Figure] = field(default_factory=list)


def text(value: object) -> str:
    """Escape what came from outside: names of files, tags, sentences."""
    return escape(str(value), quote=True)


def paragraph(html: str, kind: str = '') -> str:
    """Return a paragraph of ready HTML."""
    return f'<p class="{kind}">{html}</p>' if kind else f'<p>{html}</p>'


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], *, caption: str = '', first: str = 'name'
) -> str:
    """Return a table of ready HTML cells.

    Parameters
    ----------
    first : str
        'name' if the first column names the row, 'number' if it is a value like the others.
    """

    def cell(k: int, html: str) -> str:
        if k == 0 and first == 'name':
            return f'<th scope="row">{html}</th>'
        return f'<td>{html}</td>'

    top = ''.join(f'<th scope="col">{h}</th>' for h in head)
    body = ''.join(
        '<tr>' + ''.join(cell(k, c) for k, c in enumerate(row)) + '</tr>' for row in rows
    )
    title = f'<caption>{caption}</caption>' if caption else ''
    return (
        f'<div class="scroll"><table>{title}<thead><tr>{top}</tr></thead>'
        f'<tbody>{body}</tbody></table></div>'
    )


def notice(html: str) -> str:
    """Return a paragraph that must not be overlooked."""
    return f'<p class="notice" role="note">{html}</p>'


def page(title: str, lead: str, sections: Sequence[Section], foot: str) -> str:
    """Return the whole file.

    Parameters
    ----------
    title : str
        Plain text, also the window's title.
    lead, foot : str
        HTML under the title and at the end.
    """
    body = ''.join(_section(k, s) for k, s in enumerate(sections))
    figures = [p for s in sections for p in s.parts if isinstance(p, Figure)]
    drawn = ','.join(f'"{f.name}":{f.to_json()}' for f in figures)
    library = f'<script id="library" type="text/plain">{packed_plotly()}</script>'
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f'<title>{text(title)}</title><link rel="icon" href="data:,">'
        f'<style>{read_text("style.css")}</style></head>\n<body><main>'
        f'<header><h1>{text(title)}</h1>{lead}</header>{body}<footer>{foot}</footer></main>\n'
        f'<script id="figures" type="application/json">{{{drawn}}}</script>\n'
        f'{library}\n<script>{read_text("page.js")}</script></body></html>\n'
    )


def _section(number: int, section: Section) -> str:
    parts = ''.join(_figure(p) if isinstance(p, Figure) else p for p in section.parts)
    return f'<section id="part-{number + 1}"><h2>{text(section.title)}</h2>{parts}</section>'


def _figure(figure: Figure) -> str:
    return (
        f'<figure><div class="plot" id="{figure.name}" role="img" '
        f'aria-label="{text(figure.description)}" style="height:{figure.height}px">'
        '<span class="waiting">The picture appears here when scripts may run.</span></div>'
        f'<figcaption>{figure.caption}</figcaption></figure>'
    )
