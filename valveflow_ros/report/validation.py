# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The report of a validation: whether the curve is still valid, and where it is not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from valveflow_ros.baselines.judged import JudgedSegment
from valveflow_ros.baselines.validation import OTHER, PieceCheck, Validation, Verdict
from valveflow_ros.fit.result import weaknesses
from valveflow_ros.records import SegmentKind
from valveflow_ros.report import figure as plot
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.answer import misfit_words
from valveflow_ros.report.figure import DAY_HOUR, Figure, Spec
from valveflow_ros.report.page import Cells, Page
from valveflow_ros.segments.window import WindowContents

LABELS = {
    'curve': 'curve',
    'simulated': 'curve and dynamics, simulated',
    'against.curve': 'the other, curve',
    'against.simulated': 'the other, simulated',
}
OUTSIDE_FLAG = 0.05  # fraction of special samples outside the curve that causes a warning
_KINDS = (
    (SegmentKind.STEADY, 'steady', 'steady state'), (SegmentKind.SLOPE, 'slope', 'slope response'),
)  # fmt: skip
_DIFFERENCE = 'measured − predicted (MW)'


@dataclass(frozen=True, slots=True)
class Validated:
    """A validation and its sources."""

    source: str  # name of the log
    model: str
    other: str  # the second model; empty without one
    result: Validation
    contents: WindowContents
    notes: tuple[str, ...] = ()
    held: str = ''  # a sentence about causes that were removed


def verdict_words(data: Validated) -> list[str]:
    """Return the verdict as sentences."""
    v, j = data.result, data.result.judgement
    steady, slope = (len(j.kinds(kind)) for kind, _, _ in _KINDS)
    each, _ = j.passed(v.judged_by, as_paper=True)
    worth, tested = j.passed(v.judged_by, as_paper=False)
    told = [
        _verdict(v),
        f'{say.counted(steady, "steady-state segment")} and '
        f'{say.counted(slope, "slope-response segment")} were judged; mean squared error '
        f'{say.plain(j.mse(v.judged_by))} MW². In {worth} of the {tested} segments that can be '
        'tested the mean difference is within its error (one independent value per '
        f'{say.duration(j.widening * v.trial.step_s)}); in {each} if each sample is counted as '
        'independent, as the paper does.',
    ]
    if v.gain is not None:
        theirs = OTHER + ('simulated' if OTHER + 'simulated' in v.predictions else 'curve')
        better = f'{data.model if v.gain.mean > 0.0 else data.other} is better.'
        told.append(
            f'{data.other} has a mean squared error of {say.plain(j.mse(theirs))} MW² there, '
            f'against {say.plain(j.mse(v.judged_by))} MW² of {data.model}: '
            + (better if v.gain.zero_is_rejected() else 'the two cannot be distinguished.')
        )
    if v.outside_share > OUTSIDE_FLAG:
        told.append(
            f'{say.percent(v.outside_share, 2)} of the special samples lie beyond the ends of the '
            'curve, where nothing is known; they were not judged.'
        )
    place = v.characteristic.place_words
    if blind := [place(c.u_from, c.u_to) for c in v.pieces if not c.segments]:
        told.append(f'No special segment lies at {", ".join(blind)}: nothing is said of that.')
    return [*told, *weaknesses(v.characteristic)]


