# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The messages of a monitor in a recording: its curves, its alarms, its diagnoses."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from valveflow_ros.monitoring.alarm_state import AlarmState
from valveflow_ros.monitoring.alarms import CALM
from valveflow_ros.records import FloatArray, IntArray
from valveflow_ros.report.figure import (
    DAY_HOUR,
    Figure,
    Spec,
    axis,
    envelope,
    error_bars,
    line,
    moments,
    points,
    rounded,
    stripe,
    time_axis,
    token,
)
from valveflow_ros.report.page import Section, folded, notice, paragraph, table, text
from valveflow_ros.report.terminal.board import decoded
from valveflow_ros.report.terminal.frame import AlarmView, CurveView, DiagnosisView
from valveflow_ros.report.words import (
    counted,
    decimals,
    duration,
    input_unit,
    moment,
    period,
    plain,
)


@dataclass(frozen=True, slots=True)
class CurveMoment:
    """A curve, and the time of its publication.

    Attributes
    ----------
    time_ns : int
        Time of its publication.
    model_id : str
    exponent : float
        Exponent of the pressure in u.
    u, power_mw : float64 (J + 1,)
        Ends of the pieces, and the power at them.
    low, high : float64 (J - 1,)
        95 % intervals of the inner ends; NaN if unknown.
    rmse_mw : float
    """

    time_ns: int
    model_id: str
    exponent: float
    u: FloatArray
    power_mw: FloatArray
    low: FloatArray
    high: FloatArray
    rmse_mw: float


@dataclass(frozen=True, slots=True)
class AlarmMoment:
    """A change of the state of one alarm."""

    time_ns: int
    name: str
    state: AlarmState
    sentence: str
    again: bool = field(default=False, compare=False)  # the alarm was in this state before


@dataclass(frozen=True, slots=True)
class DiagnosisMoment:
    """A diagnosis and its result."""

    time_ns: int
    sentence: str


@dataclass(frozen=True, slots=True)
class History:
    """The messages of a monitor, each kind in order of time.

    Attributes
    ----------
    start_ns, end_ns : int
        First and last time of the recording, in the time of the plant.
    curves : tuple of CurveMoment
        Each curve once, at its first publication.
    alarms : tuple of AlarmMoment
    diagnoses : tuple of DiagnosisMoment
    notes : tuple of str
        Sentences about what could not be read.
    """

    start_ns: int
    end_ns: int
    curves: tuple[CurveMoment, ...] = ()
    alarms: tuple[AlarmMoment, ...] = ()
    diagnoses: tuple[DiagnosisMoment, ...] = ()
    notes: tuple[str, ...] = ()


Moment = CurveMoment | AlarmMoment | DiagnosisMoment
# The alarm whose sentence may change without a change of its state.
_SHIFT = 'curve_shift'
Item = TypeVar('Item')


def moment_of(type_name: str, fields: Mapping[str, Any]) -> Moment | None:
    """Return the entry of a history for a message; None if there is nothing to show.

    Raises
    ------
    KeyError, TypeError, ValueError
        The message cannot be read.
    """
    time_ns, view = decoded(type_name, fields)
    if isinstance(view, AlarmView):
        again = fields.get('previous_state') == view.state
        return AlarmMoment(time_ns, view.name, AlarmState(view.state), view.sentence, again)
    if isinstance(view, DiagnosisView):
        return DiagnosisMoment(time_ns, view.sentence) if view.verdict and view.sentence else None
    if not isinstance(view, CurveView):
        return None
    bounds = fields.get('breakpoint_low', ()), fields.get('breakpoint_high', ())
    u, power, low, high = (
        np.array(v, dtype=np.float64) for v in (view.breakpoints, view.values, *bounds)
    )
    finite = np.all(np.isfinite(u)) and np.all(np.isfinite(power))
    if len(u) < 2 or len(power) != len(u) or not finite or np.any(np.diff(u) <= 0.0):
        return None
    if len(low) != len(u) - 2 or len(high) != len(u) - 2:
        low = high = np.full(len(u) - 2, np.nan)
    return CurveMoment(time_ns, view.model_id, view.exponent, u, power, low, high, view.rmse_mw)


