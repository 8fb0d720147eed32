"""The report of a validation: does the curve hold, and where not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros import __version__
from valveflow_ros.baselines.judged import JudgedSegment
from valveflow_ros.baselines.validation import OTHER, PieceCheck, Validation, Verdict
from valveflow_ros.records import SegmentKind
from valveflow_ros.report.figure import Figure, Spec, packed, rounded, token
from valveflow_ros.report.page import Page, Section, folded, notice, paragraph, table, text
from valveflow_ros.report.words import (
    counted,
    decimals,
    duration,
    input_axis,
    input_unit,
    interval,
    moment,
    percent,
    plain,
)
from valveflow_ros.segments.window import WindowContents

# Where and when measured and predicted power differ.


def _markers(v: Validation, by_time: bool) -> list[Spec]:
    traces: list[Spec] = []
    looks = ((SegmentKind.STEADY, 'steady', 'steady state'),
             (SegmentKind.SLOPE, 'slope', 'slope response'))  # fmt: skip
    at = '%{x|%d %b %H:%M}' if by_time else 'u %{x:.0f}'
    for kind, colour, name in looks:
        mine = v.judgement.kinds(kind)
        if by_time:
            x: object = packed(np.array([0.5 * (s.start_ns + s.end_ns) / 1e6 for s in mine]))
        else:
            x = rounded(np.array([v.trial.u[s.rows].mean() for s in mine]), 6)
        means = np.array([s.scores[v.judged_by].samples.mean for s in mine])
        traces.append(
            {
                'type': 'scatter', 'mode': 'markers', 'name': name, 'x': x,
                'y': rounded(means, 4),
                'marker': {'color': token(colour), 'size': 6, 'opacity': 0.75},
                'hovertemplate': f'{at}<br>%{{y:+.2f}} MW<extra>{name}</extra>',
            }
        )  # fmt: skip
    return traces


def _tolerance(v: Validation) -> list[Spec]:
    return [
        {
            'type': 'rect', 'xref': 'paper', 'yref': 'y', 'x0': 0, 'x1': 1, 'layer': 'below',
            'y0': -v.tolerance_mw, 'y1': v.tolerance_mw, 'line': {'width': 0},
            'fillcolor': token('density-0'), 'opacity': 0.6,
        }
    ]  # fmt: skip


def input_figure(v: Validation) -> Figure:
    """Return the mean difference of each segment over its input."""
    checks = [c for c in v.pieces if c.segments]
    x, y = [], []
    for c in checks:
        x += [c.u_from, c.u_to, math.nan]
        y += [c.test.mean, c.test.mean, math.nan]
    traces: list[Spec] = [
        *_markers(v, by_time=False),
        {
            'type': 'scatter', 'mode': 'lines', 'name': 'mean of each piece', 'x': rounded(
                np.array(x), 6
            ), 'y': rounded(np.array(y), 4), 'line': {'color': token('curve'), 'width': 2.4},
            'hovertemplate': '%{y:+.2f} MW<extra>mean of the piece</extra>',
        },
    ]  # fmt: skip
    layout = {
        'xaxis': {'title': input_axis(v.characteristic.pressure_exponent)},
        'yaxis': {'title': {'text': 'measured − predicted (MW)'}},
        'shapes': _tolerance(v), 'showlegend': True,
    }  # fmt: skip
    caption = (
        '<b>The points should scatter about zero at every u.</b> Each is the mean of a special '
        f'segment; the band is ± {v.tolerance_mw:.3g} MW.'
    )
    return Figure('by-input', caption, 'Mean difference by input.', traces, layout, 400)


def time_figure(v: Validation) -> Figure:
    """Return the mean difference of each segment over time."""
    layout = {
        'xaxis': {'type': 'date', 'title': {'text': 'time (UTC)'}},
        'yaxis': {'title': {'text': 'measured − predicted (MW)'}},
        'shapes': _tolerance(v), 'showlegend': True,
    }  # fmt: skip
    caption = '<b>A step or a drift here is a change of the plant.</b> The same points over time.'
    return Figure(
        'by-time', caption, 'Mean difference over time.', _markers(v, by_time=True), layout, 340
    )


LABELS = {
    'curve': 'curve',
    'simulated': 'curve and dynamics, simulated',
    'against.curve': 'the other, curve',
    'against.simulated': 'the other, simulated',
}
OUTSIDE_FLAG = 0.05  # share of special samples beyond the curve that is worth a warning


@dataclass(frozen=True, slots=True)
class Validated:
    """A validation and where it came from.

    Attributes
    ----------
    source, model, other : str
        Names of log and models; ``other`` is empty without one.
    result : Validation
    contents : WindowContents
    notes : tuple of str
    held : str
        What there is to say of causes held; empty without any.
    """

    source: str
    model: str
    other: str
    result: Validation
    contents: WindowContents
    notes: tuple[str, ...] = ()
    held: str = ''


def verdict_words(data: Validated) -> list[str]:
    """Return the verdict as sentences."""
    v = data.result
    told = [_verdict(v), _counted(v)]
    if v.gain is not None:
        told.append(_gain(data))
    if v.outside_share > OUTSIDE_FLAG:
        told.append(
            f'{percent(v.outside_share, 2)} of the special samples lie beyond the ends of the '
            'curve, where nothing is known; they were not judged.'
        )
    blind = [c for c in v.pieces if not c.segments]
    if blind:
        ranges = ', '.join(f'{decimals(c.u_from, 0)} to {decimals(c.u_to, 0)}' for c in blind)
        told.append(f'No special segment lies at u from {ranges}: nothing is said of that.')
    return told


def _verdict(v: Validation) -> str:
    tolerance = f'{v.tolerance_mw:.3g} MW'
    mean = (
        f'over all segments the power is {_signed(v.overall.test.mean)} MW from what it predicts '
        f'({interval(v.overall.low_mw, v.overall.high_mw)} MW with 95 % confidence)'
    )
    if v.verdict is Verdict.HOLDS:
        return f'The characteristic holds: {mean}, and on each piece surely within {tolerance}.'
    if v.verdict is Verdict.OFF:
        off = [c for c in (v.overall, *v.pieces) if _beyond(c, v.tolerance_mw)]
        worst = max(off, key=lambda c: abs(c.test.mean))
        return (
            f'The characteristic is off: at u from {decimals(worst.u_from, 0)} to '
            f'{decimals(worst.u_to, 0)} the power is {_signed(worst.test.mean)} MW from what it '
            f'predicts ({interval(worst.low_mw, worst.high_mw)} MW with 95 % confidence), more '
            f'than the {tolerance} that are let pass.'
        )
    real = '; the difference is real' if v.overall.test.zero_is_rejected() else ''
    return (
        f'Whether the characteristic holds stays open: {mean}{real}. {_unsettled(v)} it cannot be '
        f'told whether the difference is within {tolerance} or beyond. A longer log, with every '
        'load in it, would help.'
    )


def _unsettled(v: Validation) -> str:
    """Name the pieces that leave the verdict open."""
    open_ones = [
        str(k) for k, c in enumerate(v.pieces, 1) if c.segments and not _within(c, v.tolerance_mw)
    ]
    if not open_ones:
        return 'For the mean over all segments'
    *most, last = open_ones
    return f'For pieces {", ".join(most)} and {last}' if most else f'For piece {last}'


def _within(check: PieceCheck, tolerance_mw: float) -> bool:
    return -tolerance_mw <= check.low_mw and check.high_mw <= tolerance_mw


def _beyond(check: PieceCheck, tolerance_mw: float) -> bool:
    return check.low_mw > tolerance_mw or check.high_mw < -tolerance_mw


def _signed(value: float) -> str:
    return ('+' if value > 0.0 else '') + decimals(value, 2)


def _counted(v: Validation) -> str:
    j = v.judgement
    steady, slope = (len(j.kinds(k)) for k in (SegmentKind.STEADY, SegmentKind.SLOPE))
    each, _ = j.passed(v.judged_by, as_paper=True)
    worth, tested = j.passed(v.judged_by, as_paper=False)
    return (
        f'{counted(steady, "steady-state segment")} and '
        f'{counted(slope, "slope-response segment")} were judged; mean squared error '
        f'{plain(j.mse(v.judged_by))} MW². A mean difference of zero stands in {worth} of '
        f'{tested} segments (one independent value takes '
        f'{duration(j.widening * v.trial.step_s)}), and in {each} if each sample is counted, '
        'as the paper does.'
    )


def _gain(data: Validated) -> str:
    v = data.result
    assert v.gain is not None
    theirs = OTHER + ('simulated' if OTHER + 'simulated' in v.predictions else 'curve')
    told = (
        f'{data.other} has a mean squared error of {plain(v.judgement.mse(theirs))} MW² there, '
        f'against {plain(v.judgement.mse(v.judged_by))} MW² of {data.model}: '
    )
    if not v.gain.zero_is_rejected():
        return told + 'the two cannot be told apart.'
    better = data.model if v.gain.mean > 0.0 else data.other
    return told + f'{better} is better.'


def validation_page(data: Validated) -> Page:
    """Return the report: the verdict and where it comes from, then the evidence."""
    v = data.result
    first, *rest = verdict_words(data)
    lead = paragraph(text(f'{data.model}, held against {data.source}'), 'where') + paragraph(
        f'{moment(int(data.contents.time_ns[0]))} to {moment(int(data.contents.time_ns[-1]))}',
        'where',
    )
    sections = [
        Section(
            'The verdict',
            [
                paragraph(text(first), 'answer'),
                *(_told(sentence, v) for sentence in rest),
                notice(text(data.held)) if data.held else '',
                input_figure(v),
                pieces_table(v),
            ],
        ),
        Section('When it differs', [time_figure(v)]),
        Section('Predictions', [totals_table(v), segments_table(v)]),
    ]
    if data.notes:
        notes = '<ul>' + ''.join(f'<li>{text(n)}</li>' for n in data.notes) + '</ul>'
        sections.append(Section('How the data were read', [notes]))
    foot = (
        f'Made by valveflow {text(__version__)}. Curve <code>{text(v.characteristic.model_id)}'
        '</code>; the same numbers, unrounded, stand in validation.json and segments.csv.'
    )
    return Page('Does the flow characteristic hold?', lead, sections, foot, 'validate')


def _told(sentence: str, v: Validation) -> str:
    flagged = v.outside_share > OUTSIDE_FLAG and 'beyond the ends' in sentence
    return notice(text(sentence)) if flagged else paragraph(text(sentence))


def pieces_table(v: Validation) -> str:
    """Return the mean difference overall and on each piece."""
    rows = []
    for k, check in enumerate((v.overall, *v.pieces)):
        mean = _signed(check.test.mean) if math.isfinite(check.test.mean) else '–'
        rows.append(
            [
                'all' if k == 0 else f'piece {k}',
                f'{decimals(check.u_from, 0)} to {decimals(check.u_to, 0)}',
                str(check.segments),
                mean,
                interval(check.low_mw, check.high_mw),
                decimals(check.test.effective, 0) if check.segments else '–',
            ]
        )
    head = [
        '', f'u ({input_unit(v.characteristic.pressure_exponent)})', 'segments',
        'measured − predicted (MW)', '95 % (MW)', 'independent segments',
    ]  # fmt: skip
    return table(head, rows)


def totals_table(v: Validation) -> str:
    """Return mean squared errors by kind of segment."""
    j = v.judgement
    rows = [
        [
            text(LABELS[name]),
            *(
                plain(j.mse(name, k)) if j.kinds(k) else '–'
                for k in (None, SegmentKind.STEADY, SegmentKind.SLOPE)
            ),
        ]
        for name in v.predictions
    ]
    return table(['prediction', 'all (MW²)', 'steady (MW²)', 'slope (MW²)'], rows)


def segments_table(v: Validation, most: int = 40) -> str:
    """Return the segments that differ most."""

    def size(s: JudgedSegment) -> float:
        t = s.scores[v.judged_by].effective.t
        return abs(t) if math.isfinite(t) else 0.0

    shown: Sequence[JudgedSegment] = sorted(v.judgement.segments, key=size, reverse=True)[:most]
    rows = []
    for s in shown:
        score = s.scores[v.judged_by]
        rows.append(
            [
                f'{s.kind.name.lower()} {s.number}', moment(s.start_ns)[:16], str(len(s.rows)),
                decimals(s.power_mw, 0), plain(score.mse_mw2), _signed(score.samples.mean),
                plain(score.samples.t, 2), plain(score.effective.t, 2),
                decimals(score.effective.effective, 1),
            ]
        )  # fmt: skip
    head = [
        'segment', 'from', 'samples', 'MW', 'mean squared error (MW²)',
        'measured − predicted (MW)', 't, each sample', 't, correlation counted',
        'independent values',
    ]  # fmt: skip
    many = counted(len(rows), 'segment')
    which = f'The {many} that differ most' if len(rows) < len(v.judgement.segments) else many
    words = 'All segments stand in segments.csv, those that differ most first here.'
    return paragraph(words) + folded(which, table(head, rows))
