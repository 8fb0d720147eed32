# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pages of a fleet: which units lose power, since when and why; one page per unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import quote

import numpy as np

from valveflow_ros.report import figure as plot
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.figure import Figure
from valveflow_ros.report.history import CurveMoment, History, curve_history_figure
from valveflow_ros.report.page import Page, Section
from valveflow_ros.report.words import VERDICT_WORDS

UNITS, REPORT = 'units', 'report.html'
_VERBS = ('identify', 'diagnose', 'monitor')
# Limits of the overview: histories, and rows of failures; the page of a unit has its own.
_HISTORIES, _FAILURES = 10, 200
_UNIT_PX = 18
Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class UnitStory:
    """The summary of a unit for the overview."""

    unit: str
    logs: int
    failed: int  # logs without a result
    output_unit: str
    moved: bool  # the last curve differs significantly from the first one
    change_mw: float | None  # mean over the range of both; None if there are not two curves
    piece: str  # that with the largest change, in words
    since: str  # the begin of the change, in words
    causes: tuple[str, ...]  # named since the change, in the order found
    alarms: tuple[str, ...]  # that stand at the end of the last log
    changes: tuple[tuple[int, float], ...]  # begin of each log (ns) and its change in MW
    failures: tuple[tuple[str, str], ...]  # log and sentence, also of incomplete results
    history: History  # the curves

    def to_json(self) -> dict[str, Any]:
        """Return the summary as a dict of plain values."""
        names = ('unit', 'logs', 'failed', 'output_unit', 'moved', 'change_mw', 'piece', 'since')
        plain = {name: getattr(self, name) for name in names}
        return plain | {'causes': list(self.causes), 'alarms': list(self.alarms)}


def story_of(unit: str, rows: Sequence[Row]) -> UnitStory:
    """Return the summary of a unit from the rows of its logs, in order of time."""
    curves = [row for row in rows if row.get('curve')]
    last = curves[-1] if curves else {}
    # The change began in the first of the last consecutive logs that all show it.
    changed: list[Row] = []
    for row in reversed(curves):
        if not row.get('change_moved') or (row['change_mw'] < 0.0) != (last['change_mw'] < 0.0):
            break
        changed.insert(0, row)
    named = dict.fromkeys(c['name'] for row in changed for c in row.get('causes') or ())
    judged = [row for row in rows if row.get('alarms') is not None]
    alarms = [a['name'] for row in judged[-1:] for a in row['alarms'] if a['cleared'] is None]
    failures = [(row['log'], ' '.join(row['sentences'])) for row in rows if row['sentences']]
    piece = _moved(last, 'change') if changed else ''
    changes = [
        (row['start'], row['change_mean_mw']) for row in curves
        if row.get('change_mean_mw') is not None
    ]  # fmt: skip
    if curves:
        changes.insert(0, (curves[0]['start'], 0.0))
    return UnitStory(
        unit, len(rows), sum(row['status'] == 'failed' for row in rows),
        last.get('output_unit', 'MW'), bool(changed),
        last.get('change_mean_mw'), piece, _since(changed[0]) if changed else '', tuple(named),
        tuple(dict.fromkeys(alarms)), tuple(changes), tuple(failures), _history(curves),
    )  # fmt: skip


def _since(row: Row) -> str:
    """Return when the change began: from the diagnosis, the segments, or the start of the log.

    The onset of a cause is fitted to every row, and is more accurate than that of a shift found
    from segments. It is ignored outside the interval of the shift: it may be of another change.
    """
    low, high = (row.get(f'shift_since_{end}') for end in ('low', 'high'))
    dated: list[tuple[Row, str]] = [
        (cause, 'onset') for cause in row.get('causes') or ()
        if not (low and high and cause.get('onset')) or low <= cause['onset'] <= high
    ]  # fmt: skip
    dated += [(row, f'{name}_since') for name in ('shift', 'change')]
    for of, name in dated:
        if of.get(name):
            ends = [of.get(f'{name}_{end}') for end in ('low', 'high')]
            between = ' to '.join(say.moment(e)[:16] for e in ends if e)
            told = f'{say.moment(of[name])[:16]} UTC'
            return f'{told} (95 %: {between})' if all(ends) else told
    return f'before {say.moment(row["start"])[:16]} UTC'


