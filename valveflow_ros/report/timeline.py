"""What a monitor said, on a line of time: alarms, diagnoses, new curves."""

from __future__ import annotations

import numpy as np

from valveflow_ros.monitoring.alarm_records import AlarmState
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.history_data import AlarmMoment, History
from valveflow_ros.report.numbers import counted, duration, moment
from valveflow_ros.report.page import paragraph, table, text

# Word, colour and sign of each state that is worth a bar, the gravest first.
_STATES = {
    AlarmState.UNACKNOWLEDGED: ('stands, nobody acknowledged', 'steady', 'diamond'),
    AlarmState.ACKNOWLEDGED: ('stands, acknowledged', 'chosen', 'circle'),
    AlarmState.RETURNED_UNACKNOWLEDGED: ('gone, nobody acknowledged', 'notice-rule', 'square'),
    AlarmState.SHELVED: ('put aside', 'slope', 'triangle-up'),
    AlarmState.SUPPRESSED: ('cannot be judged', 'data-soft', 'x'),
    AlarmState.OUT_OF_SERVICE: ('out of service', 'muted', 'cross'),
}
_WORDS = {AlarmState.NORMAL: 'normal', **{s: words for s, (words, _, _) in _STATES.items()}}
_MS = 13
_ROW = 46  # pixels
_MOST = 40
_LINE = 60  # signs of a hover before it breaks


def spans(history: History) -> list[tuple[str, AlarmState, int, int, str]]:
    """Return name, state, begin, end and sentence of every stretch in which a state held."""
    found = []
    for name in _names(history):
        changes = [a for a in history.alarms if a.name == name]
        ends = [a.time_ns for a in changes[1:]] + [max(history.end_ns, changes[-1].time_ns)]
        found += [
            (name, a.state, a.time_ns, end, a.sentence)
            for a, end in zip(changes, ends, strict=True)
        ]
    return found


def standing_s(history: History) -> float:
    """Return for how long any alarm's condition stood, in s."""
    stands = (AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED)
    held = sorted((a, b) for _, state, a, b, _ in spans(history) if state in stands)
    total, until = 0, -(1 << 62)
    for begin, end in held:
        total += max(0, end - max(begin, until))
        until = max(until, end)
    return total / 1e9


def _names(history: History) -> list[str]:
    return list(dict.fromkeys(a.name for a in history.alarms))


def _row_of(name: str) -> str:
    """Return an alarm's name as the figure and the table show it: both read HTML."""
    return text(name.replace('_', ' '))


def _broken(sentence: str) -> str:
    """Break a sentence into lines for a hover."""
    lines, line = [], ''
    for word in text(sentence).split():
        if line and len(line) + len(word) >= _LINE:
            lines.append(line)
            line = word
        else:
            line = f'{line} {word}'.strip()
    return '<br>'.join([*lines, line])


def _bars(history: History, state: AlarmState) -> list[Spec]:
    words, colour, sign = _STATES[state]
    mine = [s for s in spans(history) if s[1] is state]
    if not mine:
        return []
    # A gap between two stretches, so that no line joins them.
    x = np.array([t for _, _, a, b, _ in mine for t in (a / 1e6, b / 1e6, np.nan)])
    y = [cell for name, *_ in mine for cell in (_row_of(name), _row_of(name), None)]
    begins = np.array([a / 1e6 for _, _, a, _, _ in mine])
    hover = [
        f'{moment(a)}<br>{_row_of(name)}: {words} for {duration((b - a) / 1e9)}'
        f'<br>{_broken(sentence)}'
        for name, _, a, b, sentence in mine
    ]
    return [
        {
            'type': 'scatter', 'mode': 'lines', 'name': words, 'x': rounded(x, _MS), 'y': y,
            'line': {'color': token(colour), 'width': 14}, 'legendgroup': words,
            'showlegend': False, 'hoverinfo': 'skip',
        },
        {
            'type': 'scatter', 'mode': 'markers', 'name': words, 'x': rounded(begins, _MS),
            'y': [_row_of(name) for name, *_ in mine], 'legendgroup': words, 'showlegend': True,
            'marker': {
                'color': token(colour), 'size': 11, 'symbol': sign,
                'line': {'color': token('ink'), 'width': 1},
            },
            'hovertext': hover, 'hoverinfo': 'text',
        },
    ]  # fmt: skip


def _events(row: str, times_ns: list[int], hover: list[str], sign: str) -> list[Spec]:
    if not times_ns:
        return []
    return [
        {
            'type': 'scatter', 'mode': 'markers', 'name': row, 'showlegend': False,
            'x': rounded(np.array(times_ns) / 1e6, _MS), 'y': [row] * len(times_ns),
            'marker': {'color': token('curve'), 'size': 9, 'symbol': sign},
            'hovertext': hover, 'hoverinfo': 'text',
        }
    ]  # fmt: skip


def timeline_figure(history: History) -> Figure:
    """Return alarms by state, diagnoses and new curves over time."""
    names = _names(history)
    curves = [c.time_ns for c in history.curves]
    said = [d.time_ns for d in history.diagnoses]
    traces = [
        *_events('new curve', curves, [
            f'{moment(c.time_ns)}<br>{counted(len(c.u) - 1, "piece")}, error {c.rmse_mw:.2f} MW'
            for c in history.curves
        ], 'line-ns-open'),
        *_events('diagnosis', said, [
            f'{moment(d.time_ns)}<br>{_broken(d.sentence)}' for d in history.diagnoses
        ], 'star'),
    ]  # fmt: skip
    for state in _STATES:
        traces += _bars(history, state)
    rows = ['new curve'] * bool(curves) + ['diagnosis'] * bool(said) + [_row_of(n) for n in names]
    layout: Spec = {
        'xaxis': {
            'type': 'date', 'title': {'text': 'time (UTC)'},
            'range': _padded(history),
        },
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
    words = f'Time line of {counted(len(names), "alarm")} with {_changes(len(history.alarms))}.'
    height = 150 + _ROW * max(2, len(rows))
    return Figure('alarms', caption, words, traces, layout, height=height)


def _padded(history: History) -> list[float | None]:
    """Return the ends of the axis, with room for a sign at either end."""
    room = 0.015 * (history.end_ns - history.start_ns)
    return rounded(np.array([history.start_ns - room, history.end_ns + room]) / 1e6, _MS)


def alarms_table(history: History) -> str:
    """Return the last changes in words; empty if nothing ever changed."""
    if not history.alarms:
        return ''
    shown = history.alarms[-_MOST:]
    rows = [_cells(a) for a in shown]
    stood = standing_s(history)
    told = f'Some alarm stood for {duration(stood)} in all.' if stood else 'No alarm ever stood.'
    if len(history.alarms) > len(shown):
        told += f' The last {_changes(len(shown))}:'
    body = table(['time', 'alarm', 'state', 'what it said'], rows, sentences=True)
    what = 'The change' if len(shown) == 1 else f'All {_changes(len(shown))}'
    return paragraph(told) + f'<details><summary>{what} in words</summary>{body}</details>'


def _changes(number: int) -> str:
    return counted(number, 'change')


def _cells(change: AlarmMoment) -> list[str]:
    return [
        moment(change.time_ns), _row_of(change.name), _WORDS[change.state],
        text(change.sentence),
    ]  # fmt: skip
