"""What became of every reading, and where data are missing."""

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
from valveflow_ros.report.figure import (
    Figure,
    Spec,
    envelope,
    packed,
    rounded,
    segment_path,
    token,
)
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.page import paragraph, table
from valveflow_ros.report.words import (
    count,
    counted,
    duration,
    input_axis,
    input_unit,
    moment,
    percent,
    plain,
)

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


# Where the data are: over u, and over time.

_BINS = 60
_STRETCHES = 240
_WHOLE = 0.999  # a stretch of time with fewer of its values is drawn as incomplete
_MS = 13


def coverage_figure(data: Identified) -> Figure | None:
    """Return how long the unit ran at each u, and how much of it could be used."""
    known = data.u[np.isfinite(data.u) & np.isfinite(data.power)]
    if not len(known):
        return None
    edges = np.histogram_bin_edges(known, bins=_BINS)
    hours = data.period_ns / 3600e9
    every, _ = np.histogram(known, bins=edges)
    special, _ = np.histogram(data.u[data.special], bins=edges)
    middle = 0.5 * (edges[1:] + edges[:-1])
    traces = [
        _bars(middle, (every - special) * hours, 'other', 'data-soft'),
        _bars(middle, special * hours, 'special segments', 'density-3'),
    ]
    exponent = data.characteristic.pressure_exponent
    inner = data.characteristic.breakpoints[1:-1]
    layout: Spec = {
        'xaxis': {'title': input_axis(exponent)},
        'yaxis': {'title': {'text': 'time there (h)'}, 'rangemode': 'tozero'},
        'barmode': 'stack', 'bargap': 0, 'showlegend': True,
        'shapes': [
            {
                'type': 'line', 'yref': 'paper', 'y0': 0, 'y1': 1, 'x0': float(u),
                'x1': float(u), 'line': {'color': token('curve'), 'width': 1.5, 'dash': 'dot'},
            }
            for u in inner
        ],
    }  # fmt: skip
    share = len(data.special) / len(known)
    caption = (
        '<b>Every piece needs blue.</b> How long the unit ran at each u; blue, the part inside '
        f'special segments, {percent(share, 2)} of all. Dotted, the breakpoints. Where there is '
        'little blue the curve has little to stand on: more data at that load would help.'
    )
    words = (
        f'Hours by u from {plain(float(edges[0]))} to {plain(float(edges[-1]))}; '
        f'{percent(share, 2)} of the time lies in special segments.'
    )
    return Figure('coverage', caption, words, traces, layout, height=320)


def _bars(x: FloatArray, y: FloatArray, name: str, colour: str) -> Spec:
    return {
        'type': 'bar', 'name': name, 'x': rounded(x, 6), 'y': rounded(y, 4),
        'marker': {'color': token(colour)},
        'hovertemplate': f'u %{{x:.0f}}<br>%{{y:.2f}} h<extra>{name}</extra>',
    }  # fmt: skip


