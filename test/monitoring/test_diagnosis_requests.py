# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import blocks_of, cuts, examples

from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.diagnosis_requests import (
    ALARM,
    ASKED,
    FITS_AGAIN,
    MORE_DATA,
    NIGHTLY,
    DiagnosisRequests,
)
from valveflow_ros.monitoring.events import (
    Diagnosed,
    DiagnosisRequested,
    JournalEntry,
    JournalKind,
)
from valveflow_ros.monitoring.mismatch import Misfit
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S
from valveflow_ros.segments.window import WindowContents

HOUR_NS = 3600 * NS_PER_S
DAY_NS = 24 * HOUR_NS
MIDNIGHT_NS = 19_700 * DAY_NS
EMPTY = WindowContents(
    np.empty(0, dtype=np.int64), *(np.empty(0) for _ in range(3)), np.empty((0, 3), dtype=np.int64)
)
CURVE = SimpleNamespace(model_id='curve', place_words=str)
CONTENT = json.dumps({'verdict': 'nothing', 'sentence': 'All is well.'})
SURE = json.dumps({'verdict': 'named', 'sentence': 'It slips.', 'not_told_apart': []})
UNSURE = json.dumps({'verdict': 'named', 'sentence': 'It slips.', 'not_told_apart': ['clock']})


