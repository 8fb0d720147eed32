"""The answer in words, and the table of pieces."""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic, Piece
from valveflow_ros.records import FloatArray, Signal
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.numbers import (
    count,
    counted,
    decimals,
    duration,
    interval,
    percent,
    plain,
    with_error,
)
from valveflow_ros.report.page import notice, paragraph, table, text
from valveflow_ros.report.words import held_words, input_unit

# A power that the valve explains less of is governed by something else, or a signal is wrong.
_LITTLE = 0.8
_FLAT = 0.2  # a piece this much flatter than the steepest is said to answer hardly at all


def explained(data: Identified) -> float:
    """Return the share of the power's variance in special segments that the curve explains."""
    rows = data.special
    if not len(rows):
        return math.nan
    power = data.power[rows]
    # Outside the identified range the outer pieces are taken to go on.
    rest = power - data.characteristic.model.static(data.u[rows])
    total = float(np.var(power))
    return 1.0 - float(np.mean(rest**2)) / total if total > 0.0 else math.nan


def doubt(data: Identified) -> str:
    """Return a warning where the curve explains so little that it is none; empty otherwise."""
    share = explained(data)
    if not share < _LITTLE:
        return ''
    return (
        f'Do not rely on this curve: it explains only {percent(share)} of the variance of the '
        'power. Look whether a signal is constant, taken for another one, or in another unit.'
    )


def opening_gain(data: Identified, piece: Piece) -> tuple[float, float]:
    """Return MW per % of opening on a piece, and the pressure in MPa it holds at.

    The pressure is the median over the special samples on the piece.
    """
    rows = data.special
    u = data.u[rows]
    inside = rows[(u >= piece.u_from) & (u <= piece.u_to)]
    pressure = data.table.column(Signal.MAIN_STEAM_PRESSURE)[inside]
    if not len(pressure):
        return math.nan, math.nan
    p = float(np.median(pressure))
    return piece.slope * p**data.characteristic.pressure_exponent, p


def answer_words(data: Identified) -> str:
    """Return the paragraph an engineer would tell a colleague."""
    c = data.characteristic
    ends, values = c.breakpoints, c.values()
    words = (
        f'The flow characteristic has <b>{counted(len(c.pieces), "piece")}</b> and is known for '
        f'u from {decimals(float(ends[0]), 0)} to {decimals(float(ends[-1]), 0)} '
        f'{input_unit(c.pressure_exponent)}, that is from {decimals(float(values[0]), 0)} to '
        f'{decimals(float(values[-1]), 0)} MW.'
    )
    words += _bends(c)
    words += (
        f' It explains {percent(explained(data))} of the variance of the power in '
        f'{counted(c.source.steady, "steady-state segment")} and '
        f'{counted(c.source.slope_response, "slope-response segment")} '
        f'({counted(c.source.samples, "sample")}), and leaves a typical difference of '
        f'{plain(c.residuals.rmse_mw, 2)} MW.'
    )
    return paragraph(words, 'answer') + _warnings(data)


def _bends(c: Characteristic) -> str:
    """Say what the shape means for control."""
    if len(c.pieces) == 1:
        return f' It is straight: {plain(c.pieces[0].slope)} MW per unit of u everywhere.'
    slopes = np.array([p.slope for p in c.pieces])
    steep, flat = int(np.argmax(slopes)), int(np.argmin(slopes))
    said = (
        f' The valve moves the unit most between u = {decimals(c.pieces[steep].u_from, 0)} and '
        f'{decimals(c.pieces[steep].u_to, 0)} ({plain(slopes[steep], 3)} MW per unit of u)'
    )
    if slopes[flat] <= 0.0:
        return said + (
            f'; between {decimals(c.pieces[flat].u_from, 0)} and '
            f'{decimals(c.pieces[flat].u_to, 0)} opening further <b>does not raise the power</b>.'
        )
    times = slopes[steep] / slopes[flat]
    weak = ': there it hardly answers' if slopes[flat] < _FLAT * slopes[steep] else ''
    return said + (
        f', and {plain(float(times), 2)} times less between '
        f'{decimals(c.pieces[flat].u_from, 0)} and {decimals(c.pieces[flat].u_to, 0)} '
        f'({plain(slopes[flat], 3)}){weak}.'
    )


