# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The messages of a monitor in a recording: its curves, its alarms, its diagnoses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from valveflow_ros.monitoring.alarm_state import AlarmState
from valveflow_ros.monitoring.alarms import CALM
from valveflow_ros.records import FloatArray, IntArray
from valveflow_ros.report import figure as plot
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.figure import DAY_HOUR, Figure, Spec
from valveflow_ros.report.page import Section
from valveflow_ros.report.terminal.board import decoded
from valveflow_ros.report.terminal.frame import AlarmView, CurveView, DiagnosisView


@dataclass(frozen=True, slots=True)
class CurveMoment:
    """A curve, and the time of its publication."""

    time_ns: int
    model_id: str
    exponent: float  # of the pressure in u
    u: FloatArray  # (J + 1,) ends of the pieces
    power_mw: FloatArray  # (J + 1,) at them
    low: FloatArray  # (J - 1,) 95 % intervals of the inner ends; NaN if unknown
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
    later_ns: int = 0  # of the last repetition with another sentence; 0 if there is none
    later: str = ''  # its sentence

    @property
    def words(self) -> str:
        """Return the sentence, and that of the last repetition with its time."""
        if not self.later:
            return self.sentence
        return f'{self.sentence} Repeated at {say.moment(self.later_ns)}: {self.later}'


@dataclass(frozen=True, slots=True)
class DiagnosisMoment:
    """A diagnosis and its result."""

    time_ns: int
    sentence: str


@dataclass(frozen=True, slots=True)
class History:
    """The messages of a monitor, each kind in order of time."""

    start_ns: int  # of the recording, in the time of the plant
    end_ns: int
    curves: tuple[CurveMoment, ...] = ()  # each once, at its first publication
    alarms: tuple[AlarmMoment, ...] = ()
    diagnoses: tuple[DiagnosisMoment, ...] = ()
    notes: tuple[str, ...] = ()  # about what could not be read


Moment = CurveMoment | AlarmMoment | DiagnosisMoment
# The alarm whose sentence may change without a change of its state.
_SHIFT = 'curve_shift'


def moment_of(type_name: str, fields: Mapping[str, Any]) -> Moment | None:
    """Return the entry of a history for a message; None if there is nothing to show.

    Raises `KeyError`, `TypeError` or `ValueError` if the message cannot be read.
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

    They come in any order. Latched messages are published repeatedly, and standing alarms again
    after a restart: each counts once. ``times_ns`` are other times of the log, such as those of
    its first and last reading, ``notes`` what could not be read.
    """
    # A latched message from before the first plant time has time 0 and is ignored.
    found = sorted((m for m in told if m.time_ns > 0), key=lambda m: m.time_ns)
    said = tuple(notes)
    if not found and not said:
        return None
    times = [*times_ns, *(m.time_ns for m in found)]
    curves: dict[str, CurveMoment] = {}
    for m in found:
        if isinstance(m, CurveMoment):
            curves.setdefault(m.model_id, m)
    alarms = alarms_of(dict.fromkeys(m for m in found if isinstance(m, AlarmMoment)))
    diagnoses = dict.fromkeys(m for m in found if isinstance(m, DiagnosisMoment))
    return History(
        min(times, default=0), max(times, default=0), tuple(curves.values()), alarms,
        tuple(diagnoses), said,
    )  # fmt: skip


def alarms_of(told: Iterable[AlarmMoment]) -> tuple[AlarmMoment, ...]:
    """Return the changes in a series of alarm messages, in order, each with its sentence.

    The daily repetition of a standing alarm is not a change, but its sentence on the size of a
    shift is more accurate and is kept beside the first one, with its time. The first message of
    a standing alarm counts: it stood at the start of the recording.
    """
    changes: list[AlarmMoment] = []
    last: dict[str, int | None] = {}  # index of the last change of each alarm
    for a in told:
        place = last.get(a.name)
        if not a.again or (a.name not in last and a.state != AlarmState.NORMAL):
            last[a.name] = len(changes)
            changes.append(a)
        elif a.name == _SHIFT and place is not None and changes[place].state == a.state:
            if a.sentence != (changes[place].later or changes[place].sentence):
                changes[place] = replace(changes[place], later_ns=a.time_ns, later=a.sentence)
        else:
            last.setdefault(a.name, None)
    return tuple(changes)


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
        told = f'{say.counted(changes, "change")} of {say.counted(names, "alarm")}'
        if history.diagnoses:
            told += f' and {say.counted(len(history.diagnoses), "diagnosis", "diagnoses")}'
        told += f' from {say.period(history.start_ns, history.end_ns)}.'
        parts = html.paragraph(told), timeline_figure(history), alarms_table(history)
        sections.append(html.section('What the monitor said', *parts))
    if history.notes:
        sections = sections or [Section('What the monitor said')]
        sections[-1].parts.extend(html.notice(html.text(n)) for n in history.notes)
    return sections


