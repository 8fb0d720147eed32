# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reference curve of the healthy plant, the rows that fits may use, and the valve wear."""

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
# A window that is full to this fraction counts as full.
_FULL = 0.9
# Wear is reported after this many days; its values are kept for this many references.
_LEAST_WEAR_NS = 20 * _DAY_NS
_KEPT = 400


class Wear(NamedTuple):
    """The slow change of the curve."""

    since_ns: int  # middle of the data of the first reference
    total_mw: float  # mean difference of the segments at the last renewal from it
    mw_per_month: float  # slope of a line through the values since then


class ReferenceCurve:
    """Keep the curve of the healthy plant, the alarm on a shift from it, and the wear.

    A curve becomes the reference automatically if no fault occurs for `reference_after` after it.
    Later curves replace it in the same way: the reference follows slow wear, but never a fault,
    and stays within `wear_budget` of the first one. During a fault, fits use only rows after its
    onset, and afterwards only rows after its end: no curve mixes both.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.curve: Characteristic | None = None  # later curves are judged against it
        self.shift: Shift | None = None  # the last judgement
        self.problem = ''  # why a curve could not be judged
        self.alarm = ShiftAlarm(settings)
        # Onset of the current fault; 0 if unknown, None if there is no fault.
        self.fault_ns: int | None = None
        self.regime_ns = 0  # fits use rows from this time on
        self.set_ns = 0  # time when the reference was last set by a user; 0 if never
        self._healthy_ns = 0  # regime_ns before the fault
        self._since_ns = 0  # onset of the curve shift, while the alarm stands
        # The first one, or the last one set by a user; wear is relative to it.
        self.first: Characteristic | None = None
        self._candidate: tuple[int, Characteristic] | None = None
        self._worn: list[tuple[int, float]] = []

    def snapshot(self) -> State:
        """Return the state, without the last judgement."""
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
        """Continue from a saved state; raises `DataError` if it does not fit."""
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

    def set(self, curve: Characteristic, time_ns: int) -> list[AlarmChange]:
        """Make ``curve`` the reference, even if there is a fault.

        Later curves are judged against it, and fits use its form.
        """
        self._take(curve)
        self.set_ns, self.first, self._worn = time_ns, curve, []
        self.fault_ns, self._since_ns = None, 0
        return self.alarm.reset(
            'There is a new reference.', time_ns, curve.model_id, self.settings
        )

    def judge(
        self, current: Characteristic, segments: Sequence[SpecialSegment], time_ns: int
    ) -> list[AlarmChange]:
        """Judge an adopted curve with the segments of the window, in order of time.

        `shift` is None without a comparable reference.
        """
        self.shift, self.problem, settings = None, '', self.settings
        if self.curve is None:
            return []
        if self.fault_ns is None:
            # A fault that is over is not a shift of the present curve.
            segments = [s for s in segments if s.start_ns >= self.regime_ns]
        # Since the date of the reference, wear within its budget is not a shift.
        days_ns = current.source.window_end_ns - self.curve.source.window_end_ns
        oldest_ns = 2 * round(settings.real('reference_after') * _DAY_NS)
        worn = settings.real('wear_budget') * min(max(days_ns, 0), oldest_ns) / MONTH_NS
        least = settings.real('shift_least') + worn
        limits = ShiftLimits(settings.real('shift_confidence'), least)
        try:
            self.shift = judge_shift(self.curve, current, segments, limits)
        except DataError as error:
            self.problem = str(error)
            return self.alarm.unjudged(self.problem, time_ns, current.model_id, settings)
        if self.shift.moved and not self.alarm.active:
            # The latest possible time: a curve of rows since then has none of the healthy plant.
            self._since_ns = self.shift.since_high_ns
        return self.alarm.judge(self.shift, time_ns, settings)

    def follow(self, onset_ns: int | None, waits: bool, time_ns: int) -> bool:
        """Update whether there is a fault at the newest row; return True if it has just begun.

        ``onset_ns`` is that of a fault found by the residual alarm or a diagnosis, None if there
        is none; ``waits`` if an alarm has returned and is not acknowledged.
        """
        onsets = [] if onset_ns is None else [onset_ns]
        if self.alarm.active:
            onsets.append(self._since_ns)
        if onsets:
            # A later onset is of the clock before it went back: now it is unknown.
            begins, known = self.fault_ns is None, [ns for ns in onsets if 0 < ns <= time_ns]
            self._healthy_ns = self.regime_ns if begins else self._healthy_ns
            self.fault_ns, self._candidate = min(known, default=0), None
            self.regime_ns = max(self._healthy_ns, self.fault_ns)
            return begins
        if self.fault_ns is not None and not waits:
            self.fault_ns, self.regime_ns = None, time_ns
        return False

    def go_back(self, time_ns: int) -> None:
        """Let fits use the rows from ``time_ns`` on, to which the clock went back."""
        self.regime_ns = min(self.regime_ns, time_ns)
        self._healthy_ns = min(self._healthy_ns, time_ns)

    def renewed(self, current: Characteristic, time_ns: int) -> Characteristic | None:
        """Return the curve that becomes the reference now; None if the reference stays."""
        if self.fault_ns is not None or current.source.window_start_ns < self.regime_ns:
            return None
        if self.shift is not None and self.shift.moved:
            return None  # the next curve decides whether this is an alarm
        settings = self.settings
        if self.first is not None and self._beyond_budget(self.first, current):
            self._candidate = None
            worn = self.curve is None or self.curve.model_id != self.first.model_id
            return self.first if worn else None
        after_ns = round(settings.real('reference_after') * _DAY_NS)
        if not after_ns:
            return None
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
        """Make a curve the reference automatically, and store its distance from the first one."""
        self._take(curve)
        self.first = self.first or curve
        if curve.model_id != self.first.model_id:
            found = segment_residuals(self.first, segments)
            if len(found):
                at_ns = int(np.average(found.time_ns - time_ns, weights=found.weights)) + time_ns
                worn = float(np.average(found.residual_mw, weights=found.weights))
                self._worn = [*self._worn[1 - _KEPT :], (at_ns, worn)]

    def take_chart(self, chart: ChartDesign, wander_mw: float) -> None:
        """Use another control chart for the residual of the reference; the curve stays."""
        since_ns, candidate = self._candidate or (0, None)
        self.curve, self.first, candidate = (
            c and replace(c, residuals=replace(c.residuals, chart=chart, wander_mw=wander_mw))
            for c in (self.curve, self.first, candidate)
        )
        self._candidate = None if candidate is None else (since_ns, candidate)

    @property
    def wear(self) -> Wear | None:
        """Return the slow change since the first reference; None if not yet known."""
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

    def _beyond_budget(self, first: Characteristic, current: Characteristic) -> bool:
        settings = self.settings
        months = (current.source.window_end_ns - first.source.window_end_ns) / MONTH_NS
        most = settings.real('wear_budget') * max(1.0, months) + settings.real('shift_least')
        limits = ShiftLimits(settings.real('shift_confidence'), most)
        try:
            return judge_shift(first, current, (), limits).moved
        except DataError:
            return False