def _warnings(data: Identified) -> str:
    c = data.characteristic
    told = notice(doubt(data)) if doubt(data) else ''
    if c.source.temperature_flag:
        limit = plain(data.settings.real('temperature_spread_limit'))
        told += notice(
            f'The main steam temperature spread over {plain(c.source.temperature_spread_k, 3)} K '
            f'in the special segments (limit {limit} K). The method assumes it unchanged: part '
            'of what looks like the valve may be the temperature.'
        )
    if any(p.slope <= 0.0 for p in c.pieces):
        told += notice(
            'A piece does not rise, so the curve has no inverse there and cannot be compensated '
            'as it stands. A flat end is ordinary; a falling piece elsewhere is not.'
        )
    return told + ''.join(notice(text(n)) for n in (held_words(c.held), *c.notes) if n)


def pieces_table(data: Identified) -> str:
    """Return one row a piece."""
    c = data.characteristic
    rows = []
    for k, piece in enumerate(c.pieces):
        gain, pressure = opening_gain(data, piece)
        at = f' at {plain(pressure, 3)} MPa' if math.isfinite(pressure) else ''
        low, high = _ends(piece)
        rows.append(
            [
                str(k + 1),
                f'{decimals(piece.u_from, 1)} to {decimals(piece.u_to, 1)}',
                f'{decimals(low, 1)} to {decimals(high, 1)}',
                with_error(piece.slope, piece.slope_stderr),
                with_error(piece.intercept, piece.intercept_stderr),
                plain(gain, 3) + at,
                count(piece.samples),
                *_rests(c, k),
            ]
        )
    head = [
        'piece', f'u ({input_unit(c.pressure_exponent)})', 'power (MW)',
        'slope ± standard error (MW per unit of u)', 'intercept ± standard error (MW)',
        'MW per 1 % of opening', 'samples', *(['rests on'] if c.support else []),
    ]  # fmt: skip
    return table(head, rows)


def _rests(c: Characteristic, k: int) -> list[str]:
    """Return what a piece rests on, as a cell of the table; none where it is not known."""
    if not c.support:
        return []
    found = c.support[k]
    said = (
        f'{counted(found.steady, "steady state")} at {counted(len(found.levels), "level")}, '
        f'{counted(found.slope_response, "slope response")}'
    )
    return [said if found.identifiable else f'<b>not identifiable by itself</b>: {said}']


def _ends(piece: Piece) -> FloatArray:
    return np.array([piece.u_from, piece.u_to]) * piece.slope + piece.intercept


def breakpoints_table(c: Characteristic) -> str:
    """Return one row a breakpoint between pieces; empty for a straight curve."""
    if len(c.pieces) < 2:
        return ''
    rows = [
        [str(k + 1), decimals(piece.u_to, 1), interval(low, high), decimals(float(value), 1)]
        for k, (piece, (low, high), value) in enumerate(
            zip(c.pieces[:-1], c.breakpoint_intervals, c.values()[1:-1], strict=True)
        )
    ]
    unit = input_unit(c.pressure_exponent)
    head = ['break&shy;point', f'u ({unit})', '95 % interval', 'power (MW)']
    return table(head, rows)


def temperature_words(c: Characteristic) -> str:
    """Return what is known of the temperature during the special segments."""
    source = c.source
    if not math.isfinite(source.temperature_spread_k):
        return 'The main steam temperature is not known.'
    mean = f'{decimals(source.temperature_mean_degc, 1)} °C'
    if source.temperature_spread_k == 0.0:
        return f'Main steam temperature: {mean} throughout.'
    verdict = 'more than the method allows for' if source.temperature_flag else 'within its limit'
    return (
        f'Main steam temperature in the special segments: mean {mean}, 95 % of it within '
        f'{plain(source.temperature_spread_k, 3)} K, {verdict}.'
    )


def window_words(c: Characteristic) -> str:
    """Return the length of the window."""
    return duration((c.source.window_end_ns - c.source.window_start_ns) / 1e9)
