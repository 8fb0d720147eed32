# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page: sections of text, tables and figures in one self-contained file."""

from __future__ import annotations

import base64
import functools
import gzip
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import tzinfo
from html import escape
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from valveflow_ros import __version__
from valveflow_ros.errors import InputError
from valveflow_ros.report import figure as pictures
from valveflow_ros.report.figure import Figure, without_tags
from valveflow_ros.report.words import in_zone
from valveflow_ros.signals.units import in_unit


def read_text(name: str) -> str:
    """Return a file in the folder of this module."""
    return resources.files('valveflow_ros.report').joinpath(name).read_text(encoding='utf-8')


def plotly_script() -> Path:
    """Return the path of plotly.js without importing plotly, which is slow.

    Raises `InputError` if plotly is missing or incomplete.
    """
    spec = find_spec('plotly')
    if spec is None or spec.origin is None:
        raise InputError(
            "The report needs the Python package 'plotly', which is not installed: "
            'pip install plotly.'
        )
    source = Path(spec.origin).parent / 'package_data' / 'plotly.min.js'
    if not source.is_file():
        raise InputError(
            f"The installed package 'plotly' is incomplete: {source} is missing; install it again."
        )
    return source


@functools.cache
def packed_plotly() -> str:
    """Return plotly.js, gzip-compressed, in base64 (about 2 MB instead of 5)."""
    script = plotly_script().read_bytes()
    return base64.b64encode(gzip.compress(script, 9, mtime=0)).decode()


Cells = tuple[list[str], list[list[str]]]  # head and rows of a table

# A cell with more characters may be wrapped on a phone, and with still more everywhere.
_NUMBER, _SENTENCE = 16, 34
_WORDS = ' class="words"'
_MANY = 4  # more columns do not fit on a phone
# The page must not load anything: the browser enforces this.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    'img-src data: blob:; font-src data:'
)


