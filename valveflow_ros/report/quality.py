"""What became of every reading, and where data are missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from valveflow_ros.records import SIGNALS, IntArray, SampleTable, SignalInfo
from valveflow_ros.report.numbers import count, counted, duration, moment, percent, plain
from valveflow_ros.report.page import paragraph, table

if TYPE_CHECKING:
    from valveflow_ros.report.identified import Identified

# The aligner's reasons as a person would say them, in the order of the table.
REASON_WORDS = {
    'not_finite': 'not a number',
    'bad_quality': 'marked bad by the sender',
    'impossible': 'impossible value',
    'duplicate': 'time given twice',
    'out_of_order': 'older than the one before',
    'time_outlier': 'time far from all others',
    'late': 'too late for its row (used later)',
}
# These readings were used after all, or are copies of a used one.
_HARMLESS = ('late',)


@dataclass(frozen=True, slots=True)
class Gap:
    """A stretch of time without any row."""

    start_ns: int
    end_ns: int

    @property
    def seconds(self) -> float:
        """Return its length."""
        return (self.end_ns - self.start_ns) / 1e9


def gaps(time_ns: IntArray, period_ns: int, at_least: float = 1.5) -> list[Gap]:
    """Return the stretches in which rows are missing, the longest first."""
    step = np.diff(time_ns)
    places = np.flatnonzero(step > at_least * period_ns)
    found = [Gap(int(time_ns[k]), int(time_ns[k + 1])) for k in places]
    return sorted(found, key=lambda g: g.start_ns - g.end_ns)


def rejected(counts: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
    """Return how many readings were refused, by reason, over all signals; only what occurred."""
    total = {
        reason: sum(by_reason.get(reason, 0) for by_reason in counts.values())
        for reason in REASON_WORDS
        if reason not in _HARMLESS
    }
    return {reason: n for reason, n in total.items() if n}


def usable_share(table: SampleTable) -> float:
    """Return the share of rows in which opening, pressure and power are all known."""
    if not len(table):
        return float('nan')
    needed = [i.signal for i in SIGNALS if i.topic in _NEEDED]
    return float(np.isfinite(table.values[:, needed]).all(axis=1).mean())


_NEEDED = ('valve_opening', 'main_steam_pressure', 'generated_power')


def _row(info: SignalInfo, data: Identified, reasons: list[str]) -> list[str]:
    counts = data.counts.get(info.topic, {})
    values = data.table.column(info.signal)
    known = values[np.isfinite(values)]
    low, middle, high = np.quantile(known, (0.0, 0.5, 1.0)) if len(known) else (np.nan,) * 3
    received = sum(n for reason, n in counts.items() if reason != 'late')
    share = len(known) / len(values) if len(values) else float('nan')
    return [
        info.topic.replace('_', ' '),
        count(received),
        *(count(counts.get(reason, 0)) for reason in reasons),
        percent(share),
        f'{plain(float(low))}',
        f'{plain(float(middle))}',
        f'{plain(float(high))} {info.unit.replace("degC", "°C")}',
    ]


def quality_table(data: Identified) -> str:
    """Return readings, rejections and ranges, one row a signal that was sent."""
    occurred = {r for by_reason in data.counts.values() for r, n in by_reason.items() if n > 0}
    reasons = [r for r in REASON_WORDS if r in occurred]
    sent = [i for i in SIGNALS if i.required or any(data.counts.get(i.topic, {}).values())]
    head = [
        'signal', 'readings', *(REASON_WORDS[r] for r in reasons),
        'rows with a value', 'lowest', 'median', 'highest',
    ]  # fmt: skip
    return table(head, [_row(info, data, reasons) for info in sent])


def quality_words(data: Identified) -> str:
    """Return what an engineer should know about the data, as paragraphs."""
    table_ = data.table
    found = gaps(table_.time_ns, data.period_ns)
    words = (
        f'{counted(len(table_), "row")} of {duration(data.period_ns / 1e9)}; opening, pressure '
        f'and power are all known in {percent(usable_share(table_))} of them.'
    )
    if found:
        longest = found[0]
        words += (
            f' Rows are missing in {counted(len(found), "place")}; the longest gap lasts '
            f'{duration(longest.seconds)} from {moment(longest.start_ns)}.'
        )
    else:
        words += ' No row is missing.'
    refused = rejected(data.counts)
    if refused:
        told = ', '.join(f'{count(n)} {REASON_WORDS[r]}' for r, n in refused.items())
        words += f' Readings not used: {told}.'
    else:
        words += ' Every reading was used.'
    return paragraph(words)
