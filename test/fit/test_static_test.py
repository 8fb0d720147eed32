# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A static flow test: steady rows far apart become a curve; rows that move do not."""

import numpy as np
import pandas as pd
import pytest

import valveflow_ros as vf
from valveflow_ros.errors import DataError

PRESSURE = 16.7
KNOTS = np.array([24.0, 52.0, 78.0, 100.0])
POWER = np.array([60.0, 210.0, 288.0, 306.0])


def flow_test(seed: int, rows: int = 47, noise_mw: float = 0.25, step_s: float = 60.0):
    """A table of steady rows at full pressure, the opening in any order."""
    rng = np.random.default_rng(seed)
    opening = rng.permutation(np.linspace(KNOTS[0], KNOTS[-1], rows) + rng.normal(0.0, 0.2, rows))
    opening = np.clip(opening, KNOTS[0], KNOTS[-1])
    power = np.interp(opening, KNOTS, POWER) + rng.normal(0.0, noise_mw, rows)
    return pd.DataFrame({
        'time': 1_700_000_040.0 + step_s * np.arange(rows),
        'valve_opening_percent': opening, 'main_steam_pressure_mpa': PRESSURE,
        'main_steam_temperature_degc': 538.0 + rng.normal(0.0, 0.3, rows),
        'generated_power_mw': power,
    })  # fmt: skip


@pytest.mark.parametrize('seed', [1, 2, 11])
@pytest.mark.parametrize(('rows', 'step_s'), [(47, 60.0), (90, 30.0)])
def test_three_pieces_and_their_knees_are_found(seed: int, rows: int, step_s: float) -> None:
    found = vf.identify(flow_test(seed, rows, step_s=step_s))
    c = found.characteristic
    assert len(c.pieces) == 3
    truth = KNOTS[1:-1] * PRESSURE**c.pressure_exponent
    np.testing.assert_allclose(c.breakpoints[1:-1], truth, rtol=0.02)
    assert not c.dynamics
    assert min(p.samples for p in c.pieces) >= 3
    assert any('taken as a static test' in note for note in found.notes)
    assert len(found.segments) == rows


def test_a_test_at_one_pressure_says_that_it_does_not_tell_the_form() -> None:
    """Both forms fit its rows alike, at another pressure they differ."""
    frame = flow_test(3)
    frame['main_steam_pressure_mpa'] += np.linspace(0.0, 0.4, len(frame))
    found = vf.identify(frame)
    (told,) = [n for n in found.characteristic.notes if 'at other pressures' in n]
    assert told.startswith('The pressure stayed between 16.70 and 17.10 MPa')
    assert told.replace("'", '&#x27;') in found.page().to_html()


def test_the_order_of_rows_does_not_matter() -> None:
    """Steady rows have no past."""
    frame = flow_test(5)
    mixed = frame.sample(frac=1.0, random_state=1)
    mixed['time'] = frame['time'].to_numpy()
    one, two = (vf.identify(f).characteristic for f in (frame, mixed))
    np.testing.assert_allclose(one.breakpoints, two.breakpoints, rtol=1e-6)


def test_twice_the_power_is_twice_the_curve() -> None:
    frame = flow_test(6)
    other = frame.assign(generated_power_mw=2.0 * frame['generated_power_mw'])
    one, two = (vf.identify(f).characteristic for f in (frame, other))
    np.testing.assert_allclose(one.breakpoints, two.breakpoints, rtol=1e-6)
    np.testing.assert_allclose(2.0 * one.values(), two.values(), rtol=1e-6)


@pytest.mark.parametrize(('seeds', 'most'), [(6, 1), pytest.param(20, 2, marks=pytest.mark.long)])
def test_one_line_stays_one_piece(seeds: int, most: int) -> None:
    """Noise makes no knee, but in a few tests of a straight valve."""
    more = 0
    for seed in range(seeds):
        frame = flow_test(seed)
        rng = np.random.default_rng(seed)
        line = 3.0 * frame['valve_opening_percent'] + rng.normal(0.0, 0.5, len(frame))
        more += len(vf.identify(frame.assign(generated_power_mw=line)).characteristic.pieces) > 1
    assert more <= most


def late(frame: pd.DataFrame) -> pd.Series:
    """The power of rows that follow with a lag: the misfit depends on the last move."""
    power = frame['generated_power_mw']
    return power + 0.03 * (power.shift() - power).fillna(0.0)


# A lag, a falling power, one opening, sliding pressure, no power, no relation, what does not move.
@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'generated_power_mw': late}, ''),
        ({'generated_power_mw': lambda f: 300.0 - f['generated_power_mw']}, ''),
        ({'main_steam_pressure_mpa': lambda f: np.linspace(8.0, 16.0, len(f))}, ''),
        ({'generated_power_mw': lambda f: np.nan}, ''),
        ({'generated_power_mw': lambda f: np.random.default_rng(1).permuted(f[f.columns[4]])}, ''),
        ({'valve_opening_percent': 50.0}, 'valve_opening is 50 % in all rows'),
        ({'generated_power_mw': 200.0}, 'generated_power is 200 MW in all rows'),
        ({'time': pd.Timestamp('2026-01-01', tz='UTC')}, 'Only one time, 2026-01-01 00:00:00 UTC'),
    ],
)
def test_what_is_no_static_test_is_refused(change, words) -> None:
    with pytest.raises(DataError, match=words):
        vf.identify(flow_test(1).assign(**change))


def test_an_impossible_opening_is_no_row_of_a_static_test() -> None:
    frame = flow_test(1)
    frame.loc[len(frame) - 3 :, 'valve_opening_percent'] = (140.0, 150.0, 160.0)
    found = vf.identify(frame).characteristic
    assert found.source.steady == len(frame) - 3
    assert found.breakpoints[-1] < 105.0 * frame['main_steam_pressure_mpa'].max() ** 1.125


def test_too_few_rows_are_told_in_rows() -> None:
    """The floor is told in rows of the table as read, and in time."""
    with pytest.raises(DataError, match=r'11 usable rows, .* 4 stretches of 42 rows \(42 min\)'):
        vf.identify(flow_test(1).head(11))
    rows = flow_test(1).drop(index=range(5, 12)).head(9)
    with pytest.raises(DataError, match=r'usable rows.*, at most \d without a gap\. To'):
        vf.identify(rows)