_FIGURE_WORDS = ('caption', 'description', 'traces', 'layout')


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page: a title as plain text, HTML and figures in their order."""

    title: str
    parts: list[str | Figure] = field(default_factory=list)


def section(title: str, *parts: str | Figure | None) -> Section:
    """Return a section; parts that are empty or None are left out."""
    return Section(title, [part for part in parts if part])


@dataclass(frozen=True, slots=True)
class Page:
    """A report before it is written, as one page or as separate figures."""

    title: str  # plain text, also of the window
    lead: str  # HTML below the title
    sections: list[Section]
    foot: str  # HTML at the end
    verb: str  # the command that made the report; stored in the file for programs

    def in_unit(self, unit: str) -> Page:
        """Return the page with texts and figures for an output in another unit than MW."""
        return self if unit == 'MW' else self._said(lambda text: in_unit(text, unit))

    def in_zone(self, zone: tzinfo | None) -> Page:
        """Return the page with the times in its texts and figures in a time zone; None: UTC."""
        if zone is None:
            return self
        page = self._said(lambda text: in_zone(text, zone))
        for s in page.sections:
            s.parts[:] = [
                pictures.in_zone(p, zone) if isinstance(p, Figure) else p for p in s.parts
            ]
        return page

    def _said(self, change: Callable[[str], str]) -> Page:
        """Return the page with a function applied to all of its texts."""

        def told(value: Any) -> Any:
            if isinstance(value, str):
                return change(value)
            if isinstance(value, list | tuple):
                return [told(v) for v in value]
            if isinstance(value, dict):
                return {key: told(v) for key, v in value.items()}
            if isinstance(value, Figure):
                # The name stays: it is the id of the element and part of file names.
                words = (told(getattr(value, name)) for name in _FIGURE_WORDS)
                return replace(value, **dict(zip(_FIGURE_WORDS, words, strict=True)))
            return value

        sections = [Section(told(s.title), told(s.parts)) for s in self.sections]
        return replace(
            self, title=told(self.title), lead=told(self.lead), sections=sections,
            foot=told(self.foot),
        )  # fmt: skip

    @property
    def figures(self) -> list[Figure]:
        """Return the figures in their order."""
        return [p for s in self.sections for p in s.parts if isinstance(p, Figure)]

    def to_html(self) -> str:
        """Return the whole file, which opens without a network."""
        body = ''.join(_section(k, s) for k, s in enumerate(self.sections))
        drawn = ','.join(f'"{f.name}":{f.to_json()}' for f in self.figures)
        library = f'<script id="library" type="text/plain">{packed_plotly()}</script>'
        title = text(self.title)
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
            f'<meta name="generator" content="valveflow {text(self.verb)} {text(__version__)}">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            '<meta name="color-scheme" content="light dark">'
            f'<title>{title}</title><link rel="icon" href="data:,">'
            f'<style>{read_text("style.css")}</style></head>\n<body><main>'
            f'<header><h1>{title}</h1>{self.lead}</header>{body}<footer>{self.foot}</footer>'
            f'</main>\n<script id="figures" type="application/json">{{{drawn}}}</script>\n'
            f'{library}\n<script>{read_text("colours.js")}{read_text("page.js")}</script>'
            '</body></html>\n'
        )


def text(value: object) -> str:
    """Escape external text for HTML: names of files, tags, sentences."""
    return escape(str(value), quote=True)


def paragraph(html: str, kind: str = '') -> str:
    """Return a paragraph of given HTML."""
    return f'<p class="{kind}">{html}</p>' if kind else f'<p>{html}</p>'


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    caption: str = '',
    sentences: bool = False,
) -> str:
    """Return a table of cells given as HTML; empty without rows.

    With sentences it is treated as one of many columns. A power such as ^(9/8) in the head is set
    as a superscript. On a phone a table with many columns shows each row as a list; therefore
    each cell has the name of its column as an attribute.
    """
    if not rows:
        return ''
    # Attributes cannot contain HTML.
    labels = [without_tags(h).replace('"', '&quot;') for h in head]
    head = [re.sub(r'\^(\()?([\w./]+)(?(1)\))', r'<sup>\2</sup>', h) for h in head]
    many = sentences or len(head) > _MANY

    def cell(k: int, html: str) -> str:
        words = _breaks(html)
        if k == 0:
            return f'<th scope="row" data-label="{labels[k]}">{html}</th>'
        # In the list layout, label and content are side by side: the content must be one element.
        whole = f'<span>{html}</span>' if many and '<' in html else html
        return f'<td data-label="{labels[k]}"{words}>{whole}</td>'

    told = {k for row in rows for k, c in enumerate(row) if k and _breaks(c) == _WORDS}
    top = ''.join(
        f'<th scope="col"{_WORDS if k in told else ""}>{h}</th>' for k, h in enumerate(head)
    )
    body = ''.join(
        '<tr>' + ''.join(cell(k, c) for k, c in enumerate(row)) + '</tr>' for row in rows
    )
    title = f'<caption>{caption}</caption>' if caption else ''
    kind = ' class="many"' if many else ''
    return (
        f'<div class="scroll"><table{kind}>{title}<thead><tr>{top}</tr></thead>'
        f'<tbody>{body}</tbody></table></div>'
    )


def _breaks(html: str) -> str:
    """Return the class of a cell that may be wrapped; numbers are not wrapped."""
    signs = len(re.sub(r'<[^>]+>', '', html))
    if signs > _SENTENCE:
        return _WORDS
    return ' class="long"' if signs > _NUMBER else ''


def bullets(items: Iterable[str]) -> str:
    """Return a list of items given as HTML."""
    return '<ul>' + ''.join(f'<li>{item}</li>' for item in items) + '</ul>'


def where(*lines: str) -> str:
    """Return the subtitle of a page: sources and times, given as plain text."""
    return ''.join(paragraph(text(line), 'where') for line in lines)


def foot(rest: str) -> str:
    """Return the end of a page; ``rest`` is HTML."""
    return f'Made by valveflow {text(__version__)}. {rest}'


def folded(title: str, html: str) -> str:
    """Return HTML that can be expanded; it is always expanded in print."""
    return f'<details><summary>{title}</summary>{html}</details>'


def notice(html: str) -> str:
    """Return a highlighted paragraph."""
    return f'<p class="notice" role="note">{html}</p>'


def _section(number: int, told: Section) -> str:
    parts = ''.join(_figure(p) if isinstance(p, Figure) else p for p in told.parts)
    return f'<section id="part-{number + 1}"><h2>{text(told.title)}</h2>{parts}</section>'


def _figure(figure: Figure) -> str:
    return (
        f'<figure><div class="plot" id="{figure.name}" role="img" '
        f'aria-label="{text(figure.description)}" style="height:{figure.height}px">'
        '<span class="waiting">The picture appears here when scripts may run.</span></div>'
        f'<figcaption>{figure.caption}</figcaption></figure>'
    )
