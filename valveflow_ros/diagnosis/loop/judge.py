# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judges the valve of one control loop: stiction, backlash, healthy, or not judged.

First it checks which methods apply to the record. With a measured position, the valve is judged
from command and position (`actuator`). Without one, two likelihoods decide (`plug`) together with
the classical tests of an oscillating loop (`detectors`): with moderate evidence a fault is
reported only if Horch's test does not contradict it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from valveflow_ros.diagnosis.loop import actuator, detectors, plug
from valveflow_ros.diagnosis.loop.detectors import NO_STICTION, STICTION, Detection
from valveflow_ros.errors import DataError, counted
from valveflow_ros.records import BoolArray, FloatArray, IntArray

HEALTHY, OSCILLATING, NOT_JUDGED = 'healthy', 'oscillating', 'not_judged'
FAULTS = ('stiction', 'backlash')
VERDICTS = (HEALTHY, 'stiction', 'backlash', OSCILLATING, NOT_JUDGED)

LEAST_ROWS = 200
LEAST_GAIN, LEAST_TRAVEL = 15.0, 10.0
"""Log-likelihoods asked for. Fixed on simulated loops with seeds below 300."""
CONTRADICTED_GAIN = 25.0
"""What `LEAST_GAIN` becomes where Horch's test finds the loop sound."""
LEAST_ANSWER = 3.0
"""Log-likelihood by which the command must help to predict the response."""
LEAST_PERIODS = 3.0
_DOUBT = 'A process that changes unmeasured, such as a varying supply pressure, can look the same.'
_MOST_ROWS = 20_000
_WINDOW_ROWS = 1000  # the thresholds were determined on windows of 751 rows
_MOST_FILLED = 3
_LEAST_LEVELS = 6
_LEAST_STEP_S = 5.0
_LEAST_MEANS = 100  # the prediction has 22 coefficients and needs a past of 32 means
_MOST_AT_STOP, _STOP_RUN = 0.03, 4
_MOST_FLAT = 0.5
_TURN = 0.2  # fraction of the usual span of the command that counts as a reversal
_REGULAR = 1.0
_MOST_LEFT = 4.0
_LEAST_SLOPE = 0.3  # of the position over the command
# Rows of a position that count as one: ten seconds, because a servo residual is correlated.
_DEPENDENT_S, _LEAST_DEPENDENT, _MOST_DEPENDENT = 10.0, 2.0, 10.0


@dataclass(frozen=True, slots=True)
class LoopJudgement:
    """The result for the valve of a loop.

    Attributes
    ----------
    verdict : str
        One of `VERDICTS`.
    reason : str
        A sentence for an operator.
    sizes : dict
        Value, low, high (95 %) and unit of each, if known.
    detections : dict
        Result of each classical test, if the loop oscillates regularly.
    gain, travel : float
        Log-likelihoods of the best plug, as in `plug.Evidence`; NaN if not computed.
    period_s : float
        Period of a regular oscillation, else NaN.
    rows : int
        Number of rows used.
    """

    verdict: str
    reason: str
    sizes: dict[str, dict[str, float | str]] = field(default_factory=dict)
    detections: Mapping[str, Detection] = field(default_factory=dict)
    gain: float = np.nan
    travel: float = np.nan
    period_s: float = np.nan
    rows: int = 0


