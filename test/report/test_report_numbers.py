# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Numbers as people read them."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.curve.characteristic import RegionDynamics
from valveflow_ros.report import words
from valveflow_ros.report.answer import dynamics_figure, dynamics_table

ANY = st.floats(allow_nan=True, allow_infinity=True)
FINITE = st.floats(-1e12, 1e12)


def value_of(text):
    return float(text.replace('−', '-').replace('\u202f', ''))


@given(ANY)
def test_no_number_reads_nan_or_inf(value):
    for text in (
        words.plain(value), words.decimals(value, 2), words.with_error(value, value),
        words.interval(value, value), words.percent(value), words.duration(abs(value)),
    ):  # fmt: skip
        assert not re.search(r'nan|inf', text)
        assert text


@given(FINITE, st.integers(1, 8))
def test_plain_keeps_the_digits_asked_for(value, digits):
    assert math.isclose(
        value_of(words.plain(value, digits)), value, rel_tol=0.6 * 10.0 ** (1 - digits)
    )


@given(st.floats(-1e5, 1e5), st.floats(1e-4, 1e3))
def test_error_decides_the_digits(value, error):
    text = words.with_error(value, error, 'MW')
    assert text.endswith(' MW')
    shown, spread = (value_of(part) for part in text.removesuffix(' MW').split(' ± '))
    half = 1.959964 * error
    assert abs(shown - value) <= 0.06 * half + 0.5
    assert math.isclose(spread, half, rel_tol=0.06) or abs(spread - half) <= 0.5


@given(st.floats(0.0, 1e9))
def test_a_duration_is_within_its_smaller_unit(seconds):
    text = words.duration(seconds)
    sizes = {'d': 86400.0, 'h': 3600.0, 'min': 60.0, 's': 1.0}
    parts = re.findall(r'([0-9.e+-]+) (d|h|min|s)\b', text)
    assert 1 <= len(parts) <= 2
    total = sum(float(n) * sizes[unit] for n, unit in parts)
    first = sizes[parts[0][1]]
    assert abs(total - seconds) <= {86400.0: 1800.0, 3600.0: 30.0, 60.0: 0.5}.get(first, 0.5)


@pytest.mark.parametrize(
    ('seconds', 'text'),
    [(0.5, '0.5 s'), (1, '1 s'), (60, '1 min'), (61, '1 min 1 s'), (863999, '10 d'),
     (90000, '1 d 1 h'), (86399, '1 d')],
)  # fmt: skip
def test_durations(seconds, text):
    assert words.duration(seconds) == text


@given(st.floats(0.0, 1.0, exclude_max=True))
def test_not_quite_all_never_reads_as_all(share):
    assert words.percent(share) != '100 %'


def test_small_things():
    assert words.percent(1.0) == '100 %'
    assert words.percent(0.99954) == '99.954 %'
    assert words.with_error(0.2397, 0.00061) == '0.2397 ± 0.0012'
    assert words.with_error(5.0, math.nan, 's') == '5.000 s'
    assert words.decimals(-0.001, 1) == '0.0'
    assert words.plain(-2.5) == '−2.500'
    assert words.interval(1245.2, 1257.9) == '1245 to 1258'
    assert words.counted(1, 'piece') == '1 piece'
    assert words.counted(2300, 'piece') == '2\u202f300 pieces'
    assert words.moment(0) == '1970-01-01 00:00:00 UTC'
    assert 'since 1970' in words.moment(2**62 * 100)


@pytest.mark.parametrize('value', [0.0, 1e-3, 12.0, 400.0])
def test_a_time_whose_error_exceeds_it_is_not_known(value):
    assert words.time_with_error(value, 1.01 * value + 1e-9, 's') == 'not known'
    for error in (0.99 * value, math.nan):
        assert words.time_with_error(value, error, 's') == words.with_error(value, error, 's')


def test_the_table_and_the_figure_of_dynamics_leave_out_what_is_not_known():
    sure = RegionDynamics(0.0, 200.0, 12.0, 2.0, 1.0, 0.5)
    unsure = replace(sure, power_from=200.0, power_to=300.0, time_constant_stderr_s=13.0)
    vague = replace(sure, delay_stderr_s=2.5)
    assert 'not known' not in dynamics_table((sure,))
    assert dynamics_table((sure, unsure)).count('not known') == 2
    assert dynamics_table((vague,)).count('not known') == 1
    assert dynamics_figure((unsure,)) is None
    figure = dynamics_figure((sure, unsure))
    assert figure is not None
    assert len(figure.traces) == 1