def history_of(
    told: Iterable[Moment], times_ns: Iterable[int], notes: Iterable[str]
) -> History | None:
    """Return the history of the published messages; None if a log contains no monitor.

    Parameters
    ----------
    told : iterable of CurveMoment, AlarmMoment, DiagnosisMoment
        In any order. Latched messages are published repeatedly, and standing alarms again after a
        restart: each counts once.
    times_ns : iterable of int
        Other times of the log, such as those of its first and last reading.
    notes : iterable of str
        Sentences about what could not be read.
    """
    # A latched message from before the first plant time has time 0 and is ignored.
    found = sorted((m for m in told if m.time_ns > 0), key=lambda m: m.time_ns)
    said = tuple(notes)
    if not found and not said:
        return None
    times = [*times_ns, *(m.time_ns for m in found)]
    curves = _once((m for m in found if isinstance(m, CurveMoment)), lambda c: c.model_id)
    diagnoses = _once((m for m in found if isinstance(m, DiagnosisMoment)), lambda d: d)
    alarms = alarms_of(_once((m for m in found if isinstance(m, AlarmMoment)), lambda a: a))
    return History(
        min(times, default=0), max(times, default=0), tuple(curves), alarms,
        tuple(diagnoses), said,
    )  # fmt: skip


def alarms_of(told: Iterable[AlarmMoment]) -> tuple[AlarmMoment, ...]:
    """Return the changes in a series of alarm messages, in order, with their last sentences.

    The daily repetition of a standing alarm is not a change, but its sentence on the size of a
    shift is more accurate and replaces the earlier one. The first message of a standing alarm
    counts: it stood at the start of the recording.
    """
    changes: list[AlarmMoment] = []
    last: dict[str, int | None] = {}  # index of the last change of each alarm
    for a in told:
        place = last.get(a.name)
        if not a.again or (a.name not in last and a.state != AlarmState.NORMAL):
            last[a.name] = len(changes)
            changes.append(a)
        elif a.name == _SHIFT and place is not None and changes[place].state == a.state:
            changes[place] = replace(changes[place], sentence=a.sentence)
        else:
            last.setdefault(a.name, None)
    return tuple(changes)


def _once(items: Iterable[Item], key: Callable[[Item], Hashable]) -> list[Item]:
    """Return each item only at its first occurrence."""
    first: dict[Hashable, Item] = {}
    for item in items:
        first.setdefault(key(item), item)
    return list(first.values())


# Text, colour and symbol of each state that is drawn as a bar, the most severe first.
_STATES = {
    AlarmState.UNACKNOWLEDGED: ('stands, nobody acknowledged', 'steady', 'diamond'),
    AlarmState.ACKNOWLEDGED: ('stands, acknowledged', 'chosen', 'circle'),
    AlarmState.RETURNED_UNACKNOWLEDGED: ('gone, nobody acknowledged', 'notice-rule', 'square'),
    AlarmState.SHELVED: ('shelved', 'slope', 'triangle-up'),
    AlarmState.SUPPRESSED: ('cannot be judged', 'data-soft', 'x'),
    AlarmState.OUT_OF_SERVICE: ('out of service', 'muted', 'cross'),
}
_WORDS = {AlarmState.NORMAL: 'normal', **{s: words for s, (words, _, _) in _STATES.items()}}
_ROW = 46  # pixels
_MOST = 40
_LINE = 60  # characters per line of a hover text


def history_sections(history: History | None) -> list[Section]:
    """Return the page sections about the recording of a monitor; none for other logs."""
    if history is None:
        return []
    sections = []
    if history.curves:
        sections.append(Section('How the curve moved', _curves(history)))
    if history.alarms or history.diagnoses:
        changes, names = len(history.alarms), len(_names(history))
        told = f'{counted(changes, "change")} of {counted(names, "alarm")}'
        if history.diagnoses:
            told += f' and {counted(len(history.diagnoses), "diagnosis", "diagnoses")}'
        told += f' from {period(history.start_ns, history.end_ns)}.'
        sections.append(Section('What the monitor said', [
            paragraph(told), timeline_figure(history), alarms_table(history),
        ]))  # fmt: skip
    if history.notes:
        sections = sections or [Section('What the monitor said')]
        sections[-1].parts.extend(notice(text(n)) for n in history.notes)
    return sections


