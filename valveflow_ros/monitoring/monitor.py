# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The engine: it turns rows into events, without a clock, files, threads or ROS."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.curve.shift import minute
from valveflow_ros.errors import DataError, counted, listed
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.monitoring.alarms import Alarms, Judged, ResidualAlarm
from valveflow_ros.monitoring.curves import CurveStatus, Refits, RunningCurve
from valveflow_ros.monitoring.diagnosis_requests import DiagnosisRequests
from valveflow_ros.monitoring.events import (
    CurveAdopted,
    Event,
    FitRequested,
    JournalEntry,
    JournalKind,
    ReferenceSet,
    SegmentClosed,
)
from valveflow_ros.monitoring.reference import ReferenceCurve
from valveflow_ros.monitoring.rows import Correction, Corrector, Fed, Rows
from valveflow_ros.parameters import Depends, Settings, parameter
from valveflow_ros.records import IntArray, SampleTable, SpecialSegment
from valveflow_ros.segments.segmenter import NoiseLevel, Segmenter
from valveflow_ros.segments.window import RollingWindow
from valveflow_ros.signals.static_form import INTEGRATED_INPUT, StaticForm
from valveflow_ros.state import Memory, State

BY_HAND = 'asked for by hand'
BY_ITSELF = 'nothing was wrong for long enough'
IN_TIME = 'its data end before the fault'
WORN = 'the curve is further from the first reference than wear_budget allows'
OF_ITSELF = (BY_ITSELF, IN_TIME, WORN)
_OF_CHART = {'alarm_run_length', 'alarm_block', 'alarm_floor'}
# Names of the parts of a state in messages.
_PARTS = {
    'force': 'the curve', 'reference': 'the reference', 'diagnosing': 'the last diagnosis',
    'alarm': 'the residual alarm', 'part of reference': 'the alarm on its shift',
}  # fmt: skip
MIXED = 'This fit used rows from before and after the onset of a fault; the next fit does not.'


