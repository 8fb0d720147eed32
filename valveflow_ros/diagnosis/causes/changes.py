# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Causes that are changes in time: drifts, steps, intervals and the daily cycle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.cause import (
    Cause,
    FittedCause,
    Kind,
    SentenceValues,
    Stage,
    Start,
    Unknown,
    Values,
)
from valveflow_ros.diagnosis.grids import DAY_S, Grids
from valveflow_ros.diagnosis.screening import GAIN, INPUT, OFFSET, Screening
from valveflow_ros.errors import counted
from valveflow_ros.records import BoolArray, ByteArray, FloatArray

# Functions shared by the causes that change in time.

TEN_DAYS_S = 10.0 * DAY_S

ONSET = Unknown('t0_days', 'd', 2.0 / 24.0, 0.0, 400.0, Kind.LINE, dated=True)


def drift_size(screening: Screening, carrier: int) -> float:
    """Return the coefficient of one carrier times a ramp in time."""
    time = ramp(screening.grids, screening.grids.sub_middle_s)
    return float(screening.modulated([carrier], time[None, :])[1][0])


def ramp(grids: Grids, time_s: FloatArray) -> FloatArray:
    """Return a ramp in time that rises by 1 in ten days.

    It is 0 in the middle of the record, so that the fitted curve is the mean curve.
    """
    return np.asarray((time_s - 0.5 * grids.reference.span_s) / TEN_DAYS_S)


def since(grids: Grids, t0_days: float) -> FloatArray:
    """Return a step of height 1 at an onset.

    The fitted curve is then the curve before the onset, with straight pieces. A mean of both
    curves would need the breakpoints of both; the missing ones would look like another cause.
    """
    return np.where(grids.time_s >= t0_days * DAY_S, 1.0, 0.0)


def a_day(grids: Grids) -> str:
    """Return why a record is too short for changes with time; empty if it is not."""
    return _at_least(grids, 1.0)


def three_days(grids: Grids) -> str:
    """Return why a record is too short for a daily cycle; empty if it is not."""
    return _at_least(grids, 3.0)


def _at_least(grids: Grids, days: float) -> str:
    if grids.days >= 0.98 * days:
        return ''
    return (
        f'it changes with time, and the record lasts '
        f'{counted(float(f"{grids.days:.2g}"), "day")}; at least {days:g} are needed'
    )


def change(share: float) -> str:
    """Return a relative change in words."""
    return f'{abs(100.0 * share):.2g} % {"more" if share > 0.0 else "less"}'


def apply_gain_drift(values: Values, grids: Grids, extra: Values) -> FloatArray:
    """The power per flow drifts.

    Possible reasons: erosion and deposits after the valve, lower cycle efficiency, or the scale of
    the power transducer. The four signals cannot distinguish them.

        x = F(u) (1 + g (t - middle) / 10 d)
    """
    return np.asarray(1.0 + values[0] * ramp(grids, grids.time_s))


def gain_drift_starts(screening: Screening) -> Sequence[Start]:
    """Regress the residual on the power times a ramp in time."""
    return screening.best(GAIN_DRIFT, [(drift_size(screening, GAIN),)])


def gain_drift_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return (
        f'The power at the same flow changes evenly: {change(values["g"])} per ten days, at '
        'every load (wear, efficiency, the scale of the power meter, or the weather).'
    )


GAIN_DRIFT = Cause(
    'gain_drift', 'drift', Stage.GAIN,
    (Unknown('g', '1/(10 d)', 5e-4, -0.5, 0.5),),
    apply_gain_drift, gain_drift_starts, gain_drift_sentence,
    ('input_drift', 'output_offset_drift', 'gain_step'),
    'Hold the load for an hour where the curve is flat and for an hour at low load: a drift of '
    'the input has no effect where the curve is flat, one of the offset is equal at both.',
    a_day, slow=True,
)  # fmt: skip