def spans(history: History) -> list[tuple[str, AlarmState, int, int, str]]:
    """Return name, state, begin, end and sentence of every interval with one state."""
    found = []
    for name in _names(history):
        changes = [a for a in history.alarms if a.name == name]
        ends = [a.time_ns for a in changes[1:]] + [max(history.end_ns, changes[-1].time_ns)]
        found += [
            (name, a.state, a.time_ns, end, a.sentence)
            for a, end in zip(changes, ends, strict=True)
        ]
    return found


def standing_spans(history: History, name: str = '') -> list[tuple[int, int]]:
    """Return begin and end of every interval in which the condition held, of one alarm or all."""
    stands = (AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED)
    return sorted(
        (a, b) for n, state, a, b, _ in spans(history) if state in stands and name in ('', n)
    )


def standing_s(history: History) -> float:
    """Return the total time in which the condition of any alarm held, in s."""
    held = standing_spans(history)
    total, until = 0, -(1 << 62)
    for begin, end in held:
        total += max(0, end - max(begin, until))
        until = max(until, end)
    return total / 1e9


def _names(history: History) -> list[str]:
    return list(dict.fromkeys(a.name for a in history.alarms))


def _row_of(name: str) -> str:
    """Return the name of an alarm for the figure and the table, as HTML."""
    return text(name.replace('_', ' '))


def _broken(sentence: str) -> str:
    """Split a sentence into lines for a hover text."""
    lines = ['']
    for word in text(sentence).split():
        if lines[-1] and len(lines[-1]) + len(word) >= _LINE:
            lines.append(word)
        else:
            lines[-1] = f'{lines[-1]} {word}'.strip()
    return '<br>'.join(lines)


def timeline_figure(history: History) -> Figure:
    """Return alarms by state, diagnoses and new curves over time."""
    said = {
        'new curve': ('line-ns-open', [
            (c.time_ns, f'{counted(len(c.u) - 1, "piece")}, error {c.rmse_mw:.2f} MW')
            for c in history.curves
        ]),
        'diagnosis': ('star', [(d.time_ns, _broken(d.sentence)) for d in history.diagnoses]),
    }  # fmt: skip
    traces = [
        points(
            moments([t / 1e6 for t, _ in found]), [row] * len(found), row, 'curve', size=9,
            showlegend=False, marker={'symbol': sign}, hoverinfo='text',
            hovertext=[f'{moment(t)}<br>{words}' for t, words in found],
        )
        for row, (sign, found) in said.items() if found
    ]  # fmt: skip
    for state in _STATES:
        traces += _bars(history, state)
    names = _names(history)
    rows = [row for row, (_, found) in said.items() if found] + [_row_of(n) for n in names]
    room = 0.015 * (history.end_ns - history.start_ns)  # space for a symbol at each end
    ends = moments([(history.start_ns - room) / 1e6, (history.end_ns + room) / 1e6])
    layout: Spec = {
        'xaxis': time_axis(range=ends),
        'yaxis': {
            'type': 'category', 'categoryorder': 'array', 'categoryarray': rows[::-1],
            'range': [-0.6, len(rows) - 0.4], 'fixedrange': True,
        },
        'showlegend': bool(names),
    }  # fmt: skip
    caption = (
        '<b>Long bars are worth a look, and bars that follow a new curve or stand in one row at '
        'the same time.</b> A bar lasts as long as the alarm is in that state; a sign marks its '
        'beginning, and tells the sentence when pointed at. Where there is no bar, all was normal.'
    )
    changes = counted(len(history.alarms), 'change')
    words = f'Time line of {counted(len(names), "alarm")} with {changes}.'
    height = 150 + _ROW * max(2, len(rows))
    return Figure('alarms', caption, words, traces, layout, height=height)


