# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How the readings were used, and where data are missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from valveflow_ros.records import (
    SIGNALS,
    FloatArray,
    IntArray,
    SampleTable,
    SegmentKind,
    SignalInfo,
)
from valveflow_ros.report import figure as plot
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.figure import DAY_HOUR, Figure, Spec

if TYPE_CHECKING:
    from valveflow_ros.report.identified import Identified


# The reasons of the aligner in words that follow a number of readings, in the order of the table.
REASON_WORDS = {
    'not_finite': 'not a number',
    'bad_quality': 'marked bad by the sender',
    'impossible': 'outside the accepted range',
    'duplicate': 'with the same time as the one before',
    'out_of_order': 'older than the one before',
    'time_outlier': 'with a time far from all others',
    'late': 'too late for its row (used later)',
}
_NEEDED = ('valve_opening', 'main_steam_pressure', 'generated_power')
_BINS = 60
_STRETCHES = 240
_WHOLE = 0.999  # a time interval with a smaller fraction of its values is drawn as incomplete
_DRAWN_STRETCHES = 5000
_SEGMENT_POINTS = 4000


@dataclass(frozen=True, slots=True)
class Gap:
    """A time interval without any row."""

    start_ns: int
    end_ns: int

    @property
    def seconds(self) -> float:
        """Return the length."""
        return (self.end_ns - self.start_ns) / 1e9


def gaps(time_ns: IntArray, period_ns: int, at_least: float = 1.5) -> list[Gap]:
    """Return the intervals in which rows are missing, the longest first."""
    places = np.flatnonzero(np.diff(time_ns) > at_least * period_ns)
    found = [Gap(int(time_ns[k]), int(time_ns[k + 1])) for k in places]
    return sorted(found, key=lambda g: g.start_ns - g.end_ns)


