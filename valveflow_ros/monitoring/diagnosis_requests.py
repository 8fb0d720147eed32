# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""When the model is said not to fit, when a diagnosis is asked for, and what came of it.

Decisions fall at the first row of each hour of the samples' own time, so that neither a clock nor
the cutting of the stream has a part in them.
"""

from __future__ import annotations

import hashlib
import json
import math
from typing import Protocol

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarms import ResidualAlarm
from valveflow_ros.monitoring.events import (
    Diagnosed,
    DiagnosisRequested,
    DiagnosisTask,
    Event,
    JournalEntry,
    JournalKind,
)
from valveflow_ros.monitoring.mismatch import NOTHING, Misfit, Mismatch
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray
from valveflow_ros.segments.window import NO_ROWS, RollingWindow
from valveflow_ros.state import State, perhaps

ASKED = 'asked for by hand'
NIGHTLY = 'nightly'
ALARM = 'the residual alarm was raised'
FITS_AGAIN = 'The model fits again.'
LEAST_S = 86400.0
_HOUR_NS = 3600 * NS_PER_S
_DAY_NS = 24 * _HOUR_NS
# The model is said to fit again below this share of the limit.
_RETURN = 0.7


class Journal(Protocol):
    """Writes a line of the journal at the boundary at hand."""

    def __call__(
        self, kind: JournalKind, request_ns: int, model_id: str, text: str
    ) -> JournalEntry:
        """Return the line."""


class DiagnosisRequests:
    """Watches whether the model fits, asks for diagnoses, and keeps the last one.

    Parameters
    ----------
    settings : Settings
    alarm : ResidualAlarm
        While it is raised the power has left the curve.
    journal : Journal

    Attributes
    ----------
    misfit : Misfit
        The statistic that spoke loudest at the last look.
    sentence : str
        Why the model is said to fit no longer; empty while it fits.
    last : Diagnosed or None
        What the last diagnosis gave.
    """

    def __init__(self, settings: Settings, alarm: ResidualAlarm, journal: Journal) -> None:
        self.settings = settings
        self._journal = journal
        self._mismatch = Mismatch(settings.real('sample_period'))
        self.misfit: Misfit = NOTHING
        self.sentence = ''
        self.last: Diagnosed | None = None
        self._onset_ns: int | None = None
        # A curve makes its model anew each time it is asked, and rows come one by one.
        self._model: tuple[Characteristic, RegionalModel] | None = None
        self._hour: int | None = None
        self._night: int | None = None
        self._night_before: int | None = None
        self._asked_ns: int | None = None
        self._named_ns = 0
        self._wanted = ''
        self._alarm, self._raised = alarm, False
        self._pending: DiagnosisTask | None = None

    @property
    def pending(self) -> bool:
        """Tell whether a diagnosis was asked for and its outcome is awaited."""
        return self._pending is not None

    def named_onset_ns(self, reference_ns: int) -> int | None:
        """Return when a cause set in that the last diagnosis names; None if there is none.

        What was diagnosed before there was the reference is part of it.
        """
        if self.last is None or self.last.task.window_end_ns <= reference_ns:
            return None
        return self._onset_ns

    def watch(
        self, block: PredictionBlock, temperature_degc: FloatArray, curve: Characteristic | None
    ) -> None:
        """Take rows that the curve predicted."""
        if curve is None:
            return
        if self._model is None or self._model[0] is not curve:
            self._model = curve, curve.model
        self._mismatch.feed(block, temperature_degc, self._model[1])

    def rows_until_look(self, time_ns: IntArray) -> int:
        """Return how many rows to take until the first one of another hour is among them."""
        if self._hour is None:
            self._hour = int(time_ns[0]) // _HOUR_NS
            self._night = self._night_of(int(time_ns[0]))
        due = int(np.searchsorted(time_ns, (self._hour + 1) * _HOUR_NS, side='left'))
        return min(due + 1, len(time_ns))

    def look(
        self, time_ns: int, window: RollingWindow, curve: Characteristic | None, since_ns: int = 0
    ) -> list[Event]:
        """Look at a boundary; where it is the first of an hour, judge and ask.

        Parameters
        ----------
        time_ns : int
            Of the newest row.
        window : RollingWindow
        curve : Characteristic or None
        since_ns : int
            Rows before are of no concern any more.
        """
        hour = time_ns // _HOUR_NS
        if hour == self._hour:
            return []
        self._hour = hour
        events = self._judge()
        night = self._night_of(time_ns)
        another = night not in (self._night, self._night_before)
        tonight = another and self.settings.whole('diagnosis_hour') >= 0
        self._night = night
        reason = self._wanted or (NIGHTLY if tonight else '')
        if (
            reason and self._may_ask(time_ns)
            and not self._objection(time_ns, window, curve, since_ns)
        ):  # fmt: skip
            events += self._ask(reason, time_ns, window, curve, since_ns)
        return events

    def request(
        self, time_ns: int, window: RollingWindow, curve: Characteristic | None, since_ns: int = 0
    ) -> list[Event]:
        """Ask for a diagnosis now.

        Raises
        ------
        DataError
            One is running, there is no curve, or there is less than a day of data.
        """
        objection = self._objection(time_ns, window, curve, since_ns)
        if objection:
            raise DataError(objection)
        return self._ask(ASKED, time_ns, window, curve, since_ns)

    def adopt(self, request_ns: int, content: str) -> list[Event]:
        """Take a result; ``content`` is what `diagnosis.json` would hold."""
        task = self._settle(request_ns)
        if task is None:
            return []
        self.last, self._onset_ns = Diagnosed(task, content, ''), _onset_ns(content)
        mark = hashlib.sha256(content.encode()).hexdigest()[:12]
        kind, model_id = JournalKind.DIAGNOSED, task.curve.model_id
        return [self.last, self._journal(kind, request_ns, model_id, mark)]

    def refuse(self, request_ns: int, reason: str) -> list[Event]:
        """Note that a diagnosis gave no result."""
        task = self._settle(request_ns)
        if task is None:
            return []
        self.last = Diagnosed(task, '', reason)
        kind, model_id = JournalKind.DIAGNOSIS_FAILED, task.curve.model_id
        return [self.last, self._journal(kind, request_ns, model_id, reason)]

    def snapshot(self) -> State:
        """Return what is remembered. Of a task no rows are."""
        last, pending = self.last, self._pending
        return {
            'mismatch': self._mismatch.snapshot(),
            'misfit': [self.misfit.score, self.misfit.name, self.misfit.hint],
            'sentence': self.sentence,
            'last': None if last is None else [_plain(last.task), last.content, last.reason],
            'hour': self._hour,
            'night': self._night,
            'night_before': self._night_before,
            'asked_ns': self._asked_ns,
            'named_ns': self._named_ns,
            'wanted': self._wanted,
            'raised': self._raised,
            'pending': None if pending is None else _plain(pending),
        }

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""
        self._mismatch.restore(saved['mismatch'])
        self.misfit, self.sentence = Misfit(*saved['misfit']), saved['sentence']
        last, pending = perhaps(saved, 'last', list), perhaps(saved, 'pending', dict)
        self.last = None if last is None else Diagnosed(self._task(last[0]), last[1], last[2])
        self._onset_ns = None if last is None or not last[1] else _onset_ns(last[1])
        self._pending = None if pending is None else self._task(pending)
        self._hour, self._night, self._night_before, self._asked_ns, self._named_ns = (
            perhaps(saved, name, int)
            for name in ('hour', 'night', 'night_before', 'asked_ns', 'named_ns')
        )
        self._wanted, self._raised = saved['wanted'], saved['raised']

    def _task(self, plain: State) -> DiagnosisTask:
        return DiagnosisTask(
            plain['request_ns'], NO_ROWS, self.settings, from_json(plain['curve']),
            plain['window_end_ns'],
        )  # fmt: skip

    def ask_again(self, reason: str) -> None:
        """Wait no longer for the diagnosis that was asked for, and ask at the next look."""
        if self._pending is not None:
            self._pending, self._asked_ns, self._wanted = None, None, reason

    def give_up(self, reason: str) -> list[Event]:
        """Wait no longer for the diagnosis that was asked for."""
        return [] if self._pending is None else self.refuse(self._pending.request_ns, reason)

    def restart(self, reason: str) -> list[Event]:
        """Forget the rows after the clock went back; names go on."""
        events = self.give_up(reason)
        self._mismatch = Mismatch(self.settings.real('sample_period'))
        self.misfit, self.sentence, self._wanted = NOTHING, '', ''
        # Should the clock come again, it is no other night for that.
        self._night_before, self._hour, self._night = self._night, None, None
        return events

    def _judge(self) -> list[Event]:
        """Say that the model fits no longer, or does again; the alarm has said so itself."""
        if self._alarm.active and not self._raised:
            self._want(ALARM)
        self._raised = self._alarm.active
        self.misfit = self._mismatch.judge()
        limit = self.settings.real('mismatch_limit')
        share = abs(self.misfit.score) / limit
        if not self.sentence and share > 1.0:
            self.sentence = _sentence(self.misfit, limit)
            self._want(self.sentence)
            return [self._journal(JournalKind.MISMATCH, 0, '', self.sentence)]
        if self.sentence and share < _RETURN:
            self.sentence = ''
            return [self._journal(JournalKind.MISMATCH, 0, '', FITS_AGAIN)]
        return []

    def _want(self, reason: str) -> None:
        """Have a diagnosis as soon as there can be one."""
        if self.settings.flag('diagnosis_on_mismatch'):
            self._wanted = reason

    def _night_of(self, time_ns: int) -> int:
        """Return the number of the day, days beginning at the hour of the diagnosis."""
        return (time_ns - self.settings.whole('diagnosis_hour') * _HOUR_NS) // _DAY_NS

    def _may_ask(self, time_ns: int) -> bool:
        pause_ns = round(self.settings.real('diagnosis_pause') * _HOUR_NS)
        # The clock may have gone back behind the last one.
        return self._asked_ns is None or not 0 <= time_ns - self._asked_ns < pause_ns

    def _objection(
        self, time_ns: int, window: RollingWindow, curve: Characteristic | None, since_ns: int
    ) -> str:
        """Return why there can be no diagnosis, empty if there can."""
        if self.pending:
            return 'A diagnosis is running already.'
        if curve is None:
            return 'There is no curve to diagnose yet.'
        span_s = min(window.span_s, (time_ns - since_ns) / NS_PER_S)
        if span_s < LEAST_S:
            hours = span_s / 3600.0
            return f'A diagnosis needs a day of data; the window holds {hours:.1f} h.'
        return ''

    def _ask(
        self, reason: str, time_ns: int, window: RollingWindow, curve: Characteristic | None,
        since_ns: int,
    ) -> list[Event]:  # fmt: skip
        assert curve is not None
        # After the clock went back names must not come again.
        self._named_ns = max(time_ns, self._named_ns + 1)
        self._asked_ns, self._wanted = time_ns, ''
        task = DiagnosisTask(
            self._named_ns, window.contents(since_ns), self.settings, curve, time_ns
        )
        self._pending = task.without_data()
        entry = self._journal(JournalKind.DIAGNOSE, task.request_ns, curve.model_id, reason)
        return [entry, DiagnosisRequested(task)]

    def _settle(self, request_ns: int) -> DiagnosisTask | None:
        """Take an outcome; None if it was not awaited."""
        task = self._pending
        if task is None or task.request_ns != request_ns:
            return None
        self._pending = None
        return task


def _sentence(misfit: Misfit, limit: float) -> str:
    """Say why the model is said to fit no longer."""
    size = math.floor(10.0 * abs(misfit.score)) / 10.0
    return (
        f'The model no longer fits: {misfit.hint} (statistic: {misfit.name}, '
        f'{size:g} standard errors, limit {limit:g}).'
    )


def _onset_ns(content: str) -> int | None:
    """Return when the first of the named causes that set in at some moment did so."""
    try:
        found = [
            e['origin_ns'] + round(e['value'] * _DAY_NS)
            for cause in json.loads(content)['causes']
            for e in cause['parameters'].values()
            if e.get('origin_ns') is not None and e['value'] is not None
        ]
    except (ValueError, TypeError, KeyError, AttributeError):
        return None  # of another version
    return min(found, default=None)


def _plain(task: DiagnosisTask) -> State:
    """Return a task without its rows as plain values."""
    return {
        'request_ns': task.request_ns,
        'curve': to_json(task.curve),
        'window_end_ns': task.window_end_ns,
    }