def spans(history: History) -> list[tuple[str, AlarmState, int, int, str]]:
    """Return name, state, begin, end and sentence of every interval with one state."""
    found = []
    for name in _names(history):
        changes = [a for a in history.alarms if a.name == name]
        ends = [a.time_ns for a in changes[1:]] + [max(history.end_ns, changes[-1].time_ns)]
        found += [
            (name, a.state, a.time_ns, end, a.words) for a, end in zip(changes, ends, strict=True)
        ]
    return found


def standing_spans(history: History, name: str = '') -> list[tuple[int, int]]:
    """Return begin and end of every interval in which the condition held, of one alarm or all."""
    stands = (AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED)
    return sorted(
        (a, b) for n, state, a, b, _ in spans(history) if state in stands and name in ('', n)
    )


def _names(history: History) -> list[str]:
    return list(dict.fromkeys(a.name for a in history.alarms))


def _row_of(name: str) -> str:
    return html.text(name.replace('_', ' '))


def _broken(sentence: str) -> str:
    lines = ['']
    for word in html.text(sentence).split():
        if lines[-1] and len(lines[-1]) + len(word) >= _LINE:
            lines.append(word)
        else:
            lines[-1] = f'{lines[-1]} {word}'.strip()
    return '<br>'.join(lines)


def timeline_figure(history: History) -> Figure:
    """Return alarms by state, diagnoses and new curves over time."""
    said = {
        'new curve': ('line-ns-open', [
            (c.time_ns, f'{say.counted(len(c.u) - 1, "piece")}, error {c.rmse_mw:.2f} MW')
            for c in history.curves
        ]),
        'diagnosis': ('star', [(d.time_ns, _broken(d.sentence)) for d in history.diagnoses]),
    }  # fmt: skip
    traces = [
        plot.points(
            plot.moments([t / 1e6 for t, _ in found]), [row] * len(found), row, 'curve', size=9,
            showlegend=False, marker={'symbol': sign}, hoverinfo='text',
            hovertext=[f'{say.moment(t)}<br>{words}' for t, words in found],
        )
        for row, (sign, found) in said.items() if found
    ]  # fmt: skip
    for state in _STATES:
        traces += _bars(history, state)
    names = _names(history)
    rows = [row for row, (_, found) in said.items() if found] + [_row_of(n) for n in names]
    room = 0.015 * (history.end_ns - history.start_ns)  # space for a symbol at each end
    ends = plot.moments([(history.start_ns - room) / 1e6, (history.end_ns + room) / 1e6])
    layout: Spec = {
        'xaxis': plot.time_axis(range=ends),
        'yaxis': {
            'type': 'category', 'categoryorder': 'array', 'categoryarray': rows[::-1],
            'range': [-0.6, len(rows) - 0.4], 'fixedrange': True,
        },
        'showlegend': bool(names),
    }  # fmt: skip
    caption = (
        '<b>Look first at long bars, at bars that follow a new curve, and at bars that overlap in '
        'time.</b> A bar lasts as long as the alarm is in that state; a sign marks its beginning '
        'and shows the sentence when pointed at. Where there is no bar, all was normal.'
    )
    changes = say.counted(len(history.alarms), 'change')
    words = f'Time line of {say.counted(len(names), "alarm")} with {changes}.'
    height = 150 + _ROW * max(2, len(rows))
    return Figure('alarms', caption, words, traces, layout, height=height)


