"""Sentences and small text tables that several verbs print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from valveflow_ros.report.data import REASON_WORDS, rejected
from valveflow_ros.report.words import count


def rejected_words(counts: Mapping[str, Mapping[str, int]]) -> str:
    """Return one line about the readings that were not used, per signal."""
    lines = []
    for topic, by_reason in counts.items():
        refused = rejected({topic: by_reason})
        if refused:
            told = ', '.join(f'{count(n)} {REASON_WORDS[r]}' for r, n in refused.items())
            lines.append(f'  {topic}: {told}')
    if not lines:
        return 'Every reading was used.'
    return '\n'.join(['Readings not used:', *lines])


def columns(rows: Sequence[Sequence[str]], head: Sequence[str] = (), indent: str = '  ') -> str:
    """Return rows with their columns lined up; the first column left, the others right."""
    everything = [list(head), *map(list, rows)] if head else [list(r) for r in rows]
    if not everything:
        return ''
    widths = [max(len(row[k]) for row in everything) for k in range(len(everything[0]))]
    lines = []
    for row in everything:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append((indent + '  '.join(cells)).rstrip())
    return '\n'.join(lines)