def _bars(history: History, state: AlarmState) -> list[Spec]:
    words, colour, sign = _STATES[state]
    mine = [s for s in spans(history) if s[1] is state]
    if not mine:
        return []
    # A gap between two intervals, so that no line connects them.
    x = moments([t for _, _, a, b, _ in mine for t in (a / 1e6, b / 1e6, np.nan)])
    y = [cell for name, *_ in mine for cell in (_row_of(name), _row_of(name), None)]
    hover = [
        f'{moment(a)}<br>{_row_of(name)}: {words} for {duration((b - a) / 1e9)}'
        f'<br>{_broken(sentence)}'
        for name, _, a, b, sentence in mine
    ]
    return [
        line(x, y, words, colour, width=14, legendgroup=words, showlegend=False),
        points(
            moments([a / 1e6 for _, _, a, _, _ in mine]), [_row_of(name) for name, *_ in mine],
            words, colour, size=11, legendgroup=words, showlegend=True, hovertext=hover,
            marker={'symbol': sign, 'line': {'color': token('ink'), 'width': 1}},
            hoverinfo='text',
        ),
    ]  # fmt: skip


def alarms_table(history: History) -> str:
    """Return the last changes as a table; empty if there are none."""
    if not history.alarms:
        return ''
    shown = history.alarms[-_MOST:]
    rows = [[moment(a.time_ns), _row_of(a.name), _WORDS[a.state], text(a.sentence)] for a in shown]
    stood = standing_s(history)
    changes = counted(len(shown), 'change')
    told = f'Some alarm stood for {duration(stood)} in all.' if stood else 'No alarm ever stood.'
    if len(history.alarms) > len(shown):
        told += f' The last {changes}:'
    body = table(['time', 'alarm', 'state', 'what it said'], rows, sentences=True)
    what = 'The change' if len(shown) == 1 else f'All {changes}'
    return paragraph(told) + folded(f'{what} in words', body)


# How near the residual alarm was: its evidence is a share of the limit.

_DRAWN_STRETCHES = 1000
_DRAWN_SHARE = 1.25  # larger values are drawn at this one: the alarm is raised at 1


def largest_evidence(
    time_ns: IntArray, evidence: FloatArray, alarms: Sequence[tuple[int, int]]
) -> tuple[int, float] | None:
    """Return time and size of the largest evidence outside alarms; None if there is none.

    The rise of the evidence before an alarm and its fall afterwards belong to the alarm: all rows
    between two calm ones.

    Parameters
    ----------
    time_ns : int64 (n,)
    evidence : float64 (n,)
        NaN where it was not judged.
    alarms : sequence of (int, int)
        Begin and end of each.
    """
    judged = np.isfinite(evidence)
    time_ns, size = time_ns[judged], np.abs(evidence[judged])
    course = np.cumsum(size < CALM)
    raised = np.zeros(len(size), dtype=bool)
    for begin, end in alarms:
        raised |= (time_ns >= begin) & (time_ns <= end)
    free = np.flatnonzero(~np.isin(course, course[raised]))
    if not len(free):
        return None
    k = free[np.argmax(size[free])]
    return int(time_ns[k]), float(size[k])


