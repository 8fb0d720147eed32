"""How the curve moved while a monitor watched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.monitoring.alarm import AlarmState
from valveflow_ros.records import FloatArray
from valveflow_ros.report.figure import Figure, Spec, rounded, token
from valveflow_ros.report.page import Section, notice, paragraph, table, text
from valveflow_ros.report.words import counted, decimals, duration, input_unit, moment, plain

# What a monitor published while it recorded: its curves, its alarms, its diagnoses.


@dataclass(frozen=True, slots=True)
class CurveMoment:
    """A curve, and when it came into force.

    Attributes
    ----------
    time_ns : int
        When it was published.
    model_id : str
    exponent : float
        Of the pressure in u.
    u, power_mw : float64 (J + 1,)
        Ends of the pieces and the power there.
    low, high : float64 (J - 1,)
        Where the inner ends lie with 95 % confidence; NaN if not known.
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
    """A change of one alarm's state."""

    time_ns: int
    name: str
    state: AlarmState
    sentence: str


@dataclass(frozen=True, slots=True)
class DiagnosisMoment:
    """A diagnosis, and what it said."""

    time_ns: int
    sentence: str


@dataclass(frozen=True, slots=True)
class History:
    """What a monitor published, each part in order of time.

    Attributes
    ----------
    start_ns, end_ns : int
        First and last moment of the recording, in the plant's time.
    curves : tuple of CurveMoment
        Each curve once, when it first came.
    alarms : tuple of AlarmMoment
    diagnoses : tuple of DiagnosisMoment
    notes : tuple of str
        What could not be read, as sentences.
    """

    start_ns: int
    end_ns: int
    curves: tuple[CurveMoment, ...] = ()
    alarms: tuple[AlarmMoment, ...] = ()
    diagnoses: tuple[DiagnosisMoment, ...] = ()
    notes: tuple[str, ...] = ()


# What a monitor said, on a line of time: alarms, diagnoses, new curves.


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


# Colour and sign of each input that is followed: told apart without colours too.
_LOOKS = (
    ('chosen', 'circle'), ('slope', 'square'), ('notice-rule', 'diamond'),
    ('steady', 'triangle-up'), ('curve', 'x'),
)  # fmt: skip


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