def judge_response(
    command: FloatArray, response: FloatArray, step_s: float, set_point: FloatArray | None = None
) -> LoopJudgement:
    """Judge a valve from its command and a process variable that it controls.

    Parameters
    ----------
    command : float64 (n,)
        Controller output in %, either direction of action; NaN if missing.
    response : float64 (n,)
        Flow, level or pressure in any unit, in the same rows.
    step_s : float
        Constant time between rows in s.
    set_point : float64 (n,), optional
        If it oscillates with the loop, the oscillation has an external source.

    Notes
    -----
    A fault is called stiction; backlash is the case without a jump. On simulated loops, choosing
    by the better fit classified fewer valves correctly than always choosing the more frequent one.
    The reason says which of the two fits better.

    Gaps of up to three rows are interpolated; the longest stretch without larger gaps is used. A
    long one is split into parts of at most 1000 rows, which decide by majority: the misfit of the
    linear process model accumulates with the rows and looks like evidence of a fault.

    Raises
    ------
    DataError
        The series differ in length or are not one-dimensional, or the step is not positive.
    """
    c, y = _checked(command, response, step_s)
    rows = _longest(np.isfinite(c) & np.isfinite(y))
    aim = None if set_point is None else _bridged(np.asarray(set_point, dtype=np.float64))[rows]
    c, y = c[rows], y[rows]
    why = _hindered(c, y, 'process value')
    if why:
        return LoopJudgement(NOT_JUDGED, why, rows=len(c))
    group = max(1, round(_LEAST_STEP_S / step_s))
    if len(c) < _LEAST_MEANS * group:
        return LoopJudgement(
            NOT_JUDGED,
            f'The {len(c)} rows with command and process value in one piece last '
            f'{len(c) * step_s:.3g} s; {_LEAST_MEANS * group * step_s:.0f} s are needed, because '
            f'a process value is judged by its means over {_LEAST_STEP_S:.0f} s.',
            rows=len(c),
        )
    parts = np.array_split(np.arange(len(c)), -(-len(c) // (_WINDOW_ROWS * group)))
    found = [_judged(c[p], y[p], None if aim is None else aim[p], step_s, group) for p in parts]
    if len(found) > 1 and all(one.verdict == NOT_JUDGED for one in found):
        # Oscillations too slow for one part may be visible in the whole record.
        return _doubted(_judged(c, y, aim, step_s, -(-len(c) // _WINDOW_ROWS)))
    return _doubted(found[0] if len(found) == 1 else _together(found))


def _doubted(found: LoopJudgement) -> LoopJudgement:
    """Return a judgement with what else may look like its fault."""
    return replace(found, reason=f'{found.reason} {_DOUBT}') if found.verdict in FAULTS else found


def _judged(
    c: FloatArray, y: FloatArray, aim: FloatArray | None, step_s: float, group: int
) -> LoopJudgement:
    """Judge rows without gaps, few enough for the thresholds to be valid."""
    why = _hindered(c, y, 'process value')
    if why:
        return LoopJudgement(NOT_JUDGED, why, rows=len(c))
    found = plug.evidence(c, y, group)
    swing, turns, horch = detectors.oscillation(c), _turns(c), detectors.horch(c, y)
    regular = (
        swing.regularity > _REGULAR
        and len(c) >= LEAST_PERIODS * swing.period
        and turns >= 2.0 * LEAST_PERIODS - 1.0
    )
    verdict, reason = _concluded(found, horch, turns, regular)
    period_s = swing.period * step_s if regular else np.nan
    if verdict == OSCILLATING:
        reason = f'The loop swings with a period of {_seconds(period_s)}; {reason}'
        if aim is not None and _swings_along(aim, swing.period):
            reason += ' The set point swings with the same period: the cause lies before the loop.'
    asked = _asked(c, y, swing.period, horch) if regular else {}
    return LoopJudgement(verdict, reason, {}, asked, found.gain, found.travel, period_s, len(c))


def _together(parts: list[LoopJudgement]) -> LoopJudgement:
    """Return the majority result of the parts, with the reason of the clearest part."""
    rows = sum(one.rows for one in parts)
    decided = [one for one in parts if one.verdict != NOT_JUDGED]
    named = [one for one in decided if one.verdict in FAULTS]
    some = named if 2 * len(named) > len(decided) else [o for o in decided if o not in named]
    verdict = max(VERDICTS, key=lambda v: sum(one.verdict == v for one in some))
    clearest = max(
        (one for one in some if one.verdict == verdict), key=lambda one: one.gain + one.travel
    )
    count = len(some) if named is some else sum(one.verdict == verdict for one in decided)
    told = f'{clearest.reason} So say {count} of the {len(decided)} parts that could be judged.'
    return replace(clearest, reason=told, rows=rows)


def judge_position(command: FloatArray, position: FloatArray, step_s: float) -> LoopJudgement:
    """Judge a valve from its command and its measured position.

    Parameters
    ----------
    command, position : float64 (n,)
        In %, or the position as a fraction; either direction of action. NaN if missing.
    step_s : float
        Time between rows in s.

    Raises
    ------
    DataError
        As in `judge_response`.
    """
    c, v = _checked(command, position, step_s)
    both = np.isfinite(c) & np.isfinite(v)
    rows = int(both.sum())
    why = _hindered(c[both], v[both], 'position')
    if why:
        return LoopJudgement(NOT_JUDGED, why, rows=rows)
    if v[both].min() > -0.05 and v[both].max() < 1.1 and np.ptp(c[both]) > 2.0:
        v = 100.0 * v  # a fraction of full opening
    slope = float(np.polyfit(c[both], v[both], 1)[0])
    if slope < 0.0:
        c = -c
    if abs(slope) < _LEAST_SLOPE:
        return LoopJudgement(
            NOT_JUDGED,
            f'The position hardly follows the command: it moves over {np.ptp(v[both]):.3g} while '
            f'the command moves over {np.ptp(c[both]):.3g}; the valve is stuck, at a stop or not '
            'the one that is commanded.',
            rows=rows,
        )
    dependent = min(max(_DEPENDENT_S / step_s, _LEAST_DEPENDENT), _MOST_DEPENDENT)
    # In a short record the offset is the middle of the range of the difference; at a stop it is
    # the median.
    middle = 0.5 * float(np.quantile((v - c)[both], (0.01, 0.99)).sum())
    tried = [
        actuator.judge_rows(c, v, step_s, dependent=dependent, offset=offset)
        for offset in (middle, None)
    ]
    fault = min((f for f in tried if f is not None), key=lambda f: f.rms_after, default=None)
    if fault is None and (left := _beyond_servo(c, v)) > _MOST_LEFT:
        return LoopJudgement(
            NOT_JUDGED,
            f'The position differs from that of a sound valve by {left:.0f} times the noise of a '
            f'reading, and {rows} rows do not tell why.',
            rows=rows,
        )
    return _of_fault(fault, rows)


def _beyond_servo(c: FloatArray, v: FloatArray) -> float:
    """Return the residual of a first-order servo, relative to the noise of a reading."""
    rows = np.flatnonzero(np.isfinite(v[1:]) & np.isfinite(v[:-1]) & np.isfinite(c[1:]))
    table = np.column_stack([v[rows], c[rows + 1], np.ones(len(rows))])
    rest = v[rows + 1] - table @ np.linalg.lstsq(table, v[rows + 1], rcond=None)[0]
    noise = float(np.median(np.abs(v[rows + 1] - v[rows]))) / 0.954
    left: float = float(np.std(rest)) / max(noise, 0.01)
    return left


def _of_fault(fault: actuator.ActuatorFault | None, rows: int) -> LoopJudgement:
    if fault is None:
        return LoopJudgement(
            HEALTHY,
            'The position follows the command without sticking or slack; a loose linkage behind '
            'the position sensor would not show.',
            rows=rows,
        )
    units = {'r_percent_per_s': '%/s'}
    sizes: dict[str, dict[str, float | str]] = {
        key: {'value': value, 'low': low, 'high': high, 'unit': units.get(key, '%')}
        for key, (value, low, high) in fault.parameters.items()
    }
    first = next(iter(fault.parameters.values()))[0]
    sentence = {
        'stiction': f'The valve sticks and slips: it moves only after the command has gone '
        f'{first:.2g} % further.',
        'backlash': f'The valve moves with slack: {first:.2g} % when the command turns round.',
        'rate_limit': f'The valve moves by at most {first:.2g} %/s, and for much of the time it '
        'was behind its command; whether it sticks cannot be judged.',
        'saturation': f'The valve does not open beyond {first:.3g} %, where the command often '
        'was; whether it sticks cannot be judged.',
    }[fault.name]
    named = fault.name in VERDICTS
    return LoopJudgement(
        fault.name if named else NOT_JUDGED, sentence, sizes if named else {}, rows=rows
    )


def _checked(
    command: FloatArray, other: FloatArray, step_s: float
) -> tuple[FloatArray, FloatArray]:
    c, y = (np.asarray(a, dtype=np.float64) for a in (command, other))
    if c.ndim != 1 or c.shape != y.shape:
        raise DataError(
            'Command and what follows it must be series of one length; they have '
            f'{c.shape} and {y.shape} rows.'
        )
    if not 0.0 < step_s < np.inf:
        raise DataError(f'The time between rows must be positive; it is {step_s} s.')
    c, y = (np.where(np.isfinite(x), x, np.nan) for x in (c, y))
    return _bridged(c), _bridged(y)


def _runs(good: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the start and end of runs of true rows."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], good.astype(np.int8), [0]))))
    return edges[::2].astype(np.int64), edges[1::2].astype(np.int64)


def _bridged(x: FloatArray) -> FloatArray:
    """Return a series with gaps of a few rows filled by linear interpolation."""
    known = np.isfinite(x)
    if known.all() or not known.any():
        return x
    out = x.copy()
    rows = np.arange(len(x))
    for begin, end in zip(*_runs(~known), strict=True):
        if end - begin <= _MOST_FILLED and begin > 0 and end < len(x):
            inside = rows[begin:end]
            out[inside] = np.interp(inside, (begin - 1, end), (x[begin - 1], x[end]))
    return out


def _longest(good: BoolArray) -> slice:
    """Return the longest run of good rows; if it is very long, its last rows."""
    begins, ends = _runs(good)
    if not len(begins):
        return slice(0, 0)
    k = int(np.argmax(ends - begins))
    return slice(max(int(begins[k]), int(ends[k]) - _MOST_ROWS), int(ends[k]))


def _hindered(c: FloatArray, y: FloatArray, what: str) -> str:
    """Return why a record cannot be judged, empty if it can."""
    if len(c) < LEAST_ROWS:
        return (
            f'There are {len(c)} rows with command and {what} in one piece; {LEAST_ROWS} are '
            'needed.'
        )
    if len(np.unique(c)) < _LEAST_LEVELS:
        return f'The command hardly moves: it has {len(np.unique(c))} different values.'
    if len(np.unique(y)) < _LEAST_LEVELS:
        return (
            f'The {what} does not move while the command moves: it has {len(np.unique(y))} '
            'different values, so its sensor may be dead.'
        )
    flat = int(np.diff(np.flatnonzero(np.concatenate(([1], np.diff(y), [1])))).max())
    if flat > _MOST_FLAT * len(y) and what != 'position':
        return (
            f'The {what} has the same value in {flat} consecutive rows while the command moves, '
            'so its sensor may be dead.'
        )
    share = max(_at_stop(c, float(c.min())), _at_stop(c, float(c.max())))
    if share > _MOST_AT_STOP and what != 'position':
        return (
            f'The command rests at its end {100.0 * share:.0f} % of the time, so the valve is at '
            'a stop.'
        )
    return ''


def _at_stop(c: FloatArray, end: float) -> float:
    """Return the fraction of rows in long rests at an end; 0 for a coarsely rounded command."""
    begins, ends = _runs(c == end)
    runs = ends - begins
    coarse = len(np.unique(c)) < len(c) // 10
    return 0.0 if coarse else float(runs[runs >= _STOP_RUN].sum()) / len(c)


def _turns(c: FloatArray) -> int:
    """Return how often the command reverses by more than a fraction of its range."""
    low, high = np.quantile(c, (0.01, 0.99))
    way, turns, extreme, up = _TURN * float(high - low), 0, float(c[0]), 0
    for value in c.tolist():
        if (up >= 0 and value > extreme) or (up <= 0 and value < extreme):
            if up == 0 and abs(value - extreme) > way:
                up = 1 if value > extreme else -1
                extreme = value
            elif up != 0:
                extreme = value
        elif up != 0 and abs(value - extreme) > way:
            turns, up, extreme = turns + 1, -up, value
    return turns


def _asked(c: FloatArray, y: FloatArray, period: float, horch: Detection) -> dict[str, Detection]:
    """Apply the classical tests."""
    return {
        'horch': horch,
        'yamashita': detectors.yamashita(c, y, period),
        'he_command': detectors.he(c),
        'he_process': detectors.he(y),
    }


def _concluded(
    found: plug.Evidence, horch: Detection, turns: int, regular: bool
) -> tuple[str, str]:
    """Return verdict and reason; for an oscillation the reason continues a sentence."""
    asked = CONTRADICTED_GAIN if horch.answer == NO_STICTION else LEAST_GAIN
    if found.gain >= asked or found.travel >= LEAST_TRAVEL:
        seen = (
            'a valve that lags behind its command explains the process value better than the '
            'command does'
            if found.gain >= asked
            else 'after a reversal the process value stands still until the command has moved '
            f'about {found.band:.2g} % further'
        )
        if horch.answer == STICTION:
            seen += "; Horch's cross-correlation says the same"
        better = 'sticking' if found.jump_gain > 0.0 else 'slack'
        clear = abs(found.jump_gain) >= plug.CLEAR_JUMP_GAIN
        fits = f'{better} fits better' if clear else 'both fit alike'
        return 'stiction', (
            f'The valve sticks or has slack: {seen}. Only a measured position can tell which of '
            f'the two; here {fits}.'
        )
    if found.of_command < LEAST_ANSWER:
        return (
            NOT_JUDGED,
            'The process value does not follow the command: check that both are of one loop.',
        )
    if not regular and turns < 2.0 * LEAST_PERIODS - 1.0:
        shown = (
            "Horch's cross-correlation suspects sticking"
            if horch.answer == STICTION
            else 'No fault of the valve shows'
        )
        return NOT_JUDGED, (
            f'The command had {counted(turns, "reversal")} of {100.0 * _TURN:.0f} % of its range '
            f'or more; {2.0 * LEAST_PERIODS - 1.0:.0f} are needed ({LEAST_PERIODS:.0f} full '
            f'swings). {shown}, but so few reversals prove nothing: take a longer record.'
        )
    if regular:
        return OSCILLATING, (
            'the valve shows no sign of sticking or slack: the controller is tuned too tightly, '
            'or the swing comes from outside.'
        )
    return HEALTHY, 'The process value follows the command, without a sign of sticking or slack.'


def _swings_along(aim: FloatArray, period: float) -> bool:
    """Return True if the set point oscillates regularly with nearly the same period."""
    if not np.isfinite(aim).all() or len(np.unique(aim)) < _LEAST_LEVELS:
        return False
    own = detectors.oscillation(aim)
    return own.regularity > _REGULAR and abs(own.period / period - 1.0) < 0.1


def _seconds(period_s: float) -> str:
    return f'{period_s:.0f} s' if period_s < 600.0 else f'{period_s / 60.0:.0f} min'