def apply_gain_step(values: Values, grids: Grids, extra: Values) -> FloatArray:
    """The power per flow changes at one moment and stays changed.

    Possible reasons: maintenance, a new power meter, a permanently switched heater or extraction.

        x = F(u) (1 + g),  t >= t0
    """
    return np.asarray(1.0 + values[0] * since(grids, values[1]))


def gain_step_starts(screening: Screening) -> Sequence[Start]:
    """Try a step at every half hour."""
    return screening.best_onset(GAIN_STEP, screening.only(GAIN))


def gain_step_sentence(values: SentenceValues) -> str:
    """Return the sentence for the operator."""
    return (
        f'From {values.onset} the same flow gives {change(values["g"])} power, at every '
        'load alike (maintenance, power meter, a heater or extraction). A change of the flow by '
        'the same share at every load would look the same.'
    )


GAIN_STEP = Cause(
    'gain_step', 'step', Stage.GAIN,
    (Unknown('g', '', 5e-4, -0.5, 0.5), ONSET),
    apply_gain_step, gain_step_starts, gain_step_sentence,
    ('input_step', 'curve_step', 'intervals', 'gain_drift'),
    'Hold the load for an hour where the curve is flat and for an hour at low load: a step of '
    'the input has no effect where the curve is flat. Intervals end by themselves: wait some '
    'days.',
    a_day, slow=True,
)  # fmt: skip


def apply_input_drift(
    u: FloatArray, values: Values, grids: Grids, model: RegionalModel
) -> FloatArray:
    """The flow area at a given reading of u drifts.

    Possible reasons: the scale of the pressure transmitter or of the position sensor, or wear of
    the seat. The four signals cannot distinguish them.

        u_true = u (1 + g (t - middle) / 10 d)
    """
    return np.asarray(1.0 + values[0] * ramp(grids, grids.time_s))


def input_drift_starts(screening: Screening) -> Sequence[Start]:
    """Regress the residual on the effect of the input times a ramp in time."""
    size = drift_size(screening, INPUT)
    return screening.best(INPUT_DRIFT, [(size,), (0.6 * size,)])


def input_drift_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return (
        'At the same readings of opening and pressure the steam flow changes evenly: '
        f'{change(values["g"])} per ten days (scale of the pressure or position transmitter, or '
        'wear of the seat).'
    )


INPUT_DRIFT = Cause(
    'input_drift', 'drift', Stage.INPUT,
    (Unknown('g', '1/(10 d)', 5e-4, -0.5, 0.5),),
    apply_input_drift, input_drift_starts, input_drift_sentence,
    ('gain_drift', 'output_offset_drift', 'input_step'),
    'Hold the load for an hour where the curve is flat and for an hour at low load: a drift of '
    'the input has no effect where the curve is flat.',
    a_day, slow=True,
)  # fmt: skip


def apply_input_step(
    u: FloatArray, values: Values, grids: Grids, model: RegionalModel
) -> FloatArray:
    """The pressure or position transmitter is recalibrated.

    After the onset the same reading of u corresponds to another flow area.

        u_true = u (1 + g),  t >= t0
    """
    return np.asarray(1.0 + values[0] * since(grids, values[1]))


def input_step_starts(screening: Screening) -> Sequence[Start]:
    """Try a step at every half hour."""
    return screening.best_onset(INPUT_STEP, screening.only(INPUT))


def input_step_sentence(values: SentenceValues) -> str:
    """Return the sentence for the operator."""
    return (
        f'From {values.onset} the same reading of opening and pressure passes '
        f'{change(values["g"])} steam (a transmitter was recalibrated or failed partly).'
    )


INPUT_STEP = Cause(
    'input_step', 'step', Stage.INPUT,
    (Unknown('g', '', 5e-4, -0.5, 0.5), ONSET),
    apply_input_step, input_step_starts, input_step_sentence,
    ('gain_step', 'curve_step', 'input_drift'),
    'Hold the load for an hour where the curve is flat and for an hour at low load: a step of '
    'the input has no effect where the curve is flat.',
    a_day, slow=True,
)  # fmt: skip


