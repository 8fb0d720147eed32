"""What the health says of the curve and of its reference."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from valveflow_ros.curve.characteristic import Characteristic, Support
from valveflow_ros.curve.shift import judge_shift
from valveflow_ros.fit.result import NOT_REFINED
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.ros.node.diagnostics import Item, Level
from valveflow_ros.ros.node.health import fit_item, reference_item

SETTINGS = Settings({'refit_period': 3600.0, 'refit_segments': 0, 'alarm_limit': 500.0})
WORKER: Any = SimpleNamespace(failures_in_a_row=0, busy_s=None, starts=1)
STRAIGHT = f'{NOT_REFINED}one straight piece, without dynamics.'
ALONE = 'Piece 1 (u 1000 to 1400) rests on no special sample.'


@pytest.fixture(scope='module')
def monitor() -> Monitor:
    made = Monitor(SETTINGS)
    feed_rows(made, simulate(0.3, 7).table)
    return made


def said_of(monitor: Monitor, notes: tuple[str, ...], identifiable: bool = True) -> Item:
    """Return what is said of the running curve with other notes."""
    curve = monitor.characteristic
    assert curve is not None
    support = (Support(1, 1, 100, (1200.0,), identifiable),)
    source = replace(curve.source, temperature_flag=False)
    other = replace(curve, notes=notes, support=support, source=source)
    seen: Any = SimpleNamespace(
        characteristic=other, noise=monitor.noise, status=monitor.status, rows=monitor.rows,
        segments=1, special_samples=100, last_ns=monitor.last_ns, cause='',
    )  # fmt: skip
    item = fit_item(seen, WORKER, 1.0)
    assert item.values['Notes'] == ' '.join(notes)
    return item


def test_a_weak_curve_says_so(monitor: Monitor) -> None:
    assert said_of(monitor, ()).level == Level.OK
    assert said_of(monitor, ('Manual step test: 19 of 19 levels count.',)).level == Level.OK
    for notes, identifiable in (((STRAIGHT,), True), ((ALONE,), False)):
        item = said_of(monitor, notes, identifiable)
        assert (item.level, item.sentence) == (Level.WARN, notes[0])
    both = said_of(monitor, ('Read so.', STRAIGHT, ALONE), identifiable=False)
    assert (both.level, both.sentence) == (Level.WARN, f'{STRAIGHT} Weak points in all: 2.')


def lifted(curve: Characteristic, by_mw: float) -> Characteristic:
    pieces = tuple(replace(p, intercept=p.intercept + by_mw) for p in curve.pieces)
    return replace(curve, pieces=pieces, model_id='lifted')


def test_an_alarm_whose_range_left_the_window_says_so(monitor: Monitor) -> None:
    curve = monitor.characteristic
    assert curve is not None
    monitor.set_reference(curve)
    keeper, alarm = monitor.reference, monitor.reference.alarm
    keeper.shift = judge_shift(curve, lifted(curve, 9.0))
    alarm.judge(keeper.shift, 1, SETTINGS)
    assert reference_item(monitor).sentence == keeper.shift.sentence
    knot = curve.pieces[-1].u_from
    keeper.shift = judge_shift(curve, replace(curve, pieces=curve.pieces[-1:]))
    assert alarm.judge(keeper.shift, 2, SETTINGS) == []
    item = reference_item(monitor)
    assert item.level == Level.ERROR
    assert item.sentence.startswith('The alarm stands: what moved, u ')
    assert f'to {knot:.0f}, is not judged unmoved yet' in item.sentence
