# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The metrics are Prometheus', say what is known, and the board of Grafana asks for no others."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest
from monitor_recording import START_NS
from page_units import alarm, predict, shown_now, told

from valveflow_ros.page.unit import Shown, Unit

pytest.importorskip('prometheus_client', reason='the page is an extra')

from prometheus_client.parser import text_string_to_metric_families

from valveflow_ros.page.metrics import Metrics

BOARD = Path(__file__).resolve().parents[2] / 'config' / 'grafana_board.json'


def values(shown: Shown, **more) -> dict[str, dict[tuple[str, ...], float]]:
    """Return each metric as the values by their labels' contents, the unit's first."""
    found: dict[str, dict[tuple[str, ...], float]] = {}
    for family in text_string_to_metric_families(Metrics(shown, **more).text().decode()):
        for s in family.samples:
            labels = dict(s.labels)
            key = (labels.pop('unit', ''), *(labels[k] for k in sorted(labels)))
            found.setdefault(s.name, {})[key] = s.value
    return found


def test_what_is_known_of_a_unit():
    unit = told()
    alarm(unit, 2)
    found = values(shown_now(unit))
    assert found['valveflow_monitor_up'] == {('U1',): 1.0}
    assert found['valveflow_power_measured_watts'] == {('U1',): 254e6}
    assert found['valveflow_power_residual_watts'] == {('U1',): 1.5e6}
    assert found['valveflow_power_predicted_watts'][('U1',)] == pytest.approx(252.5e6)
    assert found['valveflow_alarm_evidence_ratio'] == {('U1',): 0.25}
    assert found['valveflow_sample_timestamp_seconds'][('U1',)] == START_NS / 1e9 + 199
    assert found['valveflow_curve_age_seconds'] == {('U1',): 431.5}
    assert found['valveflow_curve_pieces'] == {('U1',): 2.0}
    assert found['valveflow_input_messages_lost_total'] == {
        ('U1', 'valve_opening'): 4.0, ('U1', 'generated_power'): 0.0,
    }  # fmt: skip
    assert found['valveflow_health_level'][('U1', 'input valve_opening')] == 3.0
    states = found['valveflow_alarm_state']
    assert [key[2] for key, value in states.items() if value] == ['acknowledged']
    # 'unknown' is no number.
    assert 'valveflow_recorder_messages_dropped_total' not in found


def test_a_number_that_is_not_known_is_left_out():
    unit = Unit('/m')
    predict(unit, 0, math.nan, math.nan)
    found = values(shown_now(unit))
    assert 'valveflow_power_measured_watts' not in found
    assert found['valveflow_monitor_up'] == {('U1',): 1.0}


def test_a_monitor_that_has_gone_is_down():
    unit = told()
    shown = Shown()
    shown.put([unit.snapshot(unit.frame('m'), present=False)])
    assert values(shown)['valveflow_monitor_up'] == {('U1',): 0.0}


def test_two_units_with_the_same_tag_are_told_apart_and_labels_are_escaped():
    odd = told('/b', tag='U"2\\\n')
    found = values(shown_now(told('/a'), told('/c'), odd))
    assert set(found['valveflow_monitor_up']) == {('/a',), ('/c',), ('U"2\\\n',)}


def test_names_follow_the_rules_of_prometheus():
    unit = told()
    alarm(unit, 1)
    metrics = Metrics(shown_now(unit), lambda: {'valveflow_notices_sent': ('Sent.', 1.0)})
    for family in text_string_to_metric_families(metrics.text().decode()):
        assert re.fullmatch('valveflow(_[a-z]+)+', family.name)
        assert family.documentation.endswith('.')
        assert not re.search('_(mw|ms|percent|hours)$', family.name)
        if family.type == 'counter':
            assert all(s.name.endswith('_total') for s in family.samples)
        else:
            assert not family.name.endswith('_total')


def test_the_board_asks_for_metrics_that_there_are():
    text = BOARD.read_text()
    board = json.loads(text)
    unit = told()
    alarm(unit, 1)
    metrics = Metrics(shown_now(unit), lambda: {'valveflow_notices_failed': ('Failed.', 1.0)})
    there = set(re.findall(r'^# TYPE (\w+)', metrics.text().decode(), re.M))
    asked = {
        name
        for panel in board['panels']
        for target in panel.get('targets', ())
        for name in re.findall(r'valveflow_\w+', target['expr'])
    }
    assert len(asked) >= 8
    assert {name.removesuffix('_total') for name in asked} <= {
        name.removesuffix('_total') for name in there
    }
    assert 'http://' not in text