def _verdict(v: Validation) -> str:
    def differs(check: PieceCheck) -> str:
        whole = check is v.overall
        where = '' if whole else f'at {place(check.u_from, check.u_to)} '
        return (
            f'{where}the measured power differs by {say.signed(check.test.mean, 2)} MW'
            f'{" (mean over the loads seen)" if whole else ""} from what it predicts '
            f'({say.interval(check.low_mw, check.high_mw)} MW with 95 % confidence)'
        )

    tolerance, place = f'{v.tolerance_mw:.3g} MW', v.characteristic.place_words
    mean = differs(v.overall)
    if v.verdict is Verdict.HOLDS:
        return (
            f'The characteristic is valid: {mean}, and within {tolerance} on each piece, with '
            '95 % confidence.'
        )
    if v.misfit_beyond:
        return (
            f'The characteristic is off by {misfit_words(v.misfit_beyond)}; the tolerance '
            f'is {tolerance}. {mean[0].upper()}{mean[1:]}.'
        )
    if v.verdict is Verdict.OFF:
        off = [c for c in (v.overall, *v.pieces) if c.beyond(v.tolerance_mw)]
        worst = max(off, key=lambda c: abs(c.test.mean))
        return (
            f'The characteristic is off: {differs(worst)}, more than the tolerance of {tolerance}.'
        )
    real = '; the difference is real' if v.overall.test.zero_is_rejected() else ''
    which = 'For the mean over the loads seen'
    # The pieces without a clear result.
    if unsettled := [
        str(k) for k, c in enumerate(v.pieces, 1) if c.segments and not c.within(v.tolerance_mw)
    ]:
        *most, last = unsettled
        which = f'For pieces {", ".join(most)} and {last}' if most else f'For piece {last}'
    size = math.sqrt(v.judgement.mse(v.judged_by))
    return (
        f'The measured power differs from the prediction by {say.plain(size, 2)} MW (root mean '
        f'square); it cannot be decided whether the characteristic is valid: {mean}{real}. '
        f'{which} it cannot be decided whether the difference is within {tolerance} or beyond. A '
        'longer log, with every load in it, would help.'
    )


def validation_page(data: Validated) -> Page:
    """Return the report: the verdict and its basis first, then the evidence."""
    v = data.result
    first, *rest = verdict_words(data)
    flag = v.outside_share > OUTSIDE_FLAG
    sections = [
        html.section(
            'The verdict',
            html.paragraph(html.text(first), 'answer'),
            *((html.notice if flag and 'beyond the ends' in s else html.paragraph)(html.text(s))
              for s in rest),
            html.notice(html.text(data.held)) if data.held else None, input_figure(v),
            html.table(*pieces_cells(v)),
        ),
        html.section('When it differs', time_figure(v)),
        html.section('Predictions', html.table(*totals_cells(v)), segments_table(v)),
    ]  # fmt: skip
    if data.notes:
        notes = html.bullets(map(html.text, data.notes))
        sections.append(html.section('How the data were read', notes))
    end = html.foot(
        f'Curve <code>{html.text(v.characteristic.model_id)}</code>; the same numbers, unrounded, '
        'stand in validation.json and segments.csv.'
    )
    times = data.contents.time_ns
    compared = f'{data.model}, compared with {data.source}'
    lead = html.where(compared, say.period(times[0], times[-1]))
    return Page('Does the flow characteristic hold?', lead, sections, end, 'validate')


def _markers(v: Validation, by_time: bool) -> list[Spec]:
    traces = []
    for kind, colour, name in _KINDS:
        mine = v.judgement.kinds(kind)
        means = [s.scores[v.judged_by].samples.mean for s in mine]
        x: Any = plot.rounded([float(v.trial.u[s.rows].mean()) for s in mine], 6)
        if by_time:
            x = plot.packed(np.array([0.5 * (s.start_ns + s.end_ns) / 1e6 for s in mine]))
        at = DAY_HOUR if by_time else 'u %{x:.0f}<br>'
        traces.append(plot.points(
            x, plot.rounded(means, 4), name, colour, f'{at}%{{y:+.2f}} MW<extra>{name}</extra>',
            marker={'opacity': 0.75},
        ))  # fmt: skip
    return traces


def _layout(v: Validation, across: Spec) -> Spec:
    tolerance = {
        'type': 'rect', 'xref': 'paper', 'yref': 'y', 'x0': 0, 'x1': 1, 'layer': 'below',
        'y0': -v.tolerance_mw, 'y1': v.tolerance_mw, 'line': {'width': 0},
        'fillcolor': plot.token('density-0'), 'opacity': 0.6,
    }  # fmt: skip
    return {'xaxis': across, 'yaxis': plot.axis(_DIFFERENCE), 'shapes': [tolerance],
            'showlegend': True}  # fmt: skip