def apply_output_offset_drift(y: FloatArray, values: Values, grids: Grids) -> FloatArray:
    """The zero of the power drifts.

    Possible reasons: the zero of the power transducer, or a new permanent auxiliary load. The
    change is the same at every load.

        y = G x + b (t - middle) / 10 d
    """
    return np.asarray(y + values[0] * ramp(grids, grids.time_s))


def output_offset_drift_starts(screening: Screening) -> Sequence[Start]:
    """Regress the residual on a ramp in time."""
    return screening.best(OUTPUT_OFFSET_DRIFT, [(drift_size(screening, OFFSET),)])


def output_offset_drift_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    b = values['b_mw']
    return (
        f'The power drifts by {b:+.2g} MW in ten days, by the same at every load (zero of the '
        'power meter, or auxiliary load).'
    )


OUTPUT_OFFSET_DRIFT = Cause(
    'output_offset_drift', 'drift', Stage.OUTPUT,
    (Unknown('b_mw', 'MW/(10 d)', 0.1, -200.0, 200.0),),
    apply_output_offset_drift, output_offset_drift_starts, output_offset_drift_sentence,
    ('gain_drift', 'input_drift'),
    'Hours at low and at full load: a drift of the gain grows with the load, one of the '
    'offset does not.',
    a_day, slow=True,
)  # fmt: skip


_SWITCH_PENALTY = 9.0
_FIRST_SIZES = (0.003, 0.008, 0.02)
_FIRST_SHARE = 0.3
_ROUNDS = 8
LEAST_SWITCHES = 3  # on twice: once is a change that is undone, which many things can be


def apply_intervals(values: Values, grids: Grids, extra: Values) -> FloatArray:
    """For hours at a time a part of the steam or heat is used elsewhere.

    An extraction or a feed water heater is in or out of service:

        x = F(u) (1 + g w(t)),  w = 0 or 1

    w is not measured. It is modelled as a two-state path with few switches, found with the
    Viterbi algorithm on sums over half hours.
    """
    # Return the factor on x; ``extra`` holds the switching times in seconds.
    span = grids.reference.span_s
    # The last state goes on: later rows are corrected by the same causes.
    edges = np.append(np.asarray(extra), np.inf if len(extra) % 2 else []).reshape(-1, 2)
    # Relative to the mean over the record, as for a drift.
    share = float(np.sum(np.diff(np.clip(edges, 0.0, span)))) / span
    out = np.full(len(grids.time_s), 1.0 - values[0] * share)
    for a, b in np.searchsorted(grids.time_s, edges).tolist():
        out[a:b] = 1.0 + values[0] * (1.0 - share)
    return out


def intervals_starts(screening: Screening) -> Sequence[Start]:
    """Alternate between estimating the path and the size, from several sizes of both signs."""
    tried = []
    for sign in (1.0, -1.0):
        for size in _FIRST_SIZES:
            tried.append(_search(screening, sign * size))
    good = [s for s in tried if s is not None and s.gain > 0.0]
    return sorted(good, key=lambda s: -(s.gain - 5.0 * len(s.extra)))[:1]


def _search(screening: Screening, size: float) -> Start | None:
    own, toward = screening.gain_by_sub
    path = np.zeros(len(own), dtype=np.uint8)
    share = _FIRST_SHARE
    for _ in range(_ROUNDS):
        before = path.copy()
        _path(screening, own, toward, size, share, path)
        if not path.any() or path.all() or np.array_equal(path, before):
            break
        _, found = screening.modulated([GAIN], path[None, :].astype(np.float64))
        size, share = float(found[0]), float(path.mean())
    if path.mean() > 0.5:  # the rarer state counts as the event
        path, size = (1 - path).astype(np.uint8), -size
    times = _switches(screening, path)
    return screening.displaced(INTERVALS, (size,), times) if len(times) >= LEAST_SWITCHES else None


