# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Prometheus metrics of each unit, from the same snapshots as the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from valveflow_ros.page.notices import STATES
from valveflow_ros.page.unit import Shown, Snapshot
from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.terminal.board import AGE
from valveflow_ros.report.terminal.frame import OK, SampleView

_W = 1e6
# Keys in the health values that become counters: of inputs, and of the recorder.
_INPUT_COUNTS = {
    'valveflow_input_messages': ('Messages received', 'Messages of an input that were received.'),
    'valveflow_input_messages_lost': (
        'Messages lost on the way', 'Messages of an input that were lost on the way.'
    ),
}  # fmt: skip
_RECORDER_COUNTS = {
    'valveflow_recorder_messages': ('Messages written', 'Messages that were recorded.'),
    'valveflow_recorder_messages_dropped': (
        'Messages dropped', 'Messages that were not recorded because the disk was too slow.'
    ),
    'valveflow_recorder_messages_lost': (
        'Messages lost', 'Messages that were recorded and are lost.'
    ),
}  # fmt: skip


class Metrics:
    """Provides the metrics of the shown units.

    Parameters
    ----------
    shown : Shown
    counters : callable, optional
        Returns further counters of the process by name, without ``_total``, each with its help
        text and its value.
    """

    def __init__(
        self, shown: Shown, counters: Callable[[], Mapping[str, tuple[str, float]]] = dict
    ) -> None:
        self._shown = shown
        self._counters = counters
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
        units = _named(self._shown.units)
        yield from _samples(units)
        yield from _curves(units)
        yield _alarms(units)
        yield _levels(units)
        yield from _counts(units)
        for name, (about, value) in self._counters().items():
            counter = CounterMetricFamily(name, about)
            counter.add_metric([], value)
            yield counter


Named = list[tuple[str, Snapshot]]


def _named(units: tuple[Snapshot, ...]) -> Named:
    """Return the units with labels; units with the same tag also get the name of the monitor."""
    titles = [unit.title for unit in units]
    return [(u.title if titles.count(u.title) == 1 else u.key, u) for u in units]


def _gauge(name: str, about: str, values: Iterable[tuple[str, float]]) -> GaugeMetricFamily:
    found = GaugeMetricFamily(name, about, labels=['unit'])
    for unit, value in values:
        if math.isfinite(value):
            found.add_metric([unit], value)
    return found


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


def _samples(units: Named) -> Iterator[Metric]:
    present = ((name, float(unit.present)) for name, unit in units)
    yield _gauge('valveflow_monitor_up', 'Whether the monitor is running: 1 or 0.', present)
    last = [(name, unit.frame.last) for name, unit in units if unit.frame.last is not None]
    for metric, about, value in _OF_A_SAMPLE:
        yield _gauge(f'valveflow_{metric}', about, ((name, value(s)) for name, s in last))


def _curves(units: Named) -> Iterator[Metric]:
    yield _gauge('valveflow_curve_age_seconds', 'Age of the curve, in the time of the plant.',
                 ((n, _number(u, 'fit', AGE)) for n, u in units))  # fmt: skip
    curves = [(n, u.frame.curve) for n, u in units if u.frame.curve is not None]
    yield _gauge('valveflow_curve_pieces', 'Number of pieces of the curve; 0: no curve.',
                 ((n, float(max(len(c.breakpoints) - 1, 0))) for n, c in curves))  # fmt: skip
    yield _gauge('valveflow_curve_rmse_watts', 'Root mean square of the samples about the curve.',
                 ((n, c.rmse_mw * _W) for n, c in curves))  # fmt: skip


def _alarms(units: Named) -> Metric:
    found = GaugeMetricFamily(
        'valveflow_alarm_state', 'State of each alarm (ISA-18.2): 1 in the state it is in.',
        labels=['unit', 'alarm', 'state'],
    )  # fmt: skip
    for name, unit in units:
        for alarm in unit.frame.alarms:
            for k, word in enumerate(STATES):
                found.add_metric([name, alarm.name, word], float(k == alarm.state))
    return found


def _levels(units: Named) -> Metric:
    found = GaugeMetricFamily(
        'valveflow_health_level', 'Health of an item: 0 OK, 1 WARN, 2 ERROR, 3 STALE.',
        labels=['unit', 'item'],
    )  # fmt: skip
    for name, unit in units:
        known = {item.health.name: item.health.level for item in unit.items}
        if not known:
            # A recording contains no diagnostics; its readings give the state of the inputs.
            known = {f'input {item.name}': item.level for item in unit.frame.inputs}
            known['recorder'] = OK if unit.frame.recorder is None else unit.frame.recorder.level
        for item, level in known.items():
            found.add_metric([name, item], level)
    return found


def _counts(units: Named) -> Iterator[Metric]:
    for metric, (key, about) in _INPUT_COUNTS.items():
        found = CounterMetricFamily(metric, about, labels=['unit', 'input'])
        for name, unit in units:
            for item in unit.items:
                value = _float(item.values.get(key))
                if item.health.name.startswith('input ') and math.isfinite(value):
                    found.add_metric([name, item.health.name.removeprefix('input ')], value)
        yield found
    for metric, (key, about) in _RECORDER_COUNTS.items():
        counter = CounterMetricFamily(metric, about, labels=['unit'])
        for name, unit in units:
            value = _number(unit, 'recorder', key)
            if math.isfinite(value):
                counter.add_metric([name], value)
        yield counter
    samples = CounterMetricFamily('valveflow_samples', 'Samples judged.', labels=['unit'])
    for name, unit in units:
        value = _number(unit, 'fit', 'Samples taken in all runs')
        if math.isfinite(value):
            samples.add_metric([name], value)
    yield samples


def _number(unit: Snapshot, item: str, key: str) -> float:
    """Return a number of the health, NaN if missing."""
    found = next((i for i in unit.items if i.health.name == item), None)
    return math.nan if found is None else _float(found.values.get(key))


def _float(text: str | None) -> float:
    try:
        return math.nan if text is None else float(text)
    except ValueError:
        return math.nan