def presence(data: Identified, stretches: int = _STRETCHES) -> tuple[FloatArray, FloatArray]:
    """Return the share of expected rows that have a value, by signal and stretch of time.

    Returns
    -------
    edges_ns : float64 (k + 1,)
    share : float64 (signals, k)
        0 to 1; a missing row counts as one without a value.
    """
    time_ns = data.table.time_ns
    span = int(time_ns[-1] - time_ns[0]) + data.period_ns
    k = max(1, min(stretches, span // (20 * data.period_ns)))
    edges = np.linspace(0.0, float(span), k + 1)
    place = np.minimum(((time_ns - time_ns[0]) / (span / k)).astype(np.int64), k - 1)
    expected = np.maximum(np.diff(np.ceil(edges / data.period_ns)), 1.0)
    known = np.isfinite(data.table.values)
    sent = [i for i in SIGNALS if _sent(data, i)]
    counts = np.zeros((len(sent), k))
    for row, info in zip(counts, sent, strict=True):
        row[:] = np.bincount(place[known[:, info.signal]], minlength=k)
    return float(time_ns[0]) + edges, np.minimum(counts / expected, 1.0)


def _sent(data: Identified, info: SignalInfo) -> bool:
    return bool(np.isfinite(data.table.column(info.signal)).any())


def presence_figure(data: Identified) -> Figure | None:
    """Return when values are missing; None where none is."""
    if len(data.table) < 2:
        return None
    edges, share = presence(data)
    if not share.size or share.min() >= _WHOLE:
        return None
    names = [i.topic.replace('_', ' ') for i in SIGNALS if _sent(data, i)]
    traces: list[Spec] = [
        {
            'type': 'heatmap', 'x': rounded(edges / 1e6, _MS), 'y': names, 'ygap': 3,
            'z': [rounded(100.0 * row, 3) for row in share], 'zmin': 0, 'zmax': 100,
            'colorscale': [[0.0, token('steady')], [0.5, token('notice-rule')],
                           [0.999, token('notice')], [1.0, token('density-1')]],
            'showscale': False,
            'hovertemplate': '%{x|%d %b %H:%M}<br>%{y}: %{z:.0f} % there<extra></extra>',
        }
    ]  # fmt: skip
    layout: Spec = {
        'xaxis': {'type': 'date', 'title': {'text': 'time (UTC)'}},
        'yaxis': {'type': 'category', 'autorange': 'reversed'},
    }
    gone = float((1.0 - share).max())
    caption = (
        '<b>Blue: complete. Yellow to red: values are missing then.</b> Missing are times '
        'without any row and values that were refused; the table above counts them by reason.'
    )
    words = f'Share of values there by signal and time; at worst {percent(gone, 2)} are missing.'
    return Figure('presence', caption, words, traces, layout, height=110 + 34 * len(names))


# The signals over time, with the special segments found in them.

_DRAWN_STRETCHES = 5000
_SEGMENT_POINTS = 4000
_KINDS = (
    (SegmentKind.STEADY, 'steady state', 'steady'),
    (SegmentKind.SLOPE, 'slope response', 'slope'),
)


def _panel(data: Identified, values: FloatArray, axis: str, unit: str, places: int) -> list[Spec]:
    """Return the measured signal in grey and its special segments in colour."""
    first = axis == 'y'
    all_of_it = envelope(data.table.time_ns, values, _DRAWN_STRETCHES, data.period_ns)
    traces: list[Spec] = [
        {
            'type': 'scatter', 'mode': 'lines', 'name': 'measured', 'yaxis': axis,
            'x0': all_of_it.start_ns / 1e6, 'dx': all_of_it.step_ns / 1e6,
            'y': rounded(all_of_it.values), 'line': {'color': token('data-soft'), 'width': 1},
            'hoverinfo': 'skip', 'showlegend': first, 'legendgroup': 'measured',
        }
    ]  # fmt: skip
    for kind, name, colour in _KINDS:
        rows = data.rows_of(kind)
        times, means = segment_path(data.table.time_ns, values, rows, _SEGMENT_POINTS)
        traces.append(
            {
                'type': 'scatter', 'mode': 'lines', 'name': name, 'yaxis': axis,
                'x': packed(times), 'y': rounded(means),
                'line': {'color': token(colour), 'width': 2.2},
                'hovertemplate': f'%{{x|%d %b %H:%M}}<br>%{{y:.{places}f}} {unit}'
                f'<extra>{name}</extra>',
                'showlegend': first, 'legendgroup': name,
            }
        )  # fmt: skip
    return traces


def _buttons(days: float) -> Spec | None:
    """Return the buttons that show the last hours or days, where the log is longer."""
    steps: list[Spec] = []
    if days > 0.5:
        steps.append({'step': 'hour', 'count': 6, 'label': 'last 6 h', 'stepmode': 'backward'})
    if days > 2.0:
        steps.append({'step': 'day', 'count': 1, 'label': 'last day', 'stepmode': 'backward'})
    if not steps:
        return None
    steps.append({'step': 'all', 'label': 'all'})
    return {
        'buttons': steps, 'x': 1, 'xanchor': 'right', 'y': -0.16, 'yanchor': 'top',
        'bgcolor': token('panel'), 'activecolor': token('rule'), 'bordercolor': token('rule'),
        'borderwidth': 1, 'font': {'color': token('ink')},
    }  # fmt: skip


def signals_figure(data: Identified) -> Figure:
    """Return u and power over time (the paper's Fig. 5)."""
    unit = input_unit(data.characteristic.pressure_exponent)
    traces = [
        *_panel(data, data.u, 'y', unit, 0),
        *_panel(data, data.power, 'y2', 'MW', 1),
    ]
    table = data.table
    days = (int(table.time_ns[-1]) - int(table.time_ns[0])) / 86400e9 if len(table) else 0.0
    axis: Spec = {'type': 'date', 'anchor': 'y2', 'title': {'text': 'time (UTC)'}}
    if buttons := _buttons(days):
        axis['rangeselector'] = buttons
    layout = {
        'xaxis': axis,
        'margin': {'l': 60, 'r': 12, 't': 34, 'b': 96 if buttons else 46},
        'yaxis': {'domain': [0.54, 1.0], 'title': {'text': f'u ({unit})'}},
        'yaxis2': {'domain': [0.0, 0.48], 'title': {'text': 'power (MW)'}},
    }
    return Figure('signals', _caption(data), _description(data), traces, layout, height=560)


def _share(data: Identified) -> tuple[int, int, float]:
    steady, slope = (len(data.rows_of(kind)) for kind, _, _ in _KINDS)
    rows = data.rows
    return steady, slope, float((rows[:, 1] - rows[:, 0]).sum()) if len(rows) else 0.0


def _caption(data: Identified) -> str:
    steady, slope, samples = _share(data)
    time = duration(samples * data.settings.real('sample_period'))
    return (
        f'<b>Coloured stretches should look straight.</b> '
        f'<span class="key steady">Steady state</span> ({steady}): input and power hold. '
        f'<span class="key slope">Slope response</span> ({slope}): both move along a ramp, '
        'counted only after the turbine has caught up. Together they last '
        f'{time}; everything else (grey) is left out of the search for the pieces. '
        '<span class="mouse">Drag to zoom, double-click to return.</span>'
    )


def _description(data: Identified) -> str:
    steady, slope, _ = _share(data)
    return (
        f'Integrated input and generated power over time with '
        f'{counted(steady, "steady-state segment")} and '
        f'{counted(slope, "slope-response segment")} marked.'
    )