def evidence_figure(
    time_ns: IntArray,
    average_mw: FloatArray,
    evidence: FloatArray,
    alarms: Sequence[tuple[int, int]],
    period_ns: int,
    limit_mw: float = 0.0,
) -> Figure:
    """Return the mean residual and the evidence of its alarm over time.

    Parameters
    ----------
    time_ns : int64 (n,)
        Rising.
    average_mw, evidence : float64 (n,)
        NaN where the residual was not judged.
    alarms : sequence of (int, int)
        Begin and end of each.
    period_ns : int
        Step of the rows.
    limit_mw : float
        Fixed limit of the mean residual; 0 if the evidence is that of the control chart.
    """
    shown = 100.0 * np.clip(evidence, -_DRAWN_SHARE, _DRAWN_SHARE)
    traces = []
    for values, name, up, hover in (
        (average_mw, 'mean residual', 'y', '%{y:+.2f} MW'),
        (shown, 'evidence of the alarm', 'y2', '%{y:+.0f} % of the limit'),
    ):
        start_ns, step_ns, ends = envelope(time_ns, values, _DRAWN_STRETCHES, period_ns)
        at = moments((start_ns + step_ns * np.arange(len(ends))) / 1e6)
        colour = 'data' if up == 'y' else 'chosen'
        hover = f'{DAY_HOUR}{hover}<extra></extra>'
        traces.append(line(at, rounded(ends), name, colour, hover, width=1.2, yaxis=up))
    first, last = int(time_ns[0]) / 1e6, int(time_ns[-1]) / 1e6
    across = moments([first, last, np.nan, first, last])
    for up, limit in (('y', limit_mw), ('y2', 100.0)):
        if limit > 0.0:
            traces.append(line(
                across, [limit, limit, None, -limit, -limit], 'limit', 'steady', width=1.5,
                dash='dash', yaxis=up, legendgroup='limit', showlegend=up == 'y2',
            ))  # fmt: skip
    layout: Spec = {
        'xaxis': time_axis(anchor='y2', range=moments([first, last])),
        'yaxis': axis('mean residual<br>(MW)', domain=[0.56, 1.0]),
        'yaxis2': axis('evidence<br>(% of limit)', domain=[0.0, 0.46], range=[-135, 135]),
        'showlegend': True,
        'shapes': [stripe(a / 1e6, b / 1e6, 'notice') for a, b in alarms],
    }
    fixed = f', with its fixed limit of {decimals(limit_mw, 2)} MW' if limit_mw > 0.0 else ''
    rule = (
        'It is the mean residual divided by its limit.'
        if limit_mw > 0.0
        else 'It adds up small lasting differences, so a small one comes near the limit slowly '
        'and a large one within minutes; there is no fixed limit in MW.'
    )
    caption = (
        '<b>The alarm is raised when the evidence stays beyond 100 % for alarm_on_delay.</b> '
        f'Above, the running mean of the residual{fixed}. Below, the evidence of the alarm, '
        f'drawn up to {100 * _DRAWN_SHARE:.0f} %. {rule} On a coloured background the alarm '
        'stands: it returns after alarm_off_delay at the openings where it was raised. In a gap '
        'the residual could not be judged.'
    )
    words = (
        f'Mean residual and evidence of the residual alarm over '
        f'{duration((time_ns[-1] - time_ns[0]) / 1e9)}, with '
        f'{counted(len(alarms), "interval")} in which the alarm stands.'
    )
    return Figure('evidence', caption, words, traces, layout, height=520)


# Colour and symbol for each of the fixed inputs, distinguishable without colours.
_LOOKS = (
    ('chosen', 'circle'), ('slope', 'square'), ('notice-rule', 'diamond'),
    ('steady', 'triangle-up'), ('curve', 'x'),
)  # fmt: skip


def _curves(history: History) -> list[str | Figure]:
    found = history.curves
    words = (
        f'{counted(len(found), "curve")}, the first of {moment(found[0].time_ns)}, the last of '
        f'{moment(found[-1].time_ns)}.'
    )
    if len(found) < 2:
        return [paragraph(words)]
    at, moved = largest_move(history)
    if np.isfinite(moved):
        last = found[-1]
        place = f'{decimals(float(np.interp(at, last.u, last.power_mw)), 0)} MW'
        place += (
            f' (u = {decimals(at, 0)})' if last.exponent else f' ({decimals(at, 1)} % opening)'
        )
        words += (
            f' The last curve differs most from the median of the earlier ones at '
            f'{place}, by {decimals(moved, 2)} MW.'
        )
    return [paragraph(words), curve_history_figure(history)]


def followed(history: History) -> FloatArray:
    """Return the fixed inputs of the figure: evenly spaced in the range of the last curve."""
    last = history.curves[-1].u
    return np.linspace(float(last[0]), float(last[-1]), len(_LOOKS) + 2)[1:-1]