def _history(curves: Sequence[Row]) -> History:
    found = []
    for row in curves:
        u, power, low, high = (
            np.array(row[k], dtype=np.float64)
            for k in ('u', 'power_mw', 'breakpoint_low', 'breakpoint_high')
        )
        m, error = row['pressure_exponent'], row['rmse_mw']
        found.append(CurveMoment(row['end'], row['model_id'], m, u, power, low, high, error))
    return History(
        curves[0]['start'] if curves else 0, curves[-1]['end'] if curves else 0, tuple(found)
    )


def _link(words: str, *parts: str) -> str:
    return f'<a href="{"/".join(quote(p, safe="") for p in parts)}">{words}</a>'


def fleet_page(stories: Sequence[UnitStory]) -> Page:
    """Return the overview of all units."""
    ordered = sorted(stories, key=lambda s: (not s.moved, s.change_mw or 0.0, s.unit))
    moved = [s for s in ordered if s.moved]
    less = [s for s in moved if (s.change_mw or 0.0) < 0.0]
    logs, failed = sum(s.logs for s in stories), sum(s.failed for s in stories)
    told = f'{say.counted(len(stories), "unit")}, {say.counted(logs, "log")}'
    told += f', {say.counted(failed, "log")} without a result.' if failed else '.'
    alone = sum(s.change_mw is None for s in stories)
    answer = (
        f'{say.counted(len(less), "unit gives", "units give")} less power than in the first log, '
        f'{say.counted(len(moved) - len(less), "unit gives", "units give")} more; '
        f'{say.counted(len(stories) - len(moved) - alone, "shows", "show")} no change'
    )
    answer += f', and {alone} cannot be judged yet, for want of a second curve.' if alone else '.'
    sections = [Section('Which units lose power', [html.paragraph(answer), _units_table(ordered)])]
    if any(len(s.changes) > 1 for s in stories):
        sections.append(Section('When they changed', [changes_figure(ordered)]))
    shown = [s for s in moved if len(s.history.curves) > 1][:_HISTORIES]
    for k, story in enumerate(shown):
        figure = curve_history_figure(story.history)
        sections.append(Section(f'The curves of {story.unit}', [
            replace(figure, name=f'history-{k + 1}'),
            html.paragraph(_link('All logs and reports of this unit', UNITS, story.unit, REPORT)),
        ]))  # fmt: skip
    troubles = [
        [html.text(s.unit), html.text(log), html.text(why)]
        for s in stories
        for log, why in s.failures
    ]
    if troubles:
        more = len(troubles) - _FAILURES
        sections.append(Section('What could not be done', [
            html.table(['unit', 'log', 'why'], troubles[:_FAILURES], sentences=True),
            html.paragraph(f'{more} more are in fleet.parquet.') if more > 0 else '',
        ]))  # fmt: skip
    return Page(
        'The fleet', html.where(told), sections,
        html.foot('One row a log stands in fleet.parquet beside this page.'), 'fleet',
    )  # fmt: skip


def _units_table(stories: Sequence[UnitStory]) -> str:
    rows = [
        [
            _link(html.text(s.unit), UNITS, s.unit, REPORT),
            'not known' if s.change_mw is None else f'{say.signed(s.change_mw)} {s.output_unit}',
            html.text(s.piece) or ('not compared' if s.change_mw is None else 'no change seen'),
            html.text(s.since) or '-',
            (html.text(', '.join(s.causes)) or 'not named') if s.moved else '-',
            html.text(', '.join(s.alarms)) or '-',
            f'{s.logs - s.failed} of {s.logs}',
        ]
        for s in stories
    ]
    head = ['unit', 'change, mean', 'piece that changed most', 'since',
            'causes named since then (perhaps only a part)', 'alarms at the end',
            'logs done']  # fmt: skip
    return html.table(head, rows, sentences=True)