class Screening:
    """A `DiagnosisRequests` with a window, an alarm and a misfit that the test sets."""

    def __init__(self, **values):
        self.alarm = SimpleNamespace(active=False, raised_ns=MIDNIGHT_NS)
        self.window = SimpleNamespace(
            span_s=5 * 86400.0, contents=lambda since_ns, covariates: EMPTY
        )
        self.score, self.time_ns, self.curve = 0.0, MIDNIGHT_NS, CURVE
        settings = Settings({'mismatch_limit': 5.0, 'diagnosis_hour': 2, **values})
        self.made = DiagnosisRequests(settings, self.alarm, self.journal)
        self.made._mismatch = SimpleNamespace(
            judge=lambda place: Misfit(self.score, 'gain' if self.score else '', 'it drifts')
        )

    def journal(self, kind, request_ns, model_id, text):
        return JournalEntry(self.time_ns, kind, request_ns, 0, model_id, text)

    def run(self, times):
        """Take rows one by one; return what was said."""
        said = []
        for time_ns in times:
            self.time_ns = int(time_ns)
            self.made.rows_until_look(np.array([self.time_ns]))
            said += self.made.look(self.time_ns, self.window, self.curve)
        return said

    def asked(self):
        """Request a diagnosis by hand."""
        return self.made.request(self.time_ns, self.window, self.curve)

    def until(self, hours):
        """Take a row every ten minutes for so many hours more."""
        steps = range(1, round(6 * hours) + 1)
        return self.run([self.time_ns + k * HOUR_NS // 6 for k in steps])


def reasons(said):
    return [(e.time_ns - MIDNIGHT_NS, e.text) for e in said
            if isinstance(e, JournalEntry) and e.kind == JournalKind.DIAGNOSE]  # fmt: skip


def settle(bench, said, content=CONTENT):
    for event in said:
        if isinstance(event, DiagnosisRequested):
            bench.made.adopt(event.task.request_ns, content)
    return said


@examples(40)
@given(st.lists(st.integers(1, 9000), min_size=1, max_size=80), st.data())
def test_looks_fall_at_the_first_row_of_an_hour_however_the_stream_is_cut(steps, data):
    times = MIDNIGHT_NS + np.cumsum(steps) * NS_PER_S
    hours = [t // HOUR_NS for t in times.tolist()]
    truth = [k + 1 for k, (a, b) in enumerate(itertools.pairwise(hours)) if a != b]
    bench, looked = Screening(diagnosis_hour=-1), []
    for start, end in blocks_of(len(times), data.draw(cuts(len(times)))):
        done = start
        while done < end:
            done += bench.made.rows_until_look(times[done:end])
            before = bench.made._hour
            bench.made.look(int(times[done - 1]), bench.window, bench.curve)
            if bench.made._hour != before:
                looked.append(done - 1)
    assert looked == truth


def test_every_night_at_the_hour_of_the_samples_unless_switched_off():
    bench = Screening()
    said = []
    for _ in range(3):
        said += settle(bench, bench.until(24))
    assert reasons(said) == [((24 * k + 2) * HOUR_NS, NIGHTLY) for k in range(3)]
    assert not reasons(Screening(diagnosis_hour=-1).until(72))
    # A night in which nobody was there is made up for.
    late = Screening()
    late.run([MIDNIGHT_NS])
    assert reasons(late.run([MIDNIGHT_NS + 5 * HOUR_NS])) == [(5 * HOUR_NS, NIGHTLY)]


def test_no_second_one_is_asked_for_while_one_runs_or_within_the_pause():
    bench = Screening(diagnosis_pause=30.0)
    first = bench.until(24)
    assert len(reasons(first)) == 1
    assert bench.made.pending
    assert not reasons(bench.until(24))
    settle(bench, first)
    assert len(reasons(bench.until(24))) == 1


def test_the_alarm_asks_once_and_waits_for_the_pause():
    bench = Screening(diagnosis_hour=-1, diagnosis_pause=4.0)
    bench.until(1)
    bench.alarm.active = True
    assert reasons(settle(bench, bench.until(9), SURE)) == [(2 * HOUR_NS, ALARM)]
    bench.alarm.active = False
    bench.until(1)
    settle(bench, bench.asked(), SURE)
    bench.alarm.active = True
    (asked,) = reasons(bench.until(9))
    assert asked == (15 * HOUR_NS, ALARM)
    quiet = Screening(diagnosis_hour=-1, diagnosis_on_mismatch=False)
    quiet.alarm.active = True
    assert not reasons(quiet.until(5))


@pytest.mark.parametrize('content', [CONTENT, UNSURE])
def test_on_the_first_day_of_an_alarm_an_unsure_diagnosis_is_made_again(content):
    bench = Screening(diagnosis_hour=-1, diagnosis_pause=8.0)
    bench.alarm.active = True
    asked = []
    for _ in range(30):  # hours
        asked += reasons(settle(bench, bench.until(1), content))
    assert asked == [(1 * HOUR_NS, ALARM), *((h * HOUR_NS, MORE_DATA) for h in (9, 17))]
    bench.alarm.raised_ns = bench.time_ns
    assert len(reasons(settle(bench, bench.until(1), SURE))) == 1
    assert not reasons(bench.until(20))


NAMED = json.dumps({
    'verdict': 'named', 'not_told_apart': ['clock'],
    'causes': [{'parameters': {'t0_days': {'origin_ns': MIDNIGHT_NS - DAY_NS, 'value': 0.5}}}],
})  # fmt: skip


def taken_up(bench):
    """Return a bench with the saved state of another."""
    again = Screening()
    model = SimpleNamespace(snapshot=dict, restore=lambda saved: None)
    bench.made._mismatch = again.made._mismatch = model
    again.made.restore(bench.made.snapshot())
    return again


def test_a_diagnosis_without_a_result_takes_back_nothing_and_revives_nothing(monkeypatch):
    module = 'valveflow_ros.monitoring.diagnosis_requests'
    monkeypatch.setattr(f'{module}.to_json', lambda curve: {})
    monkeypatch.setattr(f'{module}.from_json', lambda saved: CURVE)
    bench, onset_ns = Screening(), MIDNIGHT_NS - DAY_NS // 2
    settle(bench, bench.asked(), NAMED)
    bench.time_ns += DAY_NS
    (_, asked) = bench.asked()
    bench.made.refuse(asked.task.request_ns, 'It was cancelled.')
    for made in (bench.made, taken_up(bench).made):
        assert made.named_onset_ns(0) == onset_ns
        # A reference that was set after the result accepts the cause.
        assert made.named_onset_ns(MIDNIGHT_NS + 1) is None
        assert made._found.unsure


def test_a_misfit_is_said_once_and_its_end_too():
    bench = Screening(diagnosis_hour=-1)
    bench.until(1)
    story = [4.9, -5.1, 7.0, 4.0, -3.4, 3.0, 5.2]
    said = []
    for score in story:
        bench.score = score
        said += settle(bench, bench.until(1))
    told = [e.text for e in said
            if isinstance(e, JournalEntry) and e.kind == JournalKind.MISMATCH]  # fmt: skip
    sentence = 'The model no longer fits: it drifts.'
    assert told == [sentence, FITS_AGAIN, sentence]
    assert [text for _, text in reasons(said)] == [told[0], told[2]]
    assert bench.made.sentence == told[2]


def test_what_cannot_be_diagnosed_is_said_by_hand_and_waited_for_by_itself():
    bench = Screening(diagnosis_hour=-1)
    bench.curve, bench.alarm.active = None, True
    with pytest.raises(DataError, match='no curve'):
        bench.asked()
    assert not reasons(bench.until(3))
    bench.curve, bench.window.span_s = CURVE, 86399.0
    with pytest.raises(DataError, match=r'a day of data; the window holds 24\.0 h'):
        bench.asked()
    bench.window.span_s = 86400.0
    assert len(reasons(bench.until(3))) == 1
    with pytest.raises(DataError, match='running already'):
        bench.asked()


def test_only_the_outcome_that_is_awaited_counts():
    bench = Screening()
    entry, asked = bench.asked()
    assert (entry.kind, entry.text, entry.model_id) == (JournalKind.DIAGNOSE, ASKED, 'curve')
    name = asked.task.request_ns
    assert bench.made.adopt(name + 1, CONTENT) == []
    assert bench.made.refuse(name + 1, 'Because.') == []
    told, line = bench.made.adopt(name, CONTENT)
    assert isinstance(told, Diagnosed)
    assert (told.content, told.task.window_end_ns) == (CONTENT, MIDNIGHT_NS)
    assert (line.kind, line.request_ns) == (JournalKind.DIAGNOSED, name)
    assert bench.made.adopt(name, CONTENT) == []
    assert bench.made.last is told


def test_a_clock_that_goes_back_ends_what_runs_and_names_do_not_come_again():
    bench = Screening(diagnosis_hour=-1)
    (_, first) = bench.asked()
    bench.score = 9.0
    bench.until(2)
    told, line = bench.made.restart('The clock went back.')
    assert (told.content, told.reason) == ('', 'The clock went back.')
    assert line.kind == JournalKind.DIAGNOSIS_FAILED
    assert (bench.made.pending, bench.made.sentence) == (False, '')
    bench.time_ns = MIDNIGHT_NS
    (_, second) = bench.asked()
    assert second.task.request_ns > first.task.request_ns
    assert second.task.window_end_ns == MIDNIGHT_NS