def powers(curves: tuple[CurveMoment, ...], u: FloatArray) -> FloatArray:
    """Return the power of each curve at each input, MW, NaN outside a curve: (curves, inputs)."""
    return np.array([np.interp(u, c.u, c.power_mw, left=np.nan, right=np.nan) for c in curves])


def largest_move(history: History) -> tuple[float, float]:
    """Return u of the largest difference of the last curve from the median of the earlier ones.

    The second value is that difference in MW; both are NaN if no range is common.
    """
    *earlier, last = history.curves
    u = np.unique(np.concatenate([c.u for c in history.curves]))
    u = u[(u >= last.u[0]) & (u <= last.u[-1])]
    before = powers(tuple(earlier), u)
    known = np.isfinite(before).any(axis=0)
    if not known.any():
        return float('nan'), float('nan')
    u, before = u[known], before[:, known]
    moved = np.interp(u, last.u, last.power_mw) - np.nanmedian(before, axis=0)
    k = int(np.argmax(np.abs(moved)))
    return float(u[k]), float(moved[k])


def curve_history_figure(history: History) -> Figure:
    """Return the power at fixed inputs and the breakpoints, over the times of the curves."""
    first, last = history.curves[0], history.curves[-1]
    layout: Spec = {
        'xaxis': time_axis(anchor='y2'),
        'yaxis': axis('power less<br>usual (MW)', domain=[0.5, 1.0]),
        'yaxis2': axis(f'breakpoints<br>u ({input_unit(last.exponent)})', domain=[0.0, 0.42]),
        'showlegend': True,
    }
    caption = (
        '<b>Flat lines: the valve is as it was. A step: something happened then. A slope: it '
        'wears.</b> Above, what each curve gives at five inputs, less the median of all curves '
        'there; a line begins where the first curve that reaches so far was found. Below, where '
        'the breakpoints lie, with their 95 % intervals. The first curves rest on few data and '
        'may jump.'
    )
    words = (
        f'{counted(len(history.curves), "curve")} over '
        f'{duration((history.end_ns - first.time_ns) / 1e9)}; the last has '
        f'{counted(len(last.u) - 1, "piece")} from '
        f'u {plain(float(last.u[0]))} to {plain(float(last.u[-1]))}.'
    )
    traces = [*_power_lines(history), _knees(history)]
    return Figure('history', caption, words, traces, layout, height=560)


def _power_lines(history: History) -> list[Spec]:
    u = followed(history)
    # The last curve is valid until the end of the recording.
    times = [c.time_ns for c in history.curves]
    at = moments([t / 1e6 for t in (*times, max(history.end_ns, times[-1]))])
    traces = []
    for x, values, (colour, sign) in zip(u, powers(history.curves, u).T, _LOOKS, strict=True):
        known = values[np.isfinite(values)]
        usual = float(np.median(known)) if len(known) else float('nan')
        off = np.append(values, values[-1]) - usual
        traces.append(line(
            at, rounded(off), f'u = {x:.0f}', colour,
            f'{DAY_HOUR}u = {x:.0f}, usual {usual:.1f} MW<br>%{{y:+.2f}} MW<extra></extra>',
            width=1.8, shape='hv', mode='lines+markers',
            marker={'color': token(colour), 'size': 7, 'symbol': sign},
        ))  # fmt: skip
    return traces


def _knees(history: History) -> Spec:
    rows = [
        (c.time_ns / 1e6, float(u), float(lo), float(hi))
        for c in history.curves
        for u, lo, hi in zip(c.u[1:-1], c.low, c.high, strict=True)
    ]
    time_ms, u, low, high = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    return points(
        moments(time_ms), rounded(u, 6), 'breakpoints, 95 %', 'curve',
        f'{DAY_HOUR}breakpoint at u %{{y:.0f}}<extra></extra>', yaxis='y2',
        error_y=error_bars(low, u, high, color=token('data'), thickness=1.5, width=3),
    )  # fmt: skip