def input_figure(v: Validation) -> Figure:
    """Return the mean difference of each segment over its input."""
    checks = [c for c in v.pieces if c.segments]
    x = [u for c in checks for u in (c.u_from, c.u_to, math.nan)]
    y = [mw for c in checks for mw in (c.test.mean, c.test.mean, math.nan)]
    traces = [
        *_markers(v, by_time=False),
        plot.line(plot.rounded(x, 6), plot.rounded(y, 4), 'mean of each piece', 'curve',
             '%{y:+.2f} MW<extra>mean of the piece</extra>', width=2.4),
    ]  # fmt: skip
    caption = (
        '<b>The points should scatter about zero at every u.</b> Each is the mean of a special '
        f'segment; the band is ± {v.tolerance_mw:.3g} MW.'
    )
    layout = _layout(v, plot.axis(say.input_axis(v.characteristic.pressure_exponent)))
    return Figure('by-input', caption, 'Mean difference by input.', traces, layout, 400)


def time_figure(v: Validation) -> Figure:
    """Return the mean difference of each segment over time."""
    caption = '<b>A step or a drift here is a change of the plant.</b> The same points over time.'
    traces, layout = _markers(v, by_time=True), _layout(v, plot.time_axis())
    return Figure('by-time', caption, 'Mean difference over time.', traces, layout, 340)


def pieces_cells(v: Validation) -> Cells:
    """Return head and cells of the mean difference overall and on each piece."""
    rows = [
        [
            f'piece {k}' if k else 'all', say.span(check.u_from, check.u_to), str(check.segments),
            say.signed(check.test.mean, 2) if math.isfinite(check.test.mean) else '–',
            say.interval(check.low_mw, check.high_mw),
            say.decimals(check.test.effective, 0) if check.segments else '–',
        ]
        for k, check in enumerate((v.overall, *v.pieces))
    ]  # fmt: skip
    head = [
        '', f'u ({say.input_unit_plain(v.characteristic.pressure_exponent)})', 'segments',
        _DIFFERENCE, '95 % (MW)', 'independent segments',
    ]  # fmt: skip
    return head, rows


def totals_cells(v: Validation) -> Cells:
    """Return head and cells of the mean squared errors by kind of segment."""
    j, kinds = v.judgement, (None, SegmentKind.STEADY, SegmentKind.SLOPE)
    rows = [
        [
            LABELS[name],
            *(say.plain(j.mse(name, k)) if j.kinds(k) else '–' for k in kinds),
        ]
        for name in v.predictions
    ]
    return ['mean squared error of', 'all (MW²)', 'steady (MW²)', 'slope (MW²)'], rows


def segments_table(v: Validation, most: int = 40) -> str:
    """Return the segments with the largest differences."""

    def size(s: JudgedSegment) -> float:
        t = s.scores[v.judged_by].effective.t
        return abs(t) if math.isfinite(t) else 0.0

    rows = []
    for s in sorted(v.judgement.segments, key=size, reverse=True)[:most]:
        score = s.scores[v.judged_by]
        rows.append([
            f'{s.kind.name.lower()} {s.number}', say.moment(s.start_ns)[:16], str(len(s.rows)),
            say.decimals(s.power_mw, 0), say.plain(score.mse_mw2),
            say.signed(score.samples.mean, 2), say.plain(score.samples.t, 2),
            say.plain(score.effective.t, 2), say.decimals(score.effective.effective, 1),
        ])  # fmt: skip
    head = [
        'segment', 'from', 'samples', 'MW', 'mean squared error (MW²)', _DIFFERENCE,
        't, each sample', 't, correlation counted', 'independent values',
    ]  # fmt: skip
    many = say.counted(len(rows), 'segment')
    which = f'The {many} that differ most' if len(rows) < len(v.judgement.segments) else many
    words = 'All segments are in segments.csv, those that differ most first here.'
    return html.paragraph(words) + html.folded(which, html.table(head, rows))
