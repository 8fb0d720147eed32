"""The curve against its reference: the judgement, its numbers, and the segments over time."""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.curve.segment_residual import SegmentResiduals, segment_residuals
from valveflow_ros.curve.shift import PieceShift, Shift
from valveflow_ros.report.figure import Figure, Spec, packed, rounded, token
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.numbers import decimals, moment, plain, with_error
from valveflow_ros.report.page import Section, notice, paragraph, table, text

# One colour a piece, over and over; moved pieces are told apart by being strong.
_STRONG, _SOFT = 'steady', 'data'
_SURE = 0.9999


def shift_section(data: Identified) -> Section | None:
    """Return the part of the page; None where there was no reference."""
    shift = data.shift
    if shift is None or data.reference is None:
        return None
    told = text(shift.sentence)
    lead = notice(told) if shift.moved else paragraph(told)
    found = segment_residuals(data.reference, data.segments)
    parts: list[str | Figure] = [lead, _table(shift)]
    if len(found):
        parts.append(_figure(shift, found))
    return Section('Against the reference', parts)


def _table(shift: Shift) -> str:
    rows = [_row(k, piece) for k, piece in enumerate(shift.pieces)]
    head = [
        'piece', 'u', 'moved', 'now (MW)', '% of flow', 'curves differ in the middle by (MW)',
        'along the piece (MW)', 'confidence', 'smallest shift seen (MW)',
    ]  # fmt: skip
    return table(head, rows)


def _row(k: int, p: PieceShift) -> list[str]:
    if not math.isfinite(p.u_from):
        return [str(k + 1), 'not in the reference', *[''] * 7]
    sure = f'> {100.0 * _SURE:g} %' if p.confidence > _SURE else f'{100.0 * p.confidence:.1f} %'
    return [
        str(k + 1),
        f'{decimals(p.u_from, 0)} to {decimals(p.u_to, 0)}',
        '<b>yes</b>' if p.moved else 'no',
        with_error(p.now_mw, p.now_error_mw) if math.isfinite(p.now_mw) else '–',
        decimals(p.percent, 2) if p.moved else '–',
        with_error(p.middle_mw, p.error_mw),
        f'{decimals(p.low_mw, 2)} to {decimals(p.high_mw, 2)}',
        sure,
        plain(p.smallest_mw, 2),
    ]


def _figure(shift: Shift, found: SegmentResiduals) -> Figure:
    """Return each segment's difference from the reference over time."""
    moved = np.zeros(len(found), dtype=bool)
    for p in shift.pieces:
        if p.moved:
            moved |= (found.u >= p.u_from) & (found.u < p.u_to)
    traces = [
        trace
        for keep, name, colour in (
            (~moved, 'pieces that did not move', _SOFT), (moved, 'pieces that moved', _STRONG)
        )
        if keep.any()
        for trace in _trace(found.part(keep), name, colour)
    ]  # fmt: skip
    layout: Spec = {
        'xaxis': {'type': 'date', 'title': {'text': 'time (UTC)'}},
        'yaxis': {'title': {'text': 'measured less reference (MW)'}},
        'shapes': _marks(shift),
        'hovermode': 'closest',
    }
    caption = (
        '<b>Without a shift the points scatter about zero.</b> Each is a special segment, '
        'measured less what the reference gives.'
    )
    if shift.since_ns:
        caption += (
            f' The line marks the change, {moment(shift.since_ns)}; shaded, where it lies with '
            '95 % confidence.'
        )
    about = 'Difference of each special segment from the reference curve over time.'
    return Figure('shift', caption, about, traces, layout, height=380)


def _trace(found: SegmentResiduals, name: str, colour: str) -> list[Spec]:
    return [
        {
            'type': 'scatter', 'mode': 'markers', 'name': name,
            'x': packed(found.time_ns / 1e6), 'y': rounded(found.residual_mw, 5),
            'customdata': rounded(found.u, 5),
            'marker': {'color': token(colour), 'size': 6},
            'hovertemplate': '%{x|%d %b %H:%M}<br>u %{customdata:.0f}<br>%{y:+.2f} MW'
            f'<extra>{name}</extra>',
        }
    ]  # fmt: skip


def _marks(shift: Shift) -> list[Spec]:
    zero: Spec = {
        'type': 'line', 'xref': 'paper', 'x0': 0, 'x1': 1, 'y0': 0, 'y1': 0,
        'line': {'color': token('muted'), 'width': 1},
    }  # fmt: skip
    if not shift.since_ns:
        return [zero]
    span = {'yref': 'paper', 'y0': 0, 'y1': 1}
    return [
        zero,
        {
            'type': 'rect', **span, 'x0': shift.since_low_ns / 1e6,
            'x1': shift.since_high_ns / 1e6, 'fillcolor': token('band'), 'line': {'width': 0},
            'layer': 'below',
        },
        {
            'type': 'line', **span, 'x0': shift.since_ns / 1e6, 'x1': shift.since_ns / 1e6,
            'line': {'color': token('chosen'), 'width': 2},
        },
    ]  # fmt: skip