def _bars(history: History, state: AlarmState) -> list[Spec]:
    words, colour, sign = _STATES[state]
    mine = [s for s in spans(history) if s[1] is state]
    if not mine:
        return []
    # A gap between two intervals, so that no line connects them.
    x = plot.moments([t for _, _, a, b, _ in mine for t in (a / 1e6, b / 1e6, np.nan)])
    y = [cell for name, *_ in mine for cell in (_row_of(name), _row_of(name), None)]
    hover = [
        f'{say.moment(a)}<br>{_row_of(name)}: {words} for {say.duration((b - a) / 1e9)}'
        f'<br>{_broken(sentence)}'
        for name, _, a, b, sentence in mine
    ]
    return [
        plot.line(x, y, words, colour, width=14, legendgroup=words, showlegend=False),
        plot.points(
            plot.moments([a / 1e6 for _, _, a, _, _ in mine]),
            [_row_of(name) for name, *_ in mine], words, colour, size=11, legendgroup=words,
            showlegend=True, hovertext=hover, hoverinfo='text',
            marker={'symbol': sign, 'line': {'color': plot.token('ink'), 'width': 1}},
        ),
    ]  # fmt: skip


def alarms_table(history: History) -> str:
    """Return the last changes as a table; empty if there are none."""
    if not history.alarms:
        return ''
    shown = history.alarms[-_MOST:]
    rows = [
        [say.moment(a.time_ns), _row_of(a.name), _WORDS[a.state], html.text(a.words)]
        for a in shown
    ]
    stood, until = 0, -(1 << 62)  # ns in which the condition of any alarm held
    for begin, end in standing_spans(history):
        stood += max(0, end - max(begin, until))
        until = max(until, end)
    changes = say.counted(len(shown), 'change')
    held = f'Some alarm was active for {say.duration(stood / 1e9)} in all.'
    told = held if stood else 'No alarm was ever active.'
    if len(history.alarms) > len(shown):
        told += f' The last {changes}:'
    body = html.table(['time', 'alarm', 'state', 'what it said'], rows, sentences=True)
    what = 'The change' if len(shown) == 1 else f'All {changes}'
    return html.paragraph(told) + html.folded(f'{what} in words', body)


# How near the residual alarm was: its evidence is a share of the limit.

_DRAWN_STRETCHES = 1000
_DRAWN_SHARE = 1.25  # larger values are drawn at this one: the alarm is raised at 1


