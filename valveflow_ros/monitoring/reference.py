# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the plant is like in health: the reference, what fits may use, and how the valve wears."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic, ChartDesign
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.curve.segment_residual import segment_residuals
from valveflow_ros.curve.shift import Shift, ShiftLimits, judge_shift
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarms import AlarmChange, ShiftAlarm
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SpecialSegment
from valveflow_ros.state import State, perhaps

_DAY_NS = 86_400 * NS_PER_S
MONTH_NS = 30 * _DAY_NS
# A window that is full to this share counts as a full one.
_FULL = 0.9
# Wear is told from so many days on; what was measured of it is kept for so many references.
_LEAST_WEAR_NS = 20 * _DAY_NS
_KEPT = 400


class Wear(NamedTuple):
    """How the curve has changed slowly.

    Attributes
    ----------
    since_ns : int
        Middle of the data of the first reference.
    total_mw : float
        Mean over the segments of the last curve, less that reference.
    mw_per_month : float
        Slope of a line through what was measured since.
    """

    since_ns: int
    total_mw: float
    mw_per_month: float


class ReferenceCurve:
    """Keep the curve of the healthy plant, the alarm on a shift from it, and the wear.

    Where nothing was wrong for `reference_after` behind a curve, it becomes the reference by
    itself, and so do later ones: the reference follows slow wear, but never a fault, and never
    further from the first one than `wear_budget` allows. From the onset of a fault on fits use
    no row from before it, and from its end on none of it: no curve mixes both.

    Parameters
    ----------
    settings : Settings

    Attributes
    ----------
    curve : Characteristic or None
        What later curves are judged against.
    first : Characteristic or None
        The first one, or the last that was set; wear counts from it.
    shift : Shift or None
        The last judgement.
    problem : str
        Why a curve could not be judged.
    fault_ns : int or None
        Onset of what is wrong; 0 where it is not known, None if nothing is.
    regime_ns : int
        Fits use rows from this time on.
    set_ns : int
        When the reference was set from outside last; 0 before.
    """

    def __init__(self, settings: Settings) -> None:
        self.curve: Characteristic | None = None
        self.shift: Shift | None = None
        self.problem = ''
        self.alarm = ShiftAlarm(settings)
        self.fault_ns: int | None = None
        self.regime_ns = 0
        self.set_ns = 0
        self._healthy_ns = 0  # where the regime before the fault began
        self._since_ns = 0  # since when the curve has shifted, while the alarm stands
        self.first: Characteristic | None = None
        self._candidate: tuple[int, Characteristic] | None = None
        self._worn: list[tuple[int, float]] = []

    def snapshot(self) -> State:
        """Return what is remembered. The last judgement is not."""
        candidate = self._candidate
        return {
            'curve': None if self.curve is None else to_json(self.curve),
            'problem': self.problem,
            'alarm': self.alarm.snapshot(),
            'fault_ns': self.fault_ns,
            'times_ns': [self.regime_ns, self.set_ns, self._healthy_ns, self._since_ns],
            'first': None if self.first is None else to_json(self.first),
            'candidate': None if candidate is None else [candidate[0], to_json(candidate[1])],
            'worn': [list(w) for w in self._worn],
        }

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""
        self.curve = None if saved['curve'] is None else from_json(saved['curve'])
        self.problem = saved['problem']
        self.alarm.restore(saved['alarm'])
        self.first = self.curve
        if 'times_ns' not in saved:  # of an earlier version
            return
        self.fault_ns, times = perhaps(saved, 'fault_ns', int), saved['times_ns']
        if [type(ns) for ns in times] != [int] * 4:
            raise DataError('The saved state has a time that is no number.')
        self.regime_ns, self.set_ns, self._healthy_ns, self._since_ns = times
        self.first = None if saved['first'] is None else from_json(saved['first'])
        candidate = saved['candidate']
        self._candidate = None if candidate is None else (candidate[0], from_json(candidate[1]))
        self._worn = [(int(ns), float(mw)) for ns, mw in saved['worn']]

    def set(self, curve: Characteristic, time_ns: int, settings: Settings) -> list[AlarmChange]:
        """Take ``curve`` for the plant in health, whatever was wrong.

        Later curves are judged against it, and fits get its form.
        """
        self._take(curve)
        self.set_ns, self.first, self._worn = time_ns, curve, []
        self.fault_ns, self._since_ns = None, 0
        return self.alarm.reset('There is a new reference.', time_ns, curve.model_id, settings)

    def judge(
        self,
        current: Characteristic,
        segments: Sequence[SpecialSegment],
        time_ns: int,
        settings: Settings,
    ) -> tuple[Shift | None, list[AlarmChange]]:
        """Judge a curve that was adopted; None without a reference it can be compared with.

        Parameters
        ----------
        current : Characteristic
        segments : sequence of SpecialSegment
            Those of the window, in order of time.
        time_ns : int
        settings : Settings
        """
        self.shift, self.problem = None, ''
        if self.curve is None:
            return None, []
        if self.fault_ns is None:
            # What went wrong before, and is over, is no shift of today.
            segments = [s for s in segments if s.start_ns >= self.regime_ns]
        # The reference is some days old, in which wear within its budget is no shift.
        days_ns = current.source.window_end_ns - self.curve.source.window_end_ns
        oldest_ns = 2 * round(settings.real('reference_after') * _DAY_NS)
        worn = settings.real('wear_budget') * min(max(days_ns, 0), oldest_ns) / MONTH_NS
        least = settings.real('shift_least') + worn
        limits = ShiftLimits(settings.real('shift_confidence'), least)
        try:
            self.shift = judge_shift(self.curve, current, segments, limits)
        except DataError as error:
            self.problem = str(error)
            return None, self.alarm.unjudged(
                self.problem, time_ns, current.model_id, settings
            )  # fmt: skip
        if self.shift.moved and not self.alarm.active:
            self._since_ns = self.shift.since_low_ns
        return self.shift, self.alarm.judge(self.shift, time_ns, settings)

    def follow(self, onset_ns: int | None, waits: bool, time_ns: int) -> bool:
        """Follow whether something is wrong; return whether that has just begun.

        Parameters
        ----------
        onset_ns : int or None
            Onset of what is wrong by the residual alarm or a diagnosis, None if nothing is.
        waits : bool
            An alarm has returned, and nobody has acknowledged it.
        time_ns : int
            Of the newest row.
        """
        onsets = [] if onset_ns is None else [onset_ns]
        if self.alarm.active:
            onsets.append(self._since_ns)
        if onsets:
            begins, known = self.fault_ns is None, [ns for ns in onsets if ns]
            self._healthy_ns = self.regime_ns if begins else self._healthy_ns
            self.fault_ns, self._candidate = min(known, default=0), None
            self.regime_ns = max(self._healthy_ns, self.fault_ns)
            return begins
        if self.fault_ns is not None and not waits:
            self.fault_ns, self.regime_ns = None, time_ns
        return False

    def renewed(
        self, current: Characteristic, time_ns: int, settings: Settings
    ) -> Characteristic | None:
        """Return the curve that is to be the reference from now on; None if that is as before."""
        if self.fault_ns is not None or current.source.window_start_ns < self.regime_ns:
            return None
        if self.shift is not None and self.shift.moved:
            return None  # the next curve tells whether that is an alarm
        if self.first is not None and self._beyond_budget(current, settings):
            self._candidate = None
            worn = self.curve is None or self.curve.model_id != self.first.model_id
            return self.first if worn else None
        after_ns = round(settings.real('reference_after') * _DAY_NS)
        full_ns = round(_FULL * settings.real('window_days') * _DAY_NS)
        before = self._candidate
        if before is None or time_ns - before[0] >= after_ns:
            span_ns = current.source.window_end_ns - current.source.window_start_ns
            self._candidate = (time_ns, current) if span_ns >= min(after_ns, full_ns) else None
            return None if before is None else before[1]
        return None

    def renew(
        self, curve: Characteristic, segments: Sequence[SpecialSegment], time_ns: int
    ) -> None:
        """Let a curve be the reference by itself, and note how far it is from the first one."""
        self._take(curve)
        self.first = self.first or curve
        if curve.model_id != self.first.model_id:
            found = segment_residuals(self.first, segments)
            if len(found):
                at_ns = int(np.average(found.time_ns - time_ns, weights=found.weights)) + time_ns
                worn = float(np.average(found.residual_mw, weights=found.weights))
                self._worn = [*self._worn[1 - _KEPT :], (at_ns, worn)]

    def take_chart(self, chart: ChartDesign, wander_mw: float) -> None:
        """Watch the residual of the reference by another chart; the curve stays what it was."""
        since_ns, candidate = self._candidate or (0, None)
        self.curve, self.first, candidate = (
            c and replace(c, residuals=replace(c.residuals, chart=chart, wander_mw=wander_mw))
            for c in (self.curve, self.first, candidate)
        )
        self._candidate = None if candidate is None else (since_ns, candidate)

    @property
    def wear(self) -> Wear | None:
        """Return the slow change since the first reference; None while that is not known."""
        if self.first is None or len(self._worn) < 2:
            return None
        source = self.first.source
        since_ns = (source.window_start_ns + source.window_end_ns) // 2
        months = np.array([(at_ns - since_ns) / MONTH_NS for at_ns, _ in self._worn])
        if months[-1] * MONTH_NS < _LEAST_WEAR_NS:
            return None
        mw = np.array([worn for _, worn in self._worn])
        slope = float(np.polyfit(np.append(0.0, months), np.append(0.0, mw), 1)[0])
        return Wear(since_ns, float(mw[-1]), slope)

    def _take(self, curve: Characteristic) -> None:
        self.curve, self._candidate = curve, None
        self.shift, self.problem = None, ''
        self.alarm.forget()

    def _beyond_budget(self, current: Characteristic, settings: Settings) -> bool:
        """Tell whether the curve is further from the first reference than wear may bring it."""
        assert self.first is not None
        months = (current.source.window_end_ns - self.first.source.window_end_ns) / MONTH_NS
        most = settings.real('wear_budget') * max(1.0, months) + settings.real('shift_least')
        limits = ShiftLimits(settings.real('shift_confidence'), most)
        try:
            return judge_shift(self.first, current, (), limits).moved
        except DataError:
            return False