class Monitor(Memory):
    """Keep the window, the segments, the curve, the reference, the predictions and the alarms.

    Parameters
    ----------
    corrector : Corrector, optional
        Removes known causes from the rows before they are used.
    covariates : tuple of str
        Entries of the columns in `SampleTable.covariates`, which the diagnoses try as causes;
        see `signals.covariates`.

    Notes
    -----
    The state changes only by rows and by the calls `adopt`, `refuse`, `operate_alarms`,
    `request_fit`, `set_reference`, `request_diagnosis`, `restart`, `resume` and `reconfigure`, and
    those of `diagnosing`. Each such call adds a `JournalEntry` with the number of rows before it.
    Rows and journal reproduce the same events, bit for bit. `carry` starts from a state of another
    run: a recording from there on cannot be replayed alone.
    """

    REMEMBERED = (
        '_correction', '_segmenter', '_window', 'alarm', '_force', '_refits', 'reference',
        'diagnosing', 'rows', 'last_ns', '_went_back', 'judged', '_chart_due',
        '_chart_not_ns',
    )  # fmt: skip

    def __init__(
        self,
        settings: Settings,
        corrector: Corrector | None = None,
        covariates: tuple[str, ...] = (),
    ) -> None:
        self.settings = settings
        self._correction = Correction(corrector)
        self._segmenter = Segmenter(settings)
        self._window = RollingWindow.of(settings, covariates)
        self.alarm = ResidualAlarm(settings)
        self._force = RunningCurve(settings)
        # rows, last_ns: number of rows taken so far, and time of the newest; 0 before the first
        self.rows = 0
        self.last_ns = 0
        self._went_back = False
        self._chart_due = False  # the chart parameters have changed
        self._chart_not_ns: int | None = None  # a request from before that change
        self.judged = Judged(0, math.nan, math.nan)
        self._refits = Refits()
        self.reference = ReferenceCurve(settings)
        self._alarms = Alarms(self.alarm, self.reference.alarm)
        self.diagnosing = DiagnosisRequests(settings, self.alarm, self._journal)

    @property
    def characteristic(self) -> Characteristic | None:
        """Return the running curve: that of the last fit."""
        return self._force.characteristic

    @property
    def predicting(self) -> Characteristic | None:
        """Return the curve used for predictions: the reference, or the running one without it."""
        return self._force.predicting

    @property
    def status(self) -> CurveStatus:
        """Return the status of the running curve."""
        return self._force.status

    @property
    def cause(self) -> str:
        """Return why there is no curve, or only a stale one; empty if it is up to date."""
        return self._force.cause

    @property
    def fit_pending(self) -> bool:
        """Return True if a fit was requested and has no outcome yet."""
        return self._refits.pending_ns is not None

    @property
    def segments(self) -> int:
        """Return the number of special segments in the window."""
        return self._window.segments

    @property
    def special_samples(self) -> int:
        """Return the number of samples in the special segments."""
        return self._window.special_samples

    def special_segments(self) -> tuple[SpecialSegment, ...]:
        """Return the special segments in the window, in order of time."""
        return self._window.special_segments()

    def numbers(self) -> IntArray:
        """Return the numbers of the rows in the window, counted from the first one taken."""
        return self._window.numbers()

    def noise(self) -> NoiseLevel:
        """Return the noise levels used for the thresholds."""
        return self._segmenter.noise()

    def reconfigure(self, settings: Settings) -> list[Event]:
        """Apply settings in which only live parameters differ.

        Raises `ParameterError` if a parameter differs that cannot be changed while the monitor
        runs.
        """
        changed = self.settings.live_changes(settings)
        if not changed:
            return []
        self.settings = self.diagnosing.settings = self.reference.settings = settings
        self._alarms.configure(settings)
        self._force.configure(settings)
        if changed.keys() & _OF_CHART:
            # The next fit gives a new chart, and must not wait for new segments. A fit that is
            # already running has the old parameters.
            self._chart_due = True
            self._chart_not_ns = self._refits.pending_ns
            self._refits.count_as_new(self.segments)
        text = json.dumps(changed, sort_keys=True)
        return [self._journal(JournalKind.SETTINGS, 0, '', text)]

    def feed(self, table: SampleTable) -> Fed:
        """Take rows until their end, or until a fit or a diagnosis is requested."""
        events: list[Event] = []
        rows = Rows.of(table, self.settings.real('pressure_exponent'), self._correction)
        done = 0
        while done < len(table):
            until, by_time = self._refits.rows_until_due(table.time_ns[done:], self.settings)
            most = min(until, self.diagnosing.rows_until_look(table.time_ns[done:]))
            taken, closed = self._take(rows.part(done, done + most), events)
            done += taken
            # Decisions do not depend on the ends of blocks.
            looked = self.diagnosing.look(*self._diagnosable())
            events += looked
            asked = self._ask() if self._due(closed, by_time and taken == until) else []
            events += asked
            if asked or looked:
                break
        return Fed(done, events)

    def adopt(self, request_ns: int, characteristic: Characteristic) -> list[Event]:
        """Adopt the curve of a fit; without a reference it predicts from the next row on.

        The outcome of a request that is not pending is ignored.
        """
        if request_ns != self._refits.pending_ns:
            return []
        begun = self._follow_health()
        if characteristic.source.window_start_ns < self.reference.regime_ns:
            return [*begun, *self.refuse(request_ns, MIXED)]
        self._refits.settle(request_ns)
        self._force.adopt(characteristic, self._provisional())
        if request_ns != self._chart_not_ns:
            self._take_chart(characteristic)
        segments = self._window.special_segments()
        changes = self.reference.judge(characteristic, segments, self.last_ns)
        entry = self._journal(JournalKind.FIT_ADOPTED, request_ns, characteristic.model_id, '')
        adopted = CurveAdopted(characteristic, self.reference.shift, self._force.cause)
        events = [*begun, adopted, entry, *changes, *self._follow_health()]
        healthy = self.reference.renewed(characteristic, self.last_ns)
        if healthy is not None:
            reason = WORN if healthy is self.reference.first else BY_ITSELF
            return [*events, *self._renew(healthy, reason)]
        if self.reference.curve is None:
            self._force.predict_from(characteristic, self._window)
        return events

    def refuse(self, request_ns: int, reason: str) -> list[Event]:
        """Record that a fit gave no curve; the old one stays, as stale."""
        if not self._refits.settle(request_ns):
            return []
        begun = self._follow_health()
        if reason == MIXED:
            self._refits.count_as_new()
        self._force.refuse(reason)
        return [*begun, self._journal(JournalKind.FIT_REFUSED, request_ns, '', reason)]

    def request_fit(self) -> list[Event]:
        """Request a fit now.

        Raises `DataError` if a fit is already running, or there is nothing to fit.
        """
        if self.fit_pending:
            raise DataError('A fit is running already.')
        if not self._window.special_segments(self.reference.regime_ns):
            least = self.settings.whole('min_fit_samples')
            raise DataError(
                'There is no special segment (steady state or long ramp) to fit yet; a fit needs '
                f'{least} samples in such segments.'
            )
        return self._ask(BY_HAND)

    def request_diagnosis(self) -> list[Event]:
        """Request a diagnosis now; raises `DataError` if that is not possible."""
        return self.diagnosing.request(*self._diagnosable())

    def operate_alarms(self, action: AlarmAction, name: str | None = None) -> list[Event]:
        """Acknowledge, shelve or unshelve all alarms, or the one of a name.

        Raises `DataError` if there is no alarm of that name, or the action applies to none of
        them.
        """
        model_id = self._model_id()
        changes = self._alarms.operate(action, self.judged, model_id, name)
        entry = self._journal(JournalKind[action.name], 0, model_id, name or '')
        return [*changes, entry, *self._follow_health()]

    def set_reference(self, given: Characteristic | None = None) -> list[Event]:
        """Declare the running curve, or a given one, to be the curve of the healthy plant.

        It is used for predictions and to judge later curves. Existing faults are thereby accepted.
        A given curve is written to the journal completely, because it cannot be computed from the
        data of this run. Raises `DataError` if there is no curve, or its input u is another one.
        """
        curve = self.characteristic if given is None else given
        if curve is None:
            raise DataError(f'There is no curve that could become the reference. {self.cause}')
        changes = self.reference.set(curve, self.last_ns)
        changes += self.alarm.reset(self.last_ns, curve.model_id)
        self._predict(afresh=True)
        text = '' if given is None else json.dumps(to_json(given))
        entry = self._journal(JournalKind.SET_REFERENCE, 0, curve.model_id, text)
        return [ReferenceSet(curve), entry, *changes]

    def restart(self, reason: str) -> list[Event]:
        """Restart after the clock went back; curve, alarm and earlier rows stay.

        Rows with times after that of the next row are removed when it arrives;
        see `RollingWindow`.
        """
        pending = self._refits.pending_ns
        events: list[Event] = [] if pending is None else self.refuse(pending, reason)
        # The basis of the curve may have changed, and a running fit is lost.
        self._refits.count_as_new()
        self._correction.restart()
        self._went_back = True
        events += self.diagnosing.restart(reason)
        self._force.restart(reason)
        return [*events, self._journal(JournalKind.RESET, 0, '', reason)]

    def carry(self, saved: State, then: Settings) -> tuple[str, list[Event]]:
        """Continue from a state of the settings ``then`` or another version, as far as possible.

        Call it before the first row. A few rows may be missing in between, and the time may have
        jumped. Raises `DataError` if no part of the state can be used.

        Returns
        -------
        tuple of str and list of Event
            Sentences on what changed, was computed again or was discarded; and the journal entry
            with the parameters that changed.
        """
        changed = self.settings.changes(then)
        depends = max((parameter(n).depends for n in changed), default=Depends.NOTHING)
        lost = {'window'} if depends == Depends.ROWS else set()
        parts = self._usable(saved, lost)
        if depends == Depends.ALL or 'rows' in lost or {'window', 'force', 'reference'} <= lost:
            raise DataError('No part of it can be used.')
        if 'window' in lost:
            parts['window']['seen'] = parts['rows']
        self.restore(parts)
        curve = self.reference.curve
        if changed.keys() & {'axis', 'pressure_exponent'} and self._asks_for_another_form(curve):
            self.reference.restore(Monitor(self.settings).reference.snapshot())
            lost.add('reference')
        if depends or lost & {'window', 'segmenter'}:
            exponent = then.real('pressure_exponent')
            self._segmenter = self._window.find_segments_anew(
                self.settings, exponent, _found_before(saved)
            )
            lost.add('segmenter')
        self._chart_due = self._chart_due or bool(changed.keys() & _OF_CHART)
        if self._chart_due or lost & {'segmenter', 'refits'}:
            self._refits.count_as_new(self.segments)
        if lost & {'force', 'part of force', 'reference'}:
            self._predict()
        self._went_back = True
        text = json.dumps(changed, sort_keys=True)
        entry = [self._journal(JournalKind.SETTINGS, 0, '', text)] if changed else []
        return self._carried(self.settings.retuned(then), lost), [*entry]

    def resume(self, reason: str) -> list[Event]:
        """Request again the fit and the diagnosis that were running when the monitor ended."""
        self._refits.ask_again(self.segments)
        self.diagnosing.ask_again(reason)
        return [self._journal(JournalKind.RESUMED, 0, self._model_id(), reason)]

    def check_clock(self) -> None:
        """Raise `DataError` between a step back of the clock and the next row."""
        if self._went_back:
            raise DataError('The clock has just gone back; try again after the next sample.')

    def _take(self, rows: Rows, events: list[Event]) -> tuple[int, bool]:
        """Process rows up to the end of a segment; return their number and whether one closed."""
        segmented = self._segmenter.feed(
            rows.time_ns, rows.u, rows.power_mw, rows.temperature_degc, most=1
        )
        n = segmented.rows
        rows = rows.part(0, n)
        if self._went_back:
            self._went_back = False
            self._window.go_back(int(rows.time_ns[0]))
            self.reference.go_back(int(rows.time_ns[0]))
        self._window.append(
            rows.time_ns, rows.u, rows.power_mw, rows.temperature_degc, rows.opening_percent,
            rows.command_percent, rows.covariates,
        )  # fmt: skip
        block = self._force.predict(rows, segmented.kinds)
        self.diagnosing.watch(block, rows.temperature_degc, self.predicting)
        self.rows += n
        self.last_ns = int(rows.time_ns[-1])
        self.judged = Judged(self.last_ns, float(block.evidence[-1]), float(block.shift_mw[-1]))
        events.append(block)
        if self.predicting is not None:
            events += self._alarms.feed(block, rows.opening_percent)
        for _, found in segmented.found:
            self._window.add_segment(found)
            self._refits.segments_seen += 1
            events.append(SegmentClosed(found.segment))
        return n, bool(segmented.found)

    def _due(self, closed: bool, by_time: bool) -> bool:
        """Return True if a fit must be requested at this row."""
        if not (closed or by_time):
            return False
        segments = self._window.special_segments(self.reference.regime_ns)
        if not self._refits.due(self.last_ns, closed, by_time, self.settings, len(segments)):
            return False
        return sum(s.samples for s in segments) >= self.settings.whole('min_fit_samples')

    def _ask(self, text: str = '') -> list[Event]:
        before = self._follow_health()
        request_ns = self._refits.ask(self.last_ns)
        noise = self._segmenter.noise()
        reference = self.reference.curve
        task = FitTask(
            request_ns, self._window.contents(self.reference.regime_ns), self.settings,
            noise.input, noise.power_mw, self._correction.held,
            None if reference is None else reference.static_form, self._known_form(),
        )  # fmt: skip
        entry = self._journal(JournalKind.FIT_REQUESTED, request_ns, '', text)
        return [*before, entry, FitRequested(task)]

    def _follow_health(self) -> list[Event]:
        """Update whether there is a fault, at rows where a replay does the same."""
        named_ns = self.diagnosing.named_onset_ns(self.reference.set_ns)
        own_ns = self.alarm.onset_ns if self.alarm.active else None
        onsets = [ns for ns in (named_ns, own_ns) if ns is not None]
        waits = self.alarm.standing or self.reference.alarm.standing
        begins = self.reference.follow(min(onsets, default=None), waits, self.last_ns)
        curve = self.characteristic
        if begins and self.reference.curve is None and curve is not None:
            return self._renew(curve, IN_TIME)
        return []

    def _renew(self, curve: Characteristic, reason: str) -> list[Event]:
        segments = self._window.special_segments(self.reference.regime_ns)
        self.reference.renew(curve, segments, self.last_ns)
        self._predict()
        entry = self._journal(JournalKind.SET_REFERENCE, 0, curve.model_id, reason)
        return [ReferenceSet(curve), entry]

    def _predict(self, *, afresh: bool = False) -> None:
        """Predict from the reference, or from the running curve if the reference has no chart."""
        reference = self.reference.curve
        limit = self.settings.real('alarm_limit') > 0.0
        judges = reference is not None and (limit or reference.residuals.chart is not None)
        curve = reference if judges else self.characteristic or reference
        if curve is not None:
            self._force.predict_from(curve, self._window, afresh=afresh)

    def _take_chart(self, curve: Characteristic) -> None:
        """Give the reference the control chart of a new curve, if the chart parameters changed.

        The chart of a provisional curve does not describe the healthy plant.
        """
        chart = curve.residuals.chart
        if self._chart_due and chart is not None and self.reference.fault_ns is None:
            self._chart_due = False
            self.reference.take_chart(chart, curve.residuals.wander_mw)
            if self.reference.curve is not None:
                self._predict()

    def _usable(self, saved: State, lost: set[str]) -> State:
        """Return the valid parts of a state; the others are empty, and are added to ``lost``."""
        corrector = self._correction.corrector
        empty = Monitor(self.settings, corrector).snapshot()
        pieces = {
            'force': {'predictor': None},
            'diagnosing': {'mismatch': empty['diagnosing']['mismatch']},
            'reference': {'alarm': empty['reference']['alarm']},
        }
        if 'window' in lost:
            lost |= {'refits', 'correction'}
        parts = dict(empty)
        for key in empty.keys() - lost:
            given = saved.get(key)
            tries = [(given, '')] if key in saved else []
            if key in pieces and isinstance(given, dict):
                tries.append(({**given, **pieces[key]}, f'part of {key}'))
            for part, without in tries:
                if _fits(Monitor(self.settings, corrector), {**empty, key: part}):
                    parts[key] = part
                    lost |= {without} - {''}
                    break
            else:
                lost.add(key)
        return parts

    def _asks_for_another_form(self, curve: Characteristic | None) -> bool:
        axis, exponent = self.settings.text('axis'), self.settings.real('pressure_exponent')
        if curve is None or axis == 'auto':
            return False
        if axis == INTEGRATED_INPUT:
            return curve.static_form != StaticForm(INTEGRATED_INPUT, exponent)
        return curve.axis != axis

    def _carried(self, names: Sequence[str], lost: set[str]) -> str:
        """Return sentences on what changed since a state was saved, and what was discarded."""
        told = f'Since the state was saved {listed(names)} changed.' if names else ''
        if 'window' in lost:
            told += ' The window of rows is empty and fills again.'
        elif 'window_days' in names:
            told += f' The window has {counted(len(self._window), "row")} now.'
        elif 'segmenter' in lost:
            told += f' Segments were found again in {counted(len(self._window), "row")}.'
        if gone := [words for key, words in _PARTS.items() if key in lost]:
            told += f' Discarded: {listed(gone)}.'
        there = {
            'force': self.characteristic, 'reference': self.reference.curve,
            'diagnosing': self.diagnosing.last,
        }  # fmt: skip
        stays = [_PARTS[key] for key, held in there.items() if held and key not in lost]
        if not lost & {'alarm', 'part of reference'}:
            stays.append('the alarms')
        kept = listed(stays).capitalize() or 'Nothing else'
        ending = '' if len(stays) > 1 or 'the alarms' in stays else 's'
        return f'{told} {kept} stay{ending}.'.strip()

    def _provisional(self) -> str:
        """Return which data the running curve is made from during a fault; empty without one."""
        since_ns = self.reference.fault_ns
        if since_ns is None:
            return ''
        if not since_ns:
            return (
                'Something is wrong and its onset is not known: this curve may mix data from '
                'before and after.'
            )
        return (
            f'Provisional: there is a fault since {minute(since_ns)}, and this curve '
            'is from the data since then. The alarms are judged by the reference.'
        )

    def _diagnosable(self) -> tuple[int, RollingWindow, Characteristic | None, int]:
        """Return what a diagnosis gets: with a fault, also the rows before its onset."""
        since_ns = self.reference.regime_ns if self.reference.fault_ns is None else 0
        return self.last_ns, self._window, self.predicting, since_ns

    def _known_form(self) -> StaticForm | None:
        """Return the form of the running curve if it was given in the settings or is scaled."""
        curve = self.characteristic
        if curve is None or curve.form is None:
            return None
        return curve.static_form if curve.form.told or curve.static_form.scaled else None

    def _model_id(self) -> str:
        return '' if self.characteristic is None else self.characteristic.model_id

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""
        # Earlier versions have neither these values nor a wander in their charts.
        super().restore({'chart_due': False, 'chart_not_ns': None, **saved})
        curve = self.reference.curve
        if curve is not None and math.isnan(curve.residuals.wander_mw):
            self._chart_due = True

    def _journal(
        self, kind: JournalKind, request_ns: int, model_id: str, text: str
    ) -> JournalEntry:
        return JournalEntry(self.last_ns, kind, request_ns, self.rows, model_id, text)


def _fits(fresh: Monitor, saved: State) -> bool:
    """Return True if a state fits a monitor, which must not be used afterwards."""
    try:
        fresh.restore(saved)
    except (DataError, LookupError, TypeError, ValueError, AttributeError):
        return False
    return True


def _found_before(saved: State) -> int:
    """Return the number of segments found before a state of any version."""
    segmenter = saved.get('segmenter')
    number = segmenter.get('number') if isinstance(segmenter, dict) else 0
    return number if type(number) is int else 0