def largest_evidence(
    time_ns: IntArray, evidence: FloatArray, alarms: Sequence[tuple[int, int]]
) -> tuple[int, float] | None:
    """Return time and size of the largest evidence outside alarms; None if there is none.

    The rise of the evidence before an alarm and its fall afterwards belong to the alarm: all rows
    between two calm ones. The evidence (n,) is NaN where it was not judged; alarms have begin
    and end.
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
    time_ns: IntArray, average_mw: FloatArray, evidence: FloatArray,
    alarms: Sequence[tuple[int, int]], period_ns: int, limit_mw: float = 0.0,
) -> Figure:  # fmt: skip
    """Return the mean residual and the evidence of its alarm over time.

    Both are NaN where the residual was not judged. ``limit_mw`` is the fixed limit of the mean
    residual; 0 if the evidence is that of the control chart.
    """
    shown = 100.0 * np.clip(evidence, -_DRAWN_SHARE, _DRAWN_SHARE)
    traces = []
    for values, name, up, hover in (
        (average_mw, 'mean residual', 'y', '%{y:+.2f} MW'),
        (shown, 'evidence of the alarm', 'y2', '%{y:+.0f} % of the limit'),
    ):
        start_ns, step_ns, ends = plot.envelope(time_ns, values, _DRAWN_STRETCHES, period_ns)
        at = plot.moments((start_ns + step_ns * np.arange(len(ends))) / 1e6)
        colour = 'data' if up == 'y' else 'chosen'
        hover = f'{DAY_HOUR}{hover}<extra></extra>'
        traces.append(plot.line(at, plot.rounded(ends), name, colour, hover, width=1.2, yaxis=up))
    first, last = int(time_ns[0]) / 1e6, int(time_ns[-1]) / 1e6
    across = plot.moments([first, last, np.nan, first, last])
    for up, limit in (('y', limit_mw), ('y2', 100.0)):
        if limit > 0.0:
            traces.append(plot.line(
                across, [limit, limit, None, -limit, -limit], 'limit', 'steady', width=1.5,
                dash='dash', yaxis=up, legendgroup='limit', showlegend=up == 'y2',
            ))  # fmt: skip
    layout: Spec = {
        'xaxis': plot.time_axis(anchor='y2', range=plot.moments([first, last])),
        'yaxis': plot.axis('mean residual<br>(MW)', domain=[0.56, 1.0]),
        'yaxis2': plot.axis('evidence<br>(% of limit)', domain=[0.0, 0.46], range=[-135, 135]),
        'showlegend': True,
        'shapes': [plot.stripe(a / 1e6, b / 1e6, 'notice') for a, b in alarms],
    }
    fixed = f', with its fixed limit of {say.decimals(limit_mw, 2)} MW' if limit_mw > 0.0 else ''
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
        f'{say.duration((time_ns[-1] - time_ns[0]) / 1e9)}, with '
        f'{say.counted(len(alarms), "interval")} in which the alarm is active.'
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
        f'{say.counted(len(found), "curve")}, the first of {say.moment(found[0].time_ns)}, the '
        f'last of {say.moment(found[-1].time_ns)}.'
    )
    if len(found) < 2:
        return [html.paragraph(words)]
    at, moved = largest_move(history)
    if np.isfinite(moved):
        last = found[-1]
        place = f'{say.decimals(float(np.interp(at, last.u, last.power_mw)), 0)} MW'
        place += (
            f' (u = {say.decimals(at, 0)})'
            if last.exponent
            else f' ({say.decimals(at, 1)} % opening)'
        )
        words += (
            f' The last curve differs most from the median of the earlier ones at '
            f'{place}, by {say.decimals(moved, 2)} MW.'
        )
    return [html.paragraph(words), curve_history_figure(history)]


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
        'xaxis': plot.time_axis(anchor='y2'),
        'yaxis': plot.axis('power less<br>last curve (MW)', domain=[0.5, 1.0]),
        'yaxis2': plot.axis(
            f'breakpoints<br>u ({say.input_unit(last.exponent)})', domain=[0.0, 0.42]
        ),
        'showlegend': True,
    }
    caption = (
        '<b>Flat lines: the valve is as it was. A step: something happened then. A slope: it '
        'wears.</b> Above, by how many MW each curve lies above the last one at five inputs; a '
        'line begins where the first curve that reaches so far was found. Below, where the '
        'breakpoints lie, with their 95 % intervals. The first curves rest on few data and may '
        'jump.'
    )
    words = (
        f'{say.counted(len(history.curves), "curve")} over '
        f'{say.duration((history.end_ns - first.time_ns) / 1e9)}; the last has '
        f'{say.counted(len(last.u) - 1, "piece")} from '
        f'u {say.plain(float(last.u[0]))} to {say.plain(float(last.u[-1]))}.'
    )
    traces = [*_power_lines(history), _knees(history)]
    return Figure('history', caption, words, traces, layout, height=560)


def _power_lines(history: History) -> list[Spec]:
    u = followed(history)
    # The last curve is valid until the end of the recording.
    times = [c.time_ns for c in history.curves]
    at = plot.moments([t / 1e6 for t in (*times, max(history.end_ns, times[-1]))])
    traces = []
    for x, values, (colour, sign) in zip(u, powers(history.curves, u).T, _LOOKS, strict=True):
        off = np.append(values, values[-1]) - values[-1]
        traces.append(plot.line(
            at, plot.rounded(off), f'u = {x:.0f}', colour,
            f'{DAY_HOUR}u = {x:.0f}, last {values[-1]:.1f} MW<br>%{{y:+.2f}} MW<extra></extra>',
            width=1.8, shape='hv', mode='lines+markers',
            marker={'color': plot.token(colour), 'size': 7, 'symbol': sign},
        ))  # fmt: skip
    return traces


def _knees(history: History) -> Spec:
    rows = [
        (c.time_ns / 1e6, float(u), float(lo), float(hi))
        for c in history.curves
        for u, lo, hi in zip(c.u[1:-1], c.low, c.high, strict=True)
    ]
    time_ms, u, low, high = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    return plot.points(
        plot.moments(time_ms), plot.rounded(u, 6), 'breakpoints, 95 %', 'curve',
        f'{DAY_HOUR}breakpoint at u %{{y:.0f}}<extra></extra>', yaxis='y2',
        error_y=plot.error_bars(low, u, high, color=plot.token('data'), thickness=1.5, width=3),
    )  # fmt: skip
