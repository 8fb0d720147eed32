# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Prometheus metrics of each unit, from the same snapshots as the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from valveflow_ros.page.notices import STATES
from valveflow_ros.page.unit import Shown, Snapshot
from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.terminal.board import AGE
from valveflow_ros.report.terminal.frame import OK, SampleView

_W = 1e6
_OF_A_SAMPLE: tuple[tuple[str, str, Callable[[SampleView], float]], ...] = (
    ('sample_timestamp_seconds', 'Time of the newest sample.', lambda s: s.time_ns / NS_PER_S),
    ('power_measured_watts', 'Generated power as measured.', lambda s: s.measured_mw * _W),
    ('power_predicted_watts', 'Power that the curve predicts.',
     lambda s: (s.measured_mw - s.residual_mw) * _W),
    ('power_residual_watts', 'Measured less predicted power.', lambda s: s.residual_mw * _W),
    ('power_residual_mean_watts', 'Running mean of the residual.', lambda s: s.average_mw * _W),
    ('alarm_evidence_ratio', 'Share of its limit that a lasting shift has reached; beyond 1 or '
     '-1 the residual alarm comes.', lambda s: s.evidence),
)  # fmt: skip
# Keys in the health values that become counters: of inputs, and of other items.
_INPUT_COUNTS = (
    ('input_messages', 'Messages received', 'Messages of an input that were received.'),
    ('input_messages_lost', 'Messages lost on the way',
     'Messages of an input that were lost on the way.'),
)  # fmt: skip
_ITEM_COUNTS = (
    ('recorder_messages', 'recorder', 'Messages written', 'Messages that were recorded.'),
    ('recorder_messages_dropped', 'recorder', 'Messages dropped',
     'Messages that were not recorded because the disk was too slow.'),
    ('recorder_messages_lost', 'recorder', 'Messages lost',
     'Messages that were recorded and are lost.'),
    ('samples', 'fit', 'Samples taken in all runs', 'Samples judged.'),
)  # fmt: skip
Named = list[tuple[str, Snapshot]]


class Metrics:
    """Provides the metrics of the shown units.

    ``counters`` returns further counters of the process by name, without ``_total``, each with its
    help text and its value.
    """

    def __init__(
        self, shown: Shown, counters: Callable[[], Mapping[str, tuple[str, float]]] = dict
    ) -> None:
        self._shown, self._counters = shown, counters
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def text(self) -> bytes:
        """Return the metrics in the text format of Prometheus, UTF-8."""
        return bytes(generate_latest(self._registry))

    def describe(self) -> Iterable[Metric]:
        """Return nothing: the metrics depend on the units."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """Yield every metric; unknown numbers are left out."""
        titles = [unit.title for unit in self._shown.units]
        # Units with the same tag have the name of their monitor.
        units = [(u.title if titles.count(u.title) == 1 else u.key, u) for u in self._shown.units]
        yield from _gauges(units)
        yield from _counts(units)
        for name, (about, value) in self._counters().items():
            yield _family(CounterMetricFamily, name, about, (), [(value,)])


def _family(
    kind: Any, name: str, about: str, labels: Iterable[str], rows: Iterable[tuple[Any, ...]]
) -> Metric:
    """Return a metric from rows of the labels and the number, without those that are unknown."""
    found = kind(name, about, labels=tuple(labels))
    for *given, number in rows:
        if math.isfinite(number):
            found.add_metric(given, number)
    return found  # type: ignore[no-any-return]


def _gauges(units: Named) -> Iterator[Metric]:
    def gauge(name: str, about: str, rows: Iterable[tuple[Any, ...]], *labels: str) -> Metric:
        return _family(GaugeMetricFamily, f'valveflow_{name}', about, ('unit', *labels), rows)

    present = ((n, float(u.present)) for n, u in units)
    yield gauge('monitor_up', 'Whether the monitor is running: 1 or 0.', present)
    last = [(n, u.frame.last) for n, u in units if u.frame.last is not None]
    for name, about, value in _OF_A_SAMPLE:
        yield gauge(name, about, ((n, value(s)) for n, s in last))
    ages = ((n, _number(u, 'fit', AGE)) for n, u in units)
    yield gauge('curve_age_seconds', 'Age of the curve, in the time of the plant.', ages)
    curves = [(n, u.frame.curve) for n, u in units if u.frame.curve is not None]
    pieces = ((n, float(max(len(c.breakpoints) - 1, 0))) for n, c in curves)
    yield gauge('curve_pieces', 'Number of pieces of the curve; 0: no curve.', pieces)
    errors = ((n, c.rmse_mw * _W) for n, c in curves)
    yield gauge('curve_rmse_watts', 'Root mean square of the samples about the curve.', errors)
    states = (
        (n, alarm.name, word, float(k == alarm.state))
        for n, u in units for alarm in u.frame.alarms for k, word in enumerate(STATES)
    )  # fmt: skip
    about = 'State of each alarm (ISA-18.2): 1 in the state it is in.'
    yield gauge('alarm_state', about, states, 'alarm', 'state')
    levels = ((n, item, level) for n, u in units for item, level in _levels(u).items())
    about = 'Health of an item: 0 OK, 1 WARN, 2 ERROR, 3 STALE.'
    yield gauge('health_level', about, levels, 'item')


def _levels(unit: Snapshot) -> dict[str, int]:
    if unit.items:
        return {item.health.name: item.health.level for item in unit.items}
    # A recording contains no diagnostics; its readings give the state of the inputs.
    recorder = unit.frame.recorder
    known = {f'input {item.name}': item.level for item in unit.frame.inputs}
    return known | {'recorder': OK if recorder is None else recorder.level}


def _counts(units: Named) -> Iterator[Metric]:
    def counter(name: str, about: str, rows: Iterable[tuple[Any, ...]], *labels: str) -> Metric:
        return _family(CounterMetricFamily, f'valveflow_{name}', about, ('unit', *labels), rows)

    inputs = [
        (n, item.health.name.removeprefix('input '), item.values)
        for n, u in units for item in u.items if item.health.name.startswith('input ')
    ]  # fmt: skip
    for name, key, about in _INPUT_COUNTS:
        rows = ((n, item, _float(values.get(key))) for n, item, values in inputs)
        yield counter(name, about, rows, 'input')
    for name, item, key, about in _ITEM_COUNTS:
        yield counter(name, about, ((n, _number(u, item, key)) for n, u in units))


def _number(unit: Snapshot, item: str, key: str) -> float:
    found = next((i for i in unit.items if i.health.name == item), None)
    return math.nan if found is None else _float(found.values.get(key))


def _float(text: str | None) -> float:
    try:
        return math.nan if text is None else float(text)
    except ValueError:
        return math.nan
