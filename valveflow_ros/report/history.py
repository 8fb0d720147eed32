"""How the curve moved while a monitor watched."""

from __future__ import annotations

import numpy as np

from valveflow_ros.records import FloatArray
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.history_data import CurveMoment, History
from valveflow_ros.report.numbers import counted, decimals, duration, moment, plain
from valveflow_ros.report.page import Section, notice, paragraph, text
from valveflow_ros.report.timeline import alarms_table, timeline_figure
from valveflow_ros.report.words import input_unit

# Colour and sign of each input that is followed: told apart without colours too.
_LOOKS = (
    ('chosen', 'circle'), ('slope', 'square'), ('notice-rule', 'diamond'),
    ('steady', 'triangle-up'), ('curve', 'x'),
)  # fmt: skip
_MS = 13  # digits of a time in ms since 1970


def history_sections(history: History | None) -> list[Section]:
    """Return the parts of the page about a monitor's recording; none for other logs."""
    if history is None:
        return []
    sections = []
    notes: list[str | Figure] = [notice(text(n)) for n in history.notes]
    if history.curves:
        sections.append(Section('How the curve moved', _curves(history)))
    if history.alarms or history.diagnoses:
        parts: list[str | Figure] = [
            paragraph(_alarm_words(history)), timeline_figure(history), alarms_table(history),
        ]  # fmt: skip
        sections.append(Section('What the monitor said', parts))
    if notes:
        place = sections[-1].parts if sections else []
        place += notes
        sections = sections or [Section('What the monitor said', place)]
    return sections


def _curves(history: History) -> list[str | Figure]:
    found = history.curves
    first, last = found[0], found[-1]
    words = (
        f'{counted(len(found), "curve")}, the first of {moment(first.time_ns)}, the last of '
        f'{moment(last.time_ns)}.'
    )
    if len(found) < 2:
        return [paragraph(words)]
    at, moved = largest_move(history)
    if np.isfinite(moved):
        words += (
            f' From the one before to the last, the power at the same u changed most at '
            f'u = {decimals(at, 0)}, by {decimals(moved, 2)} MW.'
        )
    return [paragraph(words), curve_history_figure(history)]


def followed(history: History) -> FloatArray:
    """Return the inputs whose power is followed: evenly over the range of the last curve."""
    last = history.curves[-1].u
    inner = np.linspace(float(last[0]), float(last[-1]), len(_LOOKS) + 2)
    return np.asarray(inner[1:-1])


def powers(curves: tuple[CurveMoment, ...], u: FloatArray) -> FloatArray:
    """Return each curve's power at each input, MW, NaN outside a curve: (curves, inputs)."""
    return np.array([np.interp(u, c.u, c.power_mw, left=np.nan, right=np.nan) for c in curves])


def largest_move(history: History) -> tuple[float, float]:
    """Return where the last curve differs most from the one before, and by how much in MW."""
    before, last = history.curves[-2:]
    low, high = max(before.u[0], last.u[0]), min(before.u[-1], last.u[-1])
    if high <= low:
        return float('nan'), float('nan')
    # Between two knots of either the difference is straight: its extreme lies at a knot.
    knots = np.unique(np.clip(np.concatenate([before.u, last.u]), low, high))
    moved = np.interp(knots, last.u, last.power_mw) - np.interp(knots, before.u, before.power_mw)
    k = int(np.argmax(np.abs(moved)))
    return float(knots[k]), float(moved[k])


def _times(history: History) -> list[float | None]:
    ends = [c.time_ns for c in history.curves]
    return rounded(np.array([*ends, max(history.end_ns, ends[-1])]) / 1e6, _MS)


def _power_lines(history: History, u: FloatArray) -> list[Spec]:
    values = powers(history.curves, u)
    with np.errstate(all='ignore'):
        usual = np.array([_median(column) for column in values.T])
    times = _times(history)
    traces: list[Spec] = []
    for k, (colour, sign) in enumerate(_LOOKS):
        off = values[:, k] - usual[k]
        # The last curve holds until the end of the recording.
        off = np.append(off, off[-1])
        traces.append(
            {
                'type': 'scatter', 'mode': 'lines+markers', 'name': f'u = {u[k]:.0f}',
                'x': times, 'y': rounded(off, 5),
                'line': {'color': token(colour), 'width': 1.8, 'shape': 'hv'},
                'marker': {'color': token(colour), 'size': 7, 'symbol': sign},
                'hovertemplate': f'%{{x|%d %b %H:%M}}<br>u = {u[k]:.0f}, usual {usual[k]:.1f} MW'
                '<br>%{y:+.2f} MW<extra></extra>',
            }
        )  # fmt: skip
    return traces


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float('nan')


def _knees(history: History) -> Spec:
    rows = [
        (c.time_ns / 1e6, float(u), float(lo), float(hi))
        for c in history.curves
        for u, lo, hi in zip(c.u[1:-1], c.low, c.high, strict=True)
    ]
    time, u, low, high = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    known = np.isfinite(low) & np.isfinite(high)
    return {
        'type': 'scatter', 'mode': 'markers', 'name': 'breakpoints, 95 %', 'yaxis': 'y2',
        'x': rounded(time, _MS), 'y': rounded(u, 6),
        'marker': {'color': token('curve'), 'size': 6},
        'error_y': {
            'type': 'data', 'symmetric': False, 'color': token('data'), 'thickness': 1.5,
            'width': 3, 'array': rounded(np.where(known, high - u, 0.0)),
            'arrayminus': rounded(np.where(known, u - low, 0.0)),
        },
        'hovertemplate': '%{x|%d %b %H:%M}<br>breakpoint at u %{y:.0f}<extra></extra>',
    }  # fmt: skip


def curve_history_figure(history: History) -> Figure:
    """Return the power at fixed inputs, and the breakpoints, from curve to curve."""
    u = followed(history)
    unit = input_unit(history.curves[-1].exponent)
    layout: Spec = {
        'xaxis': {'type': 'date', 'anchor': 'y2', 'title': {'text': 'time (UTC)'}},
        'yaxis': {'domain': [0.5, 1.0], 'title': {'text': 'power less<br>usual (MW)'}},
        'yaxis2': {'domain': [0.0, 0.42], 'title': {'text': f'breakpoints<br>u ({unit})'}},
        'showlegend': True,
    }
    span = duration((history.end_ns - history.curves[0].time_ns) / 1e9)
    caption = (
        '<b>Flat lines: the valve is as it was. A step: something happened then. A slope: it '
        'wears.</b> Above, what each curve gives at five inputs, less the median of all curves '
        'there; a line begins where the first curve that reaches so far was found. Below, where '
        'the breakpoints lie, with their 95 % intervals. The first curves rest on few data and '
        'may jump.'
    )
    last = history.curves[-1]
    words = (
        f'{counted(len(history.curves), "curve")} over {span}; the last has '
        f'{counted(len(last.u) - 1, "piece")} from '
        f'u {plain(float(last.u[0]))} to {plain(float(last.u[-1]))}.'
    )
    traces = [*_power_lines(history, u), _knees(history)]
    return Figure('history', caption, words, traces, layout, height=560)


def _alarm_words(history: History) -> str:
    changes = len(history.alarms)
    names = len({a.name for a in history.alarms})
    told = f'{counted(changes, "change")} of {counted(names, "alarm")}'
    if history.diagnoses:
        told += f' and {counted(len(history.diagnoses), "diagnosis", "diagnoses")}'
    return f'{told} from {moment(history.start_ns)} to {moment(history.end_ns)}.'
