# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page: texts and figures of each unit, made with Dash and updated at each tick.

The server stores no state per browser. At each tick a browser sends the version of each part that
it shows, and receives the parts that differ; their content is made once for all browsers.
"""

from __future__ import annotations

import hmac
import math
import secrets
import threading
import time
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import tzinfo
from hashlib import sha256
from importlib import resources
from itertools import chain, groupby, pairwise
from typing import Any, NamedTuple

from dash import ALL, MATCH, Dash, Input, Output, State, ctx, dcc, html, no_update

from valveflow_ros import __version__
from valveflow_ros.page.unit import MINUTE_NS, MOST_UNITS, Shown, Snapshot
from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.figure import Spec, axis, line, local_ms, points, rounded, token
from valveflow_ros.report.page import read_text
from valveflow_ros.report.terminal import frame as views
from valveflow_ros.report.terminal.frame import (
    ACKNOWLEDGED,
    BAD_DATA,
    ERROR,
    OK,
    STALE,
    UNACKNOWLEDGED,
    WARN,
    Frame,
    HealthView,
    Said,
)
from valveflow_ros.report.terminal.text import clean
from valveflow_ros.report.words import in_zone, input_axis, moment

TICK_MS = 2000
# The newest samples are shown individually; older ones as one point per minute.
RECENT_S = 900
_MOST_RECENT = 300
_LEVELS = {OK: ('ok', 'good'), WARN: ('look', 'warn'), ERROR: ('fault', 'bad'),
           STALE: ('silent', 'bad')}  # fmt: skip
PARTS = ('head', 'alarms', 'curve_words', 'now', 'diagnosis', 'health')
PICTURES = {'curve': 300, 'recent': 250, 'day': 340}
# The requests to a monitor that the page offers.
ASKED = {
    f'{action} {name}': f'{action.capitalize()} {name}'
    for name in ('residual', 'curve_shift') for action in ('acknowledge', 'shelve')
}  # fmt: skip
_TRIES, _WAIT_S = 5, 30.0
Ask = Callable[[str, str], tuple[bool, str]]


# Texts.


def _said(said: Said, zone: tzinfo | None) -> Any:
    text, tone = clean(in_zone(said[0], zone)), said[1]
    first, point, rest = text.partition('. ')
    if tone == 'bad' and rest:
        # The state is emphasised, its reason is not.
        return html.P([html.B(first + point), rest], className=tone)
    return html.P(text, className=tone or 'plain')


def summary(frame: Frame, present: bool) -> Said:
    """Return the state of a unit as one word, with its style."""
    if not present:
        return 'no monitor', 'bad'
    states = {alarm.state for alarm in frame.alarms if alarm.standing}
    words = (
        (UNACKNOWLEDGED in states, 'alarm', 'bad'),
        (ACKNOWLEDGED in states, 'alarm, acknowledged', 'bad'),
        (frame.last is not None and frame.last.state == BAD_DATA, 'bad data', 'bad'),
        (any(item.level in (ERROR, STALE) for item in frame.inputs), 'input fault', 'bad'),
        (bool(states), 'alarm to be looked at', 'warn'),
        (frame.curve is None or not frame.curve.breakpoints, 'no curve yet', 'dim'),
    )
    return next(((word, tone) for holds, word, tone in words if holds), ('no alarm', 'good'))


def _head(unit: Snapshot, zone: tzinfo | None) -> list[Any]:
    frame = unit.frame
    word, tone = summary(frame, unit.present)
    when = in_zone(moment(frame.now_ns), zone) if frame.now_ns else 'no data yet'
    made = [
        html.H2([clean(unit.title), ' ', html.Span(word, className=f'pill {tone}')]),
        html.P(f'{when}, {clean(unit.key)}', className='where'),
    ]
    note = clean(in_zone(frame.note, zone))
    return [*made, html.P(note, className='notice')] if note else made


def _row(item: HealthView, zone: tzinfo | None) -> Any:
    word, tone = _LEVELS.get(item.level, (f'level {item.level}', 'bad'))
    return html.Tr([
        html.Th(views.short_name(item.name), scope='row'),
        html.Td(html.Span(word, className=f'pill {tone}')),
        html.Td(clean(in_zone(item.sentence, zone)), className='words'),
    ])  # fmt: skip


def _health(frame: Frame, zone: tzinfo | None) -> list[Any]:
    text, tone = views.recorder_words(frame)
    if not frame.inputs:
        return [html.P('Nothing has come from any input yet.', className='dim')]
    unknown = html.Tr([html.Th('recorder'), html.Td(), html.Td(text, className=tone)])
    rows = [_row(item, zone) for item in frame.inputs]
    rows.append(unknown if frame.recorder is None else _row(frame.recorder, zone))
    return [html.Div(html.Table(html.Tbody(rows)), className='scroll')]


def words(unit: Snapshot, zone: tzinfo | None = None) -> dict[str, list[Any]]:
    """Return the content of each of `PARTS` as Dash components; times in a zone, or in UTC."""
    frame, curve, found = unit.frame, unit.frame.curve, unit.frame.diagnosis
    # The age of the curve in whole minutes, so that it does not change every second.
    now_ns = max(0 if curve is None else curve.window[1], frame.now_ns - frame.now_ns % MINUTE_NS)
    said = views.diagnosis_words(None if found is None else replace(found, advice=()))
    advice = () if found is None else found.advice
    return {
        'head': _head(unit, zone),
        'alarms': [_said(said, zone) for said in views.alarms_words(frame)],
        'curve_words': [_said(views.curve_words(curve, now_ns), zone)],
        'now': [_said(views.sample_words(frame.last), zone)],
        'diagnosis': [_said(said, zone), *(html.P(clean(in_zone(a, zone))) for a in advice)],
        'health': _health(frame, zone),
    }


# Figures, in the format of `report.figure`: colours by name.


def curve_picture(frame: Frame) -> Spec:
    """Return the curve with the last 15 minutes and the present operating point."""
    curve, last, traces = frame.curve, frame.last, []
    if curve is not None:
        traces.append(line(
            rounded(curve.breakpoints), rounded(curve.values), 'curve', 'curve',
            'curve: %{y:.1f} at u = %{x:.0f}<extra></extra>', mode='lines+markers',
        ))  # fmt: skip
    if recent := _recent(frame):
        traces.append(points(
            rounded([s.u for s in recent]), rounded([s.measured_mw for s in recent]),
            'last 15 min', 'data-soft', size=4,
        ))  # fmt: skip
    if last is not None and math.isfinite(last.u) and math.isfinite(last.measured_mw):
        mark = {'size': 13, 'symbol': 'diamond', 'line': {'color': token('paper'), 'width': 2}}
        traces.append(points(
            rounded([last.u]), rounded([last.measured_mw]), 'now', 'steady',
            'now: %{y:.1f} at u = %{x:.0f}<extra></extra>', marker=mark,
        ))  # fmt: skip
    across = axis(input_axis(math.nan if curve is None else curve.exponent))
    return {'data': traces, 'layout': {'xaxis': across, 'yaxis': axis('power (MW)')}}


def _recent(frame: Frame) -> list[Any]:
    begin_ns = frame.now_ns - RECENT_S * NS_PER_S
    found = [s for s in frame.samples if s.time_ns >= begin_ns]
    step = -(-len(found) // _MOST_RECENT) or 1
    # Counted from the end, so that the newest sample is always included.
    return found[::-1][::step][::-1]


def _ms(time_ns: int) -> float:
    return time_ns // 1_000_000


def recent_picture(frame: Frame, zone: tzinfo | None = None) -> Spec:
    """Return prediction with its limits and measurement over the last 15 minutes."""
    found = _recent(frame)
    if not found:
        return _empty('No sample has come yet.')
    expected = [(s, s.measured_mw - s.residual_mw) for s in found]
    rows = [(_ms(s.time_ns), s.measured_mw, p, p + s.low_mw, p + s.high_mw) for s, p in expected]
    return _against(rows, '95 % limits', zone)


def day_picture(unit: Snapshot, zone: tzinfo | None = None) -> Spec:
    """Return means over a minute for the last 24 hours, with a range slider."""
    day = unit.day
    if len(day) < 2:
        return _empty('A point comes each minute.')
    rows, nan = [], math.nan
    late = (b.start_ns - a.start_ns > 90 * NS_PER_S for a, b in pairwise(day))
    for gap, m in zip(chain([False], late), day, strict=False):
        if gap:
            rows.append((_ms(m.start_ns) - 1, nan, nan, nan, nan))
        middle = _ms(m.start_ns + MINUTE_NS // 2)
        rows.append((middle, m.measured_mw, m.predicted_mw, m.low_mw, m.high_mw))
    made = _against(rows, 'least to largest', zone)
    made['layout']['xaxis']['rangeslider'] = {
        'thickness': 0.16, 'bgcolor': token('panel'), 'borderwidth': 1,
        'bordercolor': token('rule'),
    }  # fmt: skip
    return made


def _against(rows: Sequence[tuple[float, ...]], band: str, zone: tzinfo | None) -> Spec:
    """Return a figure over time of rows: ms, measured, predicted, and the edges of a band."""
    times, *columns = zip(*rows, strict=True)
    t = list(times) if zone is None else [local_ms(ms, zone) for ms in times]
    measured, predicted, low, high = map(rounded, columns)
    around: list[tuple[Any, float | None]] = []  # one closed outline between two gaps
    for there, run in groupby(zip(t, low, high, strict=True), lambda row: row[1] is not None):
        if there:
            edges = list(run)
            around += [(None, None)] if around else []
            around += [(at, bottom) for at, bottom, _ in edges]
            around += [(at, top) for at, _, top in reversed(edges)]
    x, y = zip(*around, strict=True) if around else ((), ())
    traces = [
        line(list(x), list(y), band, 'band', line={'width': 0}, fill='toself',
             fillcolor=token('band')),
        line(t, predicted, 'predicted', 'curve', '%{y:.1f} MW predicted<extra></extra>'),
        line(t, measured, 'measured', 'steady', '%{y:.1f} MW measured<extra></extra>', width=1.5),
    ]  # fmt: skip
    # No fixed range: updating it would undo the scrolling of the user.
    across = axis('', type='date', tickangle=0, nticks=6)
    return {'data': traces, 'layout': {'xaxis': across, 'yaxis': axis('power (MW)')}}


def _empty(sentence: str) -> Spec:
    told = {'text': sentence, 'showarrow': False, 'xref': 'paper', 'yref': 'paper', 'x': 0.5,
            'y': 0.5, 'font': {'color': token('muted')}}  # fmt: skip
    hidden = axis('', visible=False)
    return {'data': [], 'layout': {'xaxis': hidden, 'yaxis': hidden, 'annotations': [told]}}


# The data for the browsers.


class Made(NamedTuple):
    """A part of the page, and a version that identifies its content."""

    version: str
    content: Any


class Maker:
    """Makes texts and figures of units, each once for all browsers."""

    def __init__(self, shown: Shown, zone: tzinfo | None = None) -> None:
        self.shown, self.zone = shown, zone
        self._kept: dict[tuple[str, str], tuple[object, Made]] = {}
        self._boot = secrets.token_hex(4)

    @property
    def generation(self) -> str:
        """Return an identifier of units and process; if it changes, browsers reload the page."""
        return _digest(self._boot, *(unit.key for unit in self.shown.units))

    def parts(self, unit: Snapshot) -> dict[str, Made]:
        """Return every part of a unit by its name."""
        frame, day, zone = unit.frame, unit.day, self.zone
        live = (frame.now_ns, frame.last, frame.curve)

        def told() -> dict[str, Made]:
            return {name: Made(_digest(made), made) for name, made in words(unit, zone).items()}

        return dict(self._once(unit, 'words', (frame, unit.present), told).content) | {
            'curve': self._once(unit, 'curve', live, lambda: curve_picture(frame)),
            'recent': self._once(unit, 'recent', live[:2], lambda: recent_picture(frame, zone)),
            'day': self._once(unit, 'day', day[:1] + day[-1:], lambda: day_picture(unit, zone)),
        }

    def _once(self, unit: Snapshot, what: str, of: object, make: Callable[[], Any]) -> Made:
        """Return the cached result for the same input; two threads may compute it twice."""
        before = self._kept.get((unit.key, what))
        if before is not None and before[0] == of:
            return before[1]
        content = make()
        version = '' if what == 'words' else _digest(content)
        found = Made(version, content)
        if len(self._kept) > _MOST_KEPT:
            self._kept.clear()
        self._kept[unit.key, what] = (of, found)
        return found


_MOST_KEPT = 8 * MOST_UNITS


def _digest(*parts: object) -> str:
    return sha256(repr(parts).encode()).hexdigest()[:12]


# The page.

_CONFIG: Any = {
    'displaylogo': False, 'displayModeBar': 'hover', 'responsive': True,
    'plotlyServerURL': '', 'showSendToCloud': False,
    # A list of our own: the default one has a button that sends the data to a server.
    'modeBarButtons': [['toImage'], ['zoom2d', 'pan2d'], ['resetScale2d']],
    'toImageButtonOptions': {'format': 'svg'},
}  # fmt: skip
_CAPTIONS = {
    'curve': "Flow characteristic and today's operating point",
    'recent': 'Prediction against measurement, last 15 minutes',
    'day': 'The last 24 hours; drag the ends of the strip, or the picture, to scroll',
}


def _part(number: int, name: str, content: Any = None, kind: str = '') -> Any:
    return html.Div(content, id={'unit': number, 'part': name}, className=f'{name} {kind}'.strip())


def _picture(number: int, name: str) -> Any:
    graph = dcc.Graph(
        id={'unit': number, 'part': name}, config=_CONFIG,
        style={'height': f'{PICTURES[name]}px'},
    )  # fmt: skip
    return html.Figure([html.Figcaption(_CAPTIONS[name]), graph], className=name)


def _block(number: int, told: Mapping[str, Made], may_ask: bool) -> Any:
    buttons = [
        html.Button(label, id={'unit': number, 'ask': asked}, n_clicks=0)
        for asked, label in ASKED.items()
    ]
    ask = [html.Div([*buttons, _part(number, 'answer')], className='ask')] if may_ask else []

    def part(name: str, title: str = '') -> list[Any]:
        return [*([html.H3(title)] if title else []), _part(number, name, told[name].content)]

    return html.Section(html.Div([
        html.Div(part('head'), className='title'),
        html.Div(part('alarms', 'Alarms') + ask, className='top'),
        html.Div(
            [_picture(number, 'curve'), *part('curve_words'), _picture(number, 'recent'),
             *part('now')], className='pictures',
        ),
        html.Div(part('diagnosis', 'Diagnosis') + part('health', 'Inputs and recorder'),
                 className='words'),
        html.Div([_picture(number, 'day')], className='history'),
        dcc.Store(id={'unit': number, 'part': 'pictures'}),
    ], className='grid'), className='unit')  # fmt: skip


def _page(maker: Maker, may_ask: bool) -> Any:
    units = maker.shown.units
    blocks = [_block(k, maker.parts(unit), may_ask) for k, unit in enumerate(units)]
    # Without any part, Dash would not tick at all.
    nowhere = [_part(-1, name) for name in PARTS]
    blocks = blocks or [
        html.Div([*nowhere, dcc.Store(id={'unit': -1, 'part': 'pictures'})], hidden=True)
    ]
    token_field = [
        html.Label(['Token for the buttons: ', dcc.Input(id='token', type='password', value='')],
                   className='token'),
    ] if may_ask and units else []  # fmt: skip
    many = ' many' if len(units) > 1 else ''
    return html.Main([
        html.Header([html.H1('valveflow'), html.Div(id='lost', role='alert'), *token_field]),
        html.Div(maker.shown.note, id='note', className='notice' if maker.shown.note else ''),
        html.Div(blocks, className=f'units{many}'),
        html.Footer(
            f'Made by valveflow {__version__}. Clock and pictures are in {maker.zone or "UTC"}.'
        ),
        dcc.Interval(id='tick', interval=TICK_MS), dcc.Interval(id='pulse', interval=1000),
        dcc.Store(id='seen', data={'generation': maker.generation}),
    ], id='page')  # fmt: skip


class Asking:
    """Lets a browser with the token, which is not empty, send requests to a monitor.

    ``ask`` takes the key of a unit and one of `ASKED`; it returns success and a sentence.
    """

    def __init__(self, token: str, ask: Ask) -> None:
        self._token = _bytes(token)
        self._ask = ask
        self._lock = threading.Lock()
        self._wrong = 0
        self._until_s = 0.0

    def __call__(self, unit: str, asked: str, token: str) -> tuple[bool, str]:
        """Return success and a sentence; one request at a time, and few wrong tokens."""
        if asked not in ASKED:
            return False, 'That cannot be asked from here.'
        if not self._lock.acquire(blocking=False):
            return False, 'Another request is being answered; try again.'
        try:
            if time.monotonic() < self._until_s:
                return False, f'Too many wrong tokens; wait {_WAIT_S:.0f} s.'
            if not hmac.compare_digest(_bytes(token), self._token):
                self._wrong += 1
                if self._wrong >= _TRIES:
                    self._wrong, self._until_s = 0, time.monotonic() + _WAIT_S
                return False, 'The token is not the right one.'
            self._wrong = 0
            return self._ask(unit, asked)
        finally:
            self._lock.release()


def _bytes(token: str) -> bytes:
    # A browser may send values that are not strings.
    return token.encode(errors='backslashreplace')


def make_app(
    shown: Shown, asking: Asking | None = None, zone: tzinfo | None = None
) -> tuple[Dash, str]:
    """Return the page as a Dash application, and its content security policy.

    The content is replaced by another thread; without ``asking`` the page has no buttons.
    """
    maker = Maker(shown, zone)
    script = read_text('colours.js') + _file('page.js')
    app = Dash(
        'valveflow_page', title='valveflow', update_title='', assets_folder='no_assets',
        suppress_callback_exceptions=True, index_string=_index(script), compress=False,
        meta_tags=[
            {'name': 'viewport', 'content': 'width=device-width, initial-scale=1'},
            {'name': 'color-scheme', 'content': 'light dark'},
        ],
    )  # fmt: skip
    app.layout = lambda: _page(maker, asking is not None)
    _update(app, maker)
    if asking is not None:
        _answer(app, shown, asking)
    own = b64encode(sha256(script.encode()).digest()).decode()
    inline = [*app.csp_hashes(), f"'sha256-{own}'"]
    return app, (
        f"default-src 'self'; script-src 'self' {' '.join(inline)}; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'none'; object-src 'none'"
    )


def _file(name: str) -> str:
    return resources.files('valveflow_ros.page').joinpath(name).read_text(encoding='utf-8')


def _index(script: str) -> str:
    return (
        '<!DOCTYPE html>\n<html lang="en"><head>{%metas%}<title>{%title%}</title>'
        '<link rel="icon" href="data:,">{%css%}'
        f'<style>{read_text("style.css")}{_file("page.css")}</style></head>'
        f'<body>{{%app_entry%}}{{%config%}}{{%scripts%}}<script>{script}</script>{{%renderer%}}'
        '</body></html>'
    )


def _update(app: Dash, maker: Maker) -> None:
    everything = (*PARTS, 'pictures')

    @app.callback(  # type: ignore[untyped-decorator]
        *(Output({'unit': ALL, 'part': name}, 'children') for name in PARTS),
        Output({'unit': ALL, 'part': 'pictures'}, 'data'),
        Output('note', 'children'), Output('note', 'className'), Output('seen', 'data'),
        Input('tick', 'n_intervals'), State('seen', 'data'),
        State({'unit': ALL, 'part': 'pictures'}, 'id'),
    )  # fmt: skip
    def tick(number: Any, seen: Any, ids: Any) -> Any:
        units, note, generation = maker.shown.units, maker.shown.note, maker.generation
        told = seen if isinstance(seen, dict) else {}
        versions: dict[str, Any] = {'generation': generation, 'tick': number}
        out: dict[str, list[Any]] = {name: [no_update] * len(ids) for name in everything}
        known = told.get('generation') == generation and len(ids) == len(units)
        for k, unit in enumerate(units if known else ()):
            before = told.get(str(k))
            before = before if isinstance(before, dict) else {}
            made = maker.parts(unit)
            new = {name for name, part in made.items() if before.get(name) != part.version}
            for name in new.intersection(PARTS):
                out[name][k] = made[name].content
            drawn = {name: made[name].content for name in new.intersection(PICTURES)}
            if drawn:
                out['pictures'][k] = drawn
            versions[str(k)] = {name: part.version for name, part in made.items()}
        return (
            *(out[name] for name in everything), note, 'notice' if note else '', versions,
        )  # fmt: skip

    for name in PICTURES:
        app.clientside_callback(  # type: ignore[no-untyped-call]
            f"function(made) {{ return valveflow.picture(made, '{name}'); }}",
            Output({'unit': MATCH, 'part': name}, 'figure'),
            Input({'unit': MATCH, 'part': 'pictures'}, 'data'),
        )
    app.clientside_callback(  # type: ignore[no-untyped-call]
        'function(pulse, seen) { return valveflow.pulse(seen); }',
        Output('lost', 'children'), Input('pulse', 'n_intervals'), Input('seen', 'data'),
    )  # fmt: skip


def _answer(app: Dash, shown: Shown, asking: Asking) -> None:
    @app.callback(  # type: ignore[untyped-decorator]
        Output({'unit': ALL, 'part': 'answer'}, 'children'),
        Input({'unit': ALL, 'ask': ALL}, 'n_clicks'), State('token', 'value'),
        State({'unit': ALL, 'part': 'answer'}, 'id'),
        prevent_initial_call=True,
    )  # fmt: skip
    def answer(_: Any, token: Any, ids: Any) -> Any:
        chosen, units = ctx.triggered_id, shown.units
        out: list[Any] = [no_update] * len(ids)
        pressed = any(entry.get('value') for entry in ctx.triggered)
        number = chosen.get('unit') if isinstance(chosen, dict) else None
        if pressed and isinstance(number, int) and 0 <= number < min(len(units), len(out)):
            done, text = asking(units[number].key, str(chosen.get('ask')), str(token or ''))
            out[number] = html.P(clean(text), className='good' if done else 'bad')
        return out