def _path(
    screening: Screening,
    own: FloatArray,
    toward: FloatArray,
    size: float,
    share: float,
    path: ByteArray,
) -> None:
    """Write the state path of least cost for a size and the fraction of time in state 1."""
    # The curve already contains the mean effect, so the levels are relative to that mean.
    on, off = size * (1.0 - share), -size * share
    cost = (on * on - off * off) * own - 2.0 * (on - off) * toward
    kernels.viterbi(cost / (2.0 * screening.variance), _SWITCH_PENALTY, path)


def _switches(screening: Screening, path: ByteArray) -> Values:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], path]).astype(int)))
    return tuple(screening.sub_start_s(int(k)) for k in edges)


def infer(screening: Screening, active: FittedCause, allowed: BoolArray) -> Values:
    """Return the switching times from the allowed sub-blocks, for a known size.

    The screening belongs to the model without this cause.
    """
    own, toward = (np.where(allowed, x, 0.0) for x in screening.gain_by_sub)
    edges = np.asarray(active.extra)
    middle = screening.grids.sub_middle_s
    share = float((np.searchsorted(edges, middle, side='right') % 2).mean())
    path = np.zeros(len(own), dtype=np.uint8)
    _path(screening, own, toward, active.values[0], share, path)
    return _switches(screening, path)


def intervals_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return (
        f'For hours at a time the same flow gives {change(values["g"])} power: something is '
        'switched in and out (an extraction, a feed water heater).'
    )


INTERVALS = Cause(
    'intervals', 'hidden', Stage.GAIN,
    (Unknown('g', '', 5e-4, -0.5, 0.5),),
    apply_intervals, intervals_starts, intervals_sentence, ('gain_step', 'diurnal'),
    'Log the state of extractions and heaters beside the power.',
    three_days, slow=True, infer=infer,
)  # fmt: skip


_HOUR_S = 3600.0


def apply_diurnal(values: Values, grids: Grids, extra: Values) -> FloatArray:
    """The power follows the time of day.

    The condenser pressure follows the ambient air or the cooling water. Auxiliary load that
    depends on the weather has the same effect.

        x = F(u) (1 + a cos(2 pi (t - t_peak) / 24 h)),  t the time of day, UTC
    """
    a, peak_h = values
    if 'day' not in grids.cache:
        angle = 2.0 * np.pi * grids.clock_s(grids.time_s) / DAY_S
        grids.cache['day'] = np.stack([np.cos(angle), np.sin(angle)])
    peak = 2.0 * np.pi * peak_h * _HOUR_S / DAY_S
    cosine, sine = grids.cache['day']
    return np.asarray(1.0 + (a * np.cos(peak)) * cosine + (a * np.sin(peak)) * sine)


def diurnal_starts(screening: Screening) -> Sequence[Start]:
    """Regress the residual on the power times a daily sine and cosine."""
    angle = 2.0 * np.pi * screening.grids.clock_s(screening.grids.sub_middle_s) / DAY_S
    _, found = screening.modulated([GAIN, GAIN], np.stack([np.cos(angle), np.sin(angle)]))
    peak_h = float(np.mod(np.arctan2(found[1], found[0]) / (2.0 * np.pi) * 24.0, 24.0))
    return screening.best(DIURNAL, [(float(np.hypot(*found)), peak_h)])


def diurnal_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    minutes = round(values['peak_h'] * 60.0) % 1440
    return (
        f'The power varies by ±{100.0 * abs(values["a"]):.2g} % every day, highest at '
        f'{minutes // 60:02d}:{minutes % 60:02d} UTC (condenser and cooling water follow the day).'
    )


DIURNAL = Cause(
    'diurnal', 'daily', Stage.GAIN,
    (Unknown('a', '', 5e-4, 0.0, 0.2), Unknown('peak_h', 'h', 0.5, -24.0, 48.0)),
    apply_diurnal, diurnal_starts, diurnal_sentence, ('intervals', 'temperature'),
    'Log the pressure in the condenser, or a week at constant load.',
    three_days, slow=True,
)  # fmt: skip