def changes_figure(stories: Sequence[UnitStory]) -> Figure:
    """Return the change of each unit relative to its first curve, one row per unit."""
    shown = [s for s in stories if s.changes]
    starts = [np.array([t for t, _ in s.changes], dtype=np.float64) / 1e6 for s in shown]
    steps = [np.ptp(t) / (len(t) - 1) for t in starts if len(t) > 1 and np.ptp(t) > 0.0]
    step = float(np.median(steps)) if steps else 86400e3
    begin = min(float(t[0]) for t in starts)
    columns = 1 + max(round((float(t[-1]) - begin) / step) for t in starts)
    z = np.full((len(shown), columns), np.nan)
    for k, (story, at) in enumerate(zip(shown, starts, strict=True)):
        z[k, np.round((at - begin) / step).astype(int)] = [c for _, c in story.changes]
    largest = max(float(np.nanmax(np.abs(z))), 1e-9)
    unit = shown[0].output_unit
    trace = {
        'type': 'heatmap', 'name': 'change', 'x': plot.moments(begin + step * np.arange(columns)),
        'y': [html.text(s.unit) for s in shown], 'z': [plot.rounded(row, 3) for row in z],
        'zmin': -largest, 'zmax': largest, 'zmid': 0.0, 'colorscale': 'RdBu', 'ygap': 2,
        'reversescale': True,
        'colorbar': {'title': {'text': unit}},
        'hovertemplate': f'%{{y}}, %{{x|%d %b %Y}}<br>%{{z:+.2f}} {unit}<extra></extra>',
    }  # fmt: skip
    layout = {
        'xaxis': plot.time_axis(), 'yaxis': {'type': 'category', 'autorange': 'reversed'},
    }  # fmt: skip
    caption = (
        '<b>Red: less power than the first curve of the unit gave at the same openings and '
        'pressures. Blue: more.</b> Mean over what both curves know; a row in one colour to its '
        'end is a lasting change. Units are in the order of the table above. Where there is no '
        'colour there is no curve.'
    )
    words = f'Change against the first curve of {say.counted(len(shown), "unit")} over time.'
    height = 140 + _UNIT_PX * max(len(shown), 4)
    return Figure('changes', caption, words, [trace], layout, height=height)


def unit_page(unit: str, rows: Sequence[Row]) -> Page:
    """Return the page of one unit, with links to the reports of its logs."""
    story = story_of(unit, rows)
    done = f'{say.counted(story.logs, "log")}, {story.failed} without a result.'
    answer = 'No change against the first curve is seen.'
    if story.change_mw is None:
        answer = 'There is no second curve yet to tell a change by.'
    if story.moved:
        named = f'Causes named: {", ".join(story.causes)}.' if story.causes else 'No cause named.'
        answer = f'{story.piece}, since {story.since}. {named}'
    sections = [Section('Has it changed', [html.paragraph(html.text(answer))])]
    if len(story.history.curves) > 1:
        sections[0].parts.append(curve_history_figure(story.history))
    head = ['log', 'from', 'against the log before', 'diagnosis', 'alarms', 'reports']
    sections.append(Section('Log by log', [
        html.table(head, [_log_cells(row) for row in rows], sentences=True),
    ]))  # fmt: skip
    said = [
        f'<b>{html.text(row["log"])}</b>: {html.text(c["sentence"])} {html.text(c["meaning"])}'
        for row in rows for c in row.get('causes') or ()
    ]  # fmt: skip
    if said:
        sections.append(Section('Causes that were named', [html.bullets(said)]))
    back = '<a href="../../fleet.html">All units</a>.'
    return Page(f'Unit {unit}', html.where(done), sections, html.foot(back), 'fleet')


def _log_cells(row: Row) -> list[str]:
    diagnosis = VERDICT_WORDS[row['verdict']] if row.get('verdict') else '-'
    if names := [c['name'] for c in row.get('causes') or ()]:
        diagnosis = ', '.join(names)
    alarms = ', '.join(dict.fromkeys(a['name'] for a in row.get('alarms') or ()))
    done = {'identify': 'curve', 'diagnose': 'verdict', 'monitor': 'monitor_curves'}
    links = [
        _link(verb, row['log'], verb, REPORT) for verb in _VERBS if row.get(done[verb]) is not None
    ]
    moved = 'no curve before it' if row.get('shift_moved') is None else 'no change seen'
    if row.get('shift_moved'):
        moved = _moved(row, 'shift')
    return [
        html.text(row['log']), say.moment(row['start'])[:16] if row.get('start') else '-',
        html.text(' '.join(row['sentences']) or moved), html.text(diagnosis),
        html.text(alarms) or '-', ' '.join(links) or '-',
    ]  # fmt: skip


def _moved(row: Row, name: str) -> str:
    low, high = row[f'{name}_u_from'], row[f'{name}_u_to']
    return f'{say.signed(row[f"{name}_mw"])} {row["output_unit"]} at u {low:.0f} to {high:.0f}'