def rejected(counts: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
    """Return the number of rejected readings by reason, over all signals; zeros are left out."""
    total = {
        reason: sum(by_reason.get(reason, 0) for by_reason in counts.values())
        for reason in REASON_WORDS
        if reason != 'late'  # late readings were used
    }
    return {reason: n for reason, n in total.items() if n}


def reason_words(counts: Mapping[str, int], accepted: str = '') -> str:
    """Return the readings of each reason in words; empty if there are none.

    ``accepted`` is the accepted range in words, to be added.
    """
    found = dict(REASON_WORDS)
    if accepted:
        found['impossible'] += f' ({accepted})'
    told = ((counts.get(reason, 0), words) for reason, words in found.items())
    return ', '.join(f'{say.count(n)} {words}' for n, words in told if n)


def usable_share(table: SampleTable) -> float:
    """Return the fraction of rows in which opening, pressure and power are all known."""
    if not len(table):
        return float('nan')
    needed = [i.signal for i in SIGNALS if i.topic in _NEEDED]
    return float(np.isfinite(table.values[:, needed]).all(axis=1).mean())


def quality_words(data: Identified) -> str:
    """Return a paragraph on the data quality for an engineer."""
    words = (
        f'{say.counted(len(data.table), "row")} of {say.duration(data.period_ns / 1e9)}; opening, '
        f'pressure and power are all known in {say.percent(usable_share(data.table))} of them. '
    )
    found = gaps(data.table.time_ns, data.period_ns)
    words += (
        f'Rows are missing in {say.counted(len(found), "place")}; the longest gap lasts '
        f'{say.duration(found[0].seconds)} from {say.moment(found[0].start_ns)}. '
        if found else 'No row is missing. '
    )  # fmt: skip
    refused = reason_words(rejected(data.counts))
    return html.paragraph(
        words + (f'Readings not used: {refused}.' if refused else 'Every reading was used.')
    )


def quality_table(data: Identified) -> str:
    """Return readings, rejections and ranges, one row per signal in the data."""
    sent = [i for i in SIGNALS if i.required or any(data.counts.get(i.topic, {}).values())]
    head = ['signal', 'readings', 'of these', 'rows with a value', 'lowest', 'median', 'highest']
    return html.table(head, [_row(info, data) for info in sent])


def _row(info: SignalInfo, data: Identified) -> list[str]:
    counts = data.counts.get(info.topic, {})
    values = data.table.column(info.signal)
    known = values[np.isfinite(values)]
    low, middle, high = np.quantile(known, (0.0, 0.5, 1.0)) if len(known) else (np.nan,) * 3
    return [
        info.topic.replace('_', ' '),
        say.count(sum(n for reason, n in counts.items() if reason != 'late')),
        reason_words(counts) or 'all used',
        say.percent(len(known) / len(values) if len(values) else float('nan')),
        say.plain(float(low)), say.plain(float(middle)),
        f'{say.plain(float(high))} {info.unit.replace("degC", "°C")}',
    ]  # fmt: skip


def coverage_figure(data: Identified) -> Figure | None:
    """Return the operating time at each u, and how much of it was usable."""
    known = data.u[np.isfinite(data.u) & np.isfinite(data.power)]
    if not len(known):
        return None
    edges = np.histogram_bin_edges(known, bins=_BINS)
    every, _ = np.histogram(known, bins=edges)
    special, _ = np.histogram(data.u[data.special], bins=edges)
    x = plot.rounded(0.5 * (edges[1:] + edges[:-1]), 6)
    hours = data.period_ns / 3600e9
    c, u = data.shown, say.input_name(data.shown.pressure_exponent)
    traces: list[Spec] = [
        {
            'type': 'bar', 'name': name, 'x': x, 'y': plot.rounded(rows * hours, 4),
            'marker': {'color': plot.token(colour)},
            'hovertemplate': f'{u} %{{x:.0f}}<br>%{{y:.2f}} h<extra>{name}</extra>',
        }
        for rows, name, colour in (
            (every - special, 'other', 'data-soft'), (special, 'special segments', 'density-3'),
        )
    ]  # fmt: skip
    layout: Spec = {
        'xaxis': plot.axis(say.input_axis(c.pressure_exponent)),
        'yaxis': plot.axis('time there (h)', rangemode='tozero'),
        'barmode': 'stack', 'bargap': 0, 'showlegend': True,
        'shapes': [plot.upright(float(b), 'curve', 1.5, dash='dot') for b in c.breakpoints[1:-1]],
    }  # fmt: skip
    share = say.percent(len(data.special) / len(known), 2)
    dotted = 'Dotted, the breakpoints. ' if len(data.characteristic.pieces) > 1 else ''
    caption = (
        f'<b>Every piece needs special segments.</b> How long the unit ran at each {u}; blue, the '
        f'part in special segments, {share} of all. {dotted}Where there is little blue, more '
        'data at that load would make the curve more certain.'
    )
    words = (
        f'Hours by {u} from {say.plain(float(edges[0]))} to {say.plain(float(edges[-1]))}; '
        f'{share} of the time lies in special segments.'
    )
    return Figure('coverage', caption, words, traces, layout, height=320)


def presence_figure(data: Identified) -> Figure | None:
    """Return when values are missing; None if none are missing."""
    sent = [i for i in SIGNALS if np.isfinite(data.table.column(i.signal)).any()]
    if len(data.table) < 2 or not sent:
        return None
    time_ns = data.table.time_ns
    span = int(time_ns[-1] - time_ns[0]) + data.period_ns
    k = max(1, min(_STRETCHES, span // (20 * data.period_ns)))
    edges = np.linspace(0.0, float(span), k + 1)
    place = np.minimum(((time_ns - time_ns[0]) / (span / k)).astype(np.int64), k - 1)
    # A missing row counts as one without a value.
    expected = np.maximum(np.diff(np.ceil(edges / data.period_ns)), 1.0)
    known = np.isfinite(data.table.values)
    counts = np.array([np.bincount(place[known[:, i.signal]], minlength=k) for i in sent])
    share, edges = np.minimum(counts / expected, 1.0), edges + float(time_ns[0])
    if share.min() >= _WHOLE:
        return None
    names = [i.topic.replace('_', ' ') for i in sent]
    scale = ((0.0, 'steady'), (0.5, 'notice-rule'), (0.999, 'notice'), (1.0, 'density-1'))
    traces: list[Spec] = [
        {
            'type': 'heatmap', 'x': plot.moments(edges / 1e6), 'y': names, 'ygap': 3,
            'z': [plot.rounded(100.0 * row, 3) for row in share], 'zmin': 0, 'zmax': 100,
            'colorscale': [[place, plot.token(colour)] for place, colour in scale],
            'showscale': False,
            'hovertemplate': f'{DAY_HOUR}%{{y}}: %{{z:.0f}} % there<extra></extra>',
        }
    ]  # fmt: skip
    layout: Spec = {
        'xaxis': plot.time_axis(tickangle=0, nticks=5),
        'yaxis': {'type': 'category', 'autorange': 'reversed'},
    }  # fmt: skip
    caption = (
        '<b>Blue: complete. Yellow to red: values are missing then.</b> Missing are times '
        'without any row and values that were refused; the table above counts them by reason.'
    )
    gone = say.percent(float((1.0 - share).max()), 2)
    words = f'Share of values there by signal and time; at worst {gone} are missing.'
    return Figure('presence', caption, words, traces, layout, height=110 + 34 * len(names))


# The signals over time, with their special segments.

_KINDS = (
    (SegmentKind.STEADY, 'steady state', 'steady'),
    (SegmentKind.SLOPE, 'slope response', 'slope'),
)


def signals_figure(data: Identified) -> Figure:
    """Return u, or the opening, and power over time (Fig. 5 of the paper)."""
    unit = say.input_unit(data.shown.pressure_exponent)
    u = say.input_name(data.shown.pressure_exponent)
    time_ns = data.table.time_ns
    days = (int(time_ns[-1]) - int(time_ns[0])) / 86400e9 if len(time_ns) else 0.0
    # Buttons for the last hours or days, if the log is longer.
    steps: list[Spec] = []
    if days > 0.5:
        steps.append({'step': 'hour', 'count': 6, 'label': 'last 6 h', 'stepmode': 'backward'})
    if days > 2.0:
        steps.append({'step': 'day', 'count': 1, 'label': 'last day', 'stepmode': 'backward'})
    across = plot.time_axis(anchor='y2')
    if steps:
        across['rangeselector'] = {
            'buttons': [*steps, {'step': 'all', 'label': 'all'}], 'x': 1, 'xanchor': 'right',
            'y': -0.16, 'yanchor': 'top', 'bgcolor': plot.token('panel'),
            'activecolor': plot.token('rule'), 'bordercolor': plot.token('rule'),
            'borderwidth': 1, 'font': {'color': plot.token('ink')},
        }  # fmt: skip
    layout = {
        'xaxis': across,
        'margin': {'l': 60, 'r': 12, 't': 34, 'b': 96 if steps else 46},
        'yaxis': plot.axis(f'{u} ({unit})', domain=[0.54, 1.0]),
        'yaxis2': plot.axis('power (MW)', domain=[0.0, 0.48]),
    }
    steady, slope = (len(data.rows_of(kind)) for kind, _, _ in _KINDS)
    samples = float((data.rows[:, 1] - data.rows[:, 0]).sum()) if len(data.rows) else 0.0
    caption = (
        f'<b>Coloured stretches should look straight.</b> '
        f'<span class="key steady">Steady state</span> ({steady}): input and power hold. '
        f'<span class="key slope">Slope response</span> ({slope}): both move along a ramp, '
        'counted only after the turbine has caught up. Together they last '
        f'{say.duration(samples * data.settings.real("sample_period"))}; everything else (grey) '
        'is left out of the search for the pieces. '
        '<span class="mouse">Drag to zoom, double-click to return.</span>'
    )
    words = (
        f'{u.capitalize()} and generated power over time with '
        f'{say.counted(steady, "steady-state segment")} and '
        f'{say.counted(slope, "slope-response segment")} marked.'
    )
    traces = [*_panel(data, data.u, 'y', unit), *_panel(data, data.power, 'y2', 'MW')]
    return Figure('signals', caption, words, traces, layout, height=560)


def _panel(data: Identified, values: FloatArray, up: str, unit: str) -> list[Spec]:
    time_ns = data.table.time_ns
    shown: Spec = {'yaxis': up, 'showlegend': up == 'y'}
    start_ns, step_ns, ends = plot.envelope(time_ns, values, _DRAWN_STRETCHES, data.period_ns)
    measured = plot.line(
        None, plot.rounded(ends), 'measured', 'data-soft', width=1, x0=start_ns / 1e6,
        dx=step_ns / 1e6, legendgroup='measured', **shown,
    )  # fmt: skip
    del measured['x']
    traces = [measured]
    for kind, name, colour in _KINDS:
        times, means = segment_path(time_ns, values, data.rows_of(kind), _SEGMENT_POINTS)
        hover = f'{DAY_HOUR}%{{y:.4~g}} {unit}<extra>{name}</extra>'
        traces.append(plot.line(
            plot.packed(times), plot.rounded(means), name, colour, hover, width=2.2,
            legendgroup=name, **shown,
        ))  # fmt: skip
    return traces


def segment_path(
    time_ns: IntArray, values: FloatArray, rows: IntArray, points: int
) -> tuple[FloatArray, FloatArray]:
    """Return times in ms and block means along segments, NaN between two segments.

    Parameters
    ----------
    rows : int64 (k, 2)
        First and end row (exclusive) of each segment.
    points : int
        Approximate maximum number of points of all segments together.
    """
    total = int((rows[:, 1] - rows[:, 0]).sum()) if len(rows) else 0
    block = max(1, -(-total // max(1, points)))
    times, means = [np.empty(0)], [np.empty(0)]
    for first, end in rows.tolist():
        edges = np.arange(first, end, block)
        if not len(edges):
            continue
        sizes = np.diff(np.append(edges, end))
        means += [np.add.reduceat(values[first:end], edges - first) / sizes, np.array([np.nan])]
        middle = np.minimum(edges + sizes // 2, end - 1)
        times += [time_ns[middle] / 1e6, np.array([np.nan])]
    return np.concatenate(times), np.concatenate(means)
