# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Decide when the model no longer fits and when to request a diagnosis, and keep the result.

Decisions are made at the first row of each hour in the time of the samples, so that they depend
neither on a clock nor on how the stream is split into blocks.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from typing import NamedTuple

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
MORE_DATA = 'more data since the residual alarm'
FITS_AGAIN = 'The model fits again.'
LEAST_S = 86400.0
_HOUR_NS = 3600 * NS_PER_S
_DAY_NS = 24 * _HOUR_NS
# Below this fraction of the limit the model fits again.
_RETURN = 0.7
# What is remembered as numbers.
_NUMBERS = 'hour', 'night', 'night_before', 'asked_ns', 'named_ns'


# Writes a line of the journal at the current row: kind, request_ns, model_id, text.
Journal = Callable[[JournalKind, int, str, str], JournalEntry]


class _Now(NamedTuple):
    """What a diagnosis at the newest row gets; earlier rows than ``since_ns`` are not used."""

    time_ns: int
    window: RollingWindow
    curve: Characteristic | None
    since_ns: int


class _Found(NamedTuple):
    """What the last diagnosis with a result said; one without a result leaves it as it is."""

    window_end_ns: int = 0
    onset_ns: int | None = None
    unsure: bool = False  # it named no cause, or not one alone


class DiagnosisRequests:
    """Check whether the model fits, request diagnoses, and keep the last one.

    While ``alarm`` is raised, the power differs from the curve.
    """

    def __init__(self, settings: Settings, alarm: ResidualAlarm, journal: Journal) -> None:
        self.settings = settings
        self._journal = journal
        self._mismatch = Mismatch(settings.real('sample_period'))
        self.misfit: Misfit = NOTHING  # the largest statistic at the last check
        self.sentence = ''  # why the model no longer fits; empty while it fits
        self.last: Diagnosed | None = None  # the outcome of the last diagnosis
        self._found = _Found()
        # `curve.model` creates a new object at each access, and rows arrive one by one.
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
        """Return True if a diagnosis was requested and has no outcome yet."""
        return self._pending is not None

    def named_onset_ns(self, reference_ns: int) -> int | None:
        """Return the onset of the cause named by the last result; None if there is none.

        Diagnoses from before the current reference are ignored: it includes their causes.
        """
        return None if self._found.window_end_ns <= reference_ns else self._found.onset_ns

    def watch(
        self, block: PredictionBlock, temperature_degc: FloatArray, curve: Characteristic | None
    ) -> None:
        """Process rows that the curve predicted."""
        if curve is None:
            return
        if self._model is None or self._model[0] is not curve:
            self._model = curve, curve.model
        self._mismatch.feed(block, temperature_degc, self._model[1])

    def rows_until_look(self, time_ns: IntArray) -> int:
        """Return how many rows to take up to and including the first one of another hour."""
        if self._hour is None:
            self._hour = int(time_ns[0]) // _HOUR_NS
            self._night = self._night_of(int(time_ns[0]))
        due = int(np.searchsorted(time_ns, (self._hour + 1) * _HOUR_NS, side='left'))
        return min(due + 1, len(time_ns))

    def look(
        self, time_ns: int, window: RollingWindow, curve: Characteristic | None, since_ns: int = 0
    ) -> list[Event]:
        """At the first row of an hour, judge the model and request a diagnosis if needed.

        ``time_ns`` is that of the newest row; rows before ``since_ns`` are not used.
        """
        hour = time_ns // _HOUR_NS
        if hour == self._hour:
            return []
        self._hour = hour
        events = self._judge(curve)
        night = self._night_of(time_ns)
        another = night not in (self._night, self._night_before)
        tonight = another and self.settings.whole('diagnosis_hour') >= 0
        self._night = night
        reason = self._wanted or (NIGHTLY if tonight else '')
        if not reason and self._found.unsure and self._young(time_ns):
            reason = MORE_DATA
        now = _Now(time_ns, window, curve, since_ns)
        if reason and self._may_ask(time_ns) and not self._objection(now):
            events += self._ask(reason, now)
        return events

    def request(
        self, time_ns: int, window: RollingWindow, curve: Characteristic | None, since_ns: int = 0
    ) -> list[Event]:
        """Request a diagnosis now.

        Raises `DataError` if one is running, there is no curve, or there is less than a day of
        data.
        """
        now = _Now(time_ns, window, curve, since_ns)
        if objection := self._objection(now):
            raise DataError(objection)
        return self._ask(ASKED, now)

    def adopt(self, request_ns: int, content: str) -> list[Event]:
        """Accept a result; ``content`` is the content of `diagnosis.json`."""
        task = self._settle(request_ns)
        if task is None:
            return []
        self.last, self._found = Diagnosed(task, content, ''), _found(task, content)
        mark = hashlib.sha256(content.encode()).hexdigest()[:12]
        return [self.last, self._entry(JournalKind.DIAGNOSED, task, mark)]

    def refuse(self, request_ns: int, reason: str) -> list[Event]:
        """Record that a diagnosis gave no result."""
        task = self._settle(request_ns)
        if task is None:
            return []
        self.last = Diagnosed(task, '', reason)
        return [self.last, self._entry(JournalKind.DIAGNOSIS_FAILED, task, reason)]

    def _entry(self, kind: JournalKind, task: DiagnosisTask, text: str) -> JournalEntry:
        return self._journal(kind, task.request_ns, task.curve.model_id, text)

    def snapshot(self) -> State:
        """Return the state. Tasks are stored without their rows."""
        last, pending = self.last, self._pending
        return {
            'mismatch': self._mismatch.snapshot(),
            'misfit': [self.misfit.score, self.misfit.name, self.misfit.hint],
            'sentence': self.sentence,
            'last': None if last is None else [_plain(last.task), last.content, last.reason],
            'found': list(self._found),
            **{name: getattr(self, f'_{name}') for name in _NUMBERS},
            'wanted': self._wanted,
            'raised': self._raised,
            'pending': None if pending is None else _plain(pending),
        }

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""
        self._mismatch.restore(saved['mismatch'])
        self.misfit, self.sentence = Misfit(*saved['misfit']), saved['sentence']
        last, pending = perhaps(saved, 'last', list), perhaps(saved, 'pending', dict)
        self.last = None if last is None else Diagnosed(self._task(last[0]), last[1], last[2])
        if 'found' in saved:
            self._found = _Found(*saved['found'])
            kinds = [type(v) for v in self._found]
            if kinds not in ([int, int, bool], [int, type(None), bool]):
                raise DataError("The saved state has 'found' of another kind.")
        elif self.last is not None and self.last.content:  # of an earlier version
            self._found = _found(self.last.task, self.last.content)
        self._pending = None if pending is None else self._task(pending)
        for name in _NUMBERS:
            setattr(self, f'_{name}', perhaps(saved, name, int))
        self._wanted, self._raised = saved['wanted'], saved['raised']

    def _task(self, plain: State) -> DiagnosisTask:
        return DiagnosisTask(
            plain['request_ns'], NO_ROWS, self.settings, from_json(plain['curve']),
            plain['window_end_ns'],
        )  # fmt: skip

    def ask_again(self, reason: str) -> None:
        """Cancel the pending diagnosis, and request another one at the next check."""
        if self._pending is not None:
            self._pending, self._asked_ns, self._wanted = None, None, reason

    def give_up(self, reason: str) -> list[Event]:
        """Cancel the pending diagnosis."""
        return [] if self._pending is None else self.refuse(self._pending.request_ns, reason)

    def restart(self, reason: str) -> list[Event]:
        """Forget all rows after the clock went back; names continue."""
        events = self.give_up(reason)
        self._mismatch = Mismatch(self.settings.real('sample_period'))
        self.misfit, self.sentence, self._wanted = NOTHING, '', ''
        # If the clock jumps forward again, this does not count as another night.
        self._night_before, self._hour, self._night = self._night, None, None
        return events

    def _judge(self, curve: Characteristic | None) -> list[Event]:
        """Report that the model no longer fits, or fits again; the alarm reports itself."""
        if self._alarm.active and not self._raised:
            self._want(ALARM)
        self._raised = self._alarm.active
        self.misfit = NOTHING if curve is None else self._mismatch.judge(curve.place_words)
        limit = self.settings.real('mismatch_limit')
        share = abs(self.misfit.score) / limit
        if not self.sentence and share > 1.0:
            self.sentence = f'The model no longer fits: {self.misfit.hint}.'
            self._want(self.sentence)
            return [self._journal(JournalKind.MISMATCH, 0, '', self.sentence)]
        if self.sentence and share < _RETURN:
            self.sentence = ''
            return [self._journal(JournalKind.MISMATCH, 0, '', FITS_AGAIN)]
        return []

    def _young(self, time_ns: int) -> bool:
        """Return True on the first day of the residual alarm, when every hour adds loads."""
        wanted = self._alarm.active and self.settings.flag('diagnosis_on_mismatch')
        # The clock may have gone back to before the alarm, by more than a day.
        return wanted and 0 <= time_ns - self._alarm.raised_ns < _DAY_NS

    def _want(self, reason: str) -> None:
        if self.settings.flag('diagnosis_on_mismatch'):
            self._wanted = reason

    def _night_of(self, time_ns: int) -> int:
        """Return the number of the day, where days begin at the hour of the diagnosis."""
        return (time_ns - self.settings.whole('diagnosis_hour') * _HOUR_NS) // _DAY_NS

    def _may_ask(self, time_ns: int) -> bool:
        pause_ns = round(self.settings.real('diagnosis_pause') * _HOUR_NS)
        # The clock may have gone back to before the last request.
        return self._asked_ns is None or not 0 <= time_ns - self._asked_ns < pause_ns

    def _objection(self, now: _Now) -> str:
        """Return why a diagnosis is not possible; empty if it is."""
        if self.pending:
            return 'A diagnosis is running already.'
        if now.curve is None:
            return 'There is no curve to diagnose yet.'
        span_s = min(now.window.span_s, (now.time_ns - now.since_ns) / NS_PER_S)
        if span_s < LEAST_S:
            hours = span_s / 3600.0
            return f'A diagnosis needs a day of data; the window holds {hours:.1f} h.'
        return ''

    def _ask(self, reason: str, now: _Now) -> list[Event]:
        assert now.curve is not None
        # After the clock went back names must not repeat.
        self._named_ns = max(now.time_ns, self._named_ns + 1)
        self._asked_ns, self._wanted = now.time_ns, ''
        contents = now.window.contents(now.since_ns, covariates=True)
        task = DiagnosisTask(self._named_ns, contents, self.settings, now.curve, now.time_ns)
        self._pending = task.without_data()
        return [self._entry(JournalKind.DIAGNOSE, task, reason), DiagnosisRequested(task)]

    def _settle(self, request_ns: int) -> DiagnosisTask | None:
        """Accept an outcome and return its task; None if it was not expected."""
        task = self._pending
        if task is None or task.request_ns != request_ns:
            return None
        self._pending = None
        return task


def _found(task: DiagnosisTask, content: str) -> _Found:
    return _Found(task.window_end_ns, onset_ns(content), _is_unsure(content))


def _is_unsure(content: str) -> bool:
    """Return True if a `diagnosis.json` names no cause, or one that others fit nearly as well."""
    try:
        found = json.loads(content)
        return found['verdict'] != 'named' or bool(found['not_told_apart'])
    except (ValueError, KeyError, TypeError):
        return False


def onset_ns(content: str) -> int | None:
    """Return the earliest onset of the causes in `diagnosis.json`; None if none has an onset."""
    try:
        found = [
            e['origin_ns'] + round(e['value'] * _DAY_NS)
            for cause in json.loads(content)['causes']
            for e in cause['parameters'].values()
            if e.get('origin_ns') is not None and e['value'] is not None
        ]
    except (ValueError, TypeError, KeyError, AttributeError):
        return None  # content of another version
    return min(found, default=None)


def _plain(task: DiagnosisTask) -> State:
    """Return a task without its rows as plain values."""
    curve = to_json(task.curve)
    return {'request_ns': task.request_ns, 'curve': curve, 'window_end_ns': task.window_end_ns}
