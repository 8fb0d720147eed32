# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Columns beside the signals: read, tried as causes, kept with the model; drifts without them."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from streams import needs_jit

import valveflow_ros as vf
from valveflow_ros.diagnosis.corrector import corrector_of, covariates_of
from valveflow_ros.diagnosis.result import model_from_json, model_to_json, to_json
from valveflow_ros.errors import DataError, InputError, UsageError
from valveflow_ros.interface.logs import Series, open_log, read_covariate
from valveflow_ros.records import SIGNALS, SampleTable, Signal
from valveflow_ros.signals.covariates import entry

COLUMN = 'condenser_pressure_kpa'
# The monitor diagnoses twice: after the first day, and one day later.
NIGHTLY = {
    'reference_after': 0.0, 'diagnosis_on_mismatch': False, 'refit_period': 86400.0,
    'refit_segments': 0,
}  # fmt: skip


@pytest.fixture(scope='module')
def plant():
    return vf.simulate(days=4, seed=3, unit='choked:number=3', recording='minute')


@pytest.fixture(scope='module')
def diagnosed(plant, tmp_path_factory):
    """Diagnose with the column that matters, an unrelated one and a constant."""
    frame = plant.to_dataframe()
    frame['reversed'] = frame[COLUMN].to_numpy()[::-1]
    frame['constant'] = 7.0
    path = tmp_path_factory.mktemp('covariate') / 'plant.parquet'
    frame.to_parquet(path)
    said = {'vacuum': COLUMN, 'weather': 'reversed', 'number': 'constant'}
    return vf.diagnose(path, covariates=said)


@pytest.fixture(scope='module')
def without(plant):
    return vf.diagnose(plant.to_dataframe()).diagnosis


def truth(plant):
    return plant.data.unit.vacuum_per_kpa * plant.to_dataframe()['generated_power_mw'].mean()


@needs_jit
def test_the_vacuum_is_named_with_its_size(plant, diagnosed, without):
    d = diagnosed.diagnosis
    assert not {'weather', 'number'} & {c.name for c in d.causes}
    assert dict(d.rejected)['number'].startswith('cannot be judged: constant hardly changes')
    assert any(n.startswith('Curve and alarms can leave out vacuum: give') for n in d.notes)
    (found,) = (c for c in d.causes if c.name == 'vacuum')
    b = found.parameters['b']
    assert b.unit == 'MW/kPa'
    assert b.low <= truth(plant) <= b.high
    assert b.high - b.low < 0.2 * abs(truth(plant))
    assert found.gain.rmse_after < 0.6 * found.gain.rmse_before
    assert d.rmse_extended < 0.6 * without.rmse_extended
    assert f'for every kPa that {COLUMN} (vacuum) is higher' in found.sentence
    (meaning,) = (note for note in d.notes if note.startswith('vacuum: '))
    assert f'b is its effect in MW for each kPa of {COLUMN}, at the mean load of ' in meaning
    assert 'they correct the curve by a1 (L - 1) + a2 (L - 1)^2' in meaning


@needs_jit
def test_the_model_is_kept_with_its_covariate(diagnosed):
    model = diagnosed.extended_model
    raw = model_to_json(model)
    again = model_from_json(raw)
    assert model_to_json(again) == raw
    kept = next(a.cause.covariate for a in again.model.active if a.name == 'vacuum')
    assert (kept.column, kept.unit) == (COLUMN, 'kPa')


@needs_jit
def test_a_damaged_covariate_is_refused_by_its_place(diagnosed):
    for key, value in (('spread', 0.0), ('surface', [1.0]), ('centre', [0.0, 0.0, 0.0, 1.0])):
        raw = model_to_json(diagnosed.extended_model)
        place = next(k for k, c in enumerate(raw['causes']) if c['name'] == 'vacuum')
        raw['causes'][place]['covariate'] |= {key: value}
        with pytest.raises(DataError, match=rf'causes\[{place}\]\.covariate\.{key}'):
            model_from_json(raw)


def entry_of(model):
    about = covariates_of(model)['vacuum']
    return entry('vacuum', about.column, about.unit)


def rows_of(plant):
    """Return the rows of the plant, with its column beside them."""
    frame = plant.to_dataframe()
    time_ns = frame['time'].to_numpy('datetime64[ns]').astype(np.int64)
    columns = frame.columns[1 : 1 + len(SIGNALS)]  # in the order of the signals
    signals = dict(zip(Signal, (frame[c].to_numpy() for c in columns), strict=True))
    table = SampleTable.from_columns(time_ns, signals)
    return replace(table, covariates=frame[[COLUMN]].to_numpy().copy())


@needs_jit
def test_rows_without_the_column_cannot_be_freed_of_it(diagnosed):
    model = diagnosed.extended_model
    with pytest.raises(DataError, match=f"'vacuum', which follows the column '{COLUMN}'. Name"):
        corrector_of(model, 60.0)
    with pytest.raises(DataError, match="'vacuum' is in mbar, but the model has it in kPa"):
        corrector_of(model, 60.0, (entry('vacuum', COLUMN, 'mbar'),))


@needs_jit
def test_freed_rows_do_not_depend_on_the_blocks(plant, diagnosed):
    model = diagnosed.extended_model
    rows = rows_of(plant).part(0, 3000)
    rows.covariates[500:700] = np.nan  # less than six hours
    rows.covariates[1000:1500] = np.nan  # more
    whole = corrector_of(model, 60.0, (entry_of(model),)).correct(rows)
    power = whole.column(Signal.GENERATED_POWER)
    missing = np.flatnonzero(~np.isfinite(power))
    assert missing[0] == 1000 + 6 * 60
    assert missing[-1] == 1499
    cut, parts = corrector_of(model, 60.0, (entry_of(model),)), []
    for start, end in itertools.pairwise([0, 1, 17, 600, 1200, 1420, 1421, 3000]):
        again = corrector_of(model, 60.0, (entry_of(model),))
        again.restore(cut.snapshot())
        parts.append(again.correct(rows.part(start, end)))
        cut = again
    assert SampleTable.concatenate(parts).values.tobytes() == whole.values.tobytes()


@needs_jit
def test_a_curve_and_a_monitor_without_the_weather(plant, diagnosed, tmp_path):
    """The residual shrinks as the diagnosis found; the column is found by the model's own name."""
    model, path = diagnosed.extended_model, tmp_path / 'plant.parquet'
    plant.write(path)
    plain, freed = vf.identify(path), vf.identify(path, model=model)
    rmse = [r.characteristic.residuals.rmse_mw for r in (plain, freed)]
    assert rmse[1] < 0.75 * rmse[0]
    assert [h.name for h in freed.characteristic.held] == list(model.model.names)
    told = vf.monitor(path, model=model, diagnose=False, parameters=NIGHTLY)
    assert told.curves[-1][1].residuals.rmse_mw < 0.75 * rmse[0]
    renamed = plant.to_dataframe().rename(columns={COLUMN: 'Kond'})
    again = vf.identify(renamed, model=model, covariates={'vacuum': 'Kond:kPa'})
    assert again.characteristic.pieces == freed.characteristic.pieces
    with pytest.raises(InputError, match=r'The model follows a further column\..*vacuum=Kond'):
        vf.identify(renamed, model=model)
    with pytest.raises(UsageError, match='needs a column only for a covariate of its --model'):
        vf.identify(renamed, covariates={'vacuum': 'Kond'})
    without = plant.to_dataframe().drop(columns=COLUMN)
    with pytest.raises(InputError, match=f"has no column or topic '{COLUMN}"):
        vf.identify(without, model=model)


@needs_jit
def test_without_the_column_a_drift_is_told(plant, without):
    slow = without.disturbance
    assert slow is not None
    assert slow.drift_mw is not None
    frame = plant.to_dataframe()
    line = np.polynomial.Polynomial.fit(frame['generated_power_mw'], frame[COLUMN], 3)
    apart = frame[COLUMN] - line(frame['generated_power_mw'])
    assert slow.drift_mw == pytest.approx(abs(truth(plant)) * apart.std(), rel=0.3)
    told = f'The power varies slowly over days, by about {slow.drift_mw:.2g} MW on average, '
    assert told in without.sentence
    if without.verdict == 'nothing':
        assert 'is a slow disturbance and noise' in without.sentence
    assert 'measurement is noise' not in without.sentence
    assert to_json(without)['disturbance']['drift_mw'] == slow.drift_mw
    assert not {'diurnal', 'gain_drift', 'output_offset_drift'} & {c.name for c in without.causes}


@needs_jit
def test_nothing_drifts_where_the_power_does_not_follow():
    unit = 'choked:number=3,vacuum_per_kpa=0'
    sound = vf.simulate(days=4, seed=3, unit=unit, recording='minute')
    d = vf.diagnose(sound.to_dataframe(), covariates={'vacuum': COLUMN}).diagnosis
    assert 'vacuum' not in {c.name for c in d.causes}
    assert 'slow wander' in dict(d.rejected)['vacuum']
    assert d.disturbance is None or d.disturbance.drift_mw is None


def test_a_column_is_read_as_it_stands_and_the_same_from_a_file(plant, tmp_path):
    frame = plant.to_dataframe().head(300)
    frame = frame.assign(**{'a:b': np.arange(300) * -1e9})
    for said, unit in (
        (COLUMN, 'kPa'), (f'{COLUMN}:mbar', 'mbar'), ('a:b', ''), ('a:b:bar', 'bar')
    ):  # fmt: skip
        series = read_covariate(open_log(frame), 'vacuum', said)
        assert series.unit == unit
        np.testing.assert_array_equal(series.values, frame[series.column].to_numpy())
    from_frame = read_covariate(open_log(plant.to_dataframe()), 'vacuum', COLUMN)
    for kind in ('csv', 'parquet'):
        from_file = read_covariate(open_log(plant.write(tmp_path / f'x.{kind}')), 'vacuum', COLUMN)
        np.testing.assert_array_equal(from_file.time_ns, from_frame.time_ns)
        np.testing.assert_array_equal(from_file.values, from_frame.values)


@needs_jit
def test_the_monitor_names_it_with_its_size(plant):
    """The last diagnosis over two and a half days; a column of a few hours is left out."""
    frame = plant.to_dataframe().head(3600)
    few = frame[COLUMN].where(np.arange(len(frame)) < 600)
    said = {'vacuum': COLUMN, 'short': 'few'}
    result = vf.monitor(frame.assign(few=few), parameters=NIGHTLY, covariates=said)
    found = result.diagnoses[-1][1]
    (cause,) = found['causes']
    b = cause['parameters']['b']
    assert (cause['name'], b['unit']) == ('vacuum', 'MW/kPa')
    assert b['low'] <= truth(plant) <= b['high']
    assert b['high'] - b['low'] < 0.2 * abs(truth(plant))
    (note,) = (note for note in found['notes'] if 'few' in note)
    assert note.startswith("'few' has values for only ")
    assert note.endswith('half of them are needed. short was left out.')


def test_series_are_bridged_but_not_over_gaps():
    minute = 60 * 10**9
    times = np.array([0, 1, 2, 200, 201]) * minute
    series = Series('x', '', times, np.array([0.0, 1.0, 2.0, 5.0, 6.0]))
    found = series.at(np.array([0, 30 * 10**9, 100 * minute, 201 * minute, 400 * minute]))
    np.testing.assert_allclose(found, [0.0, 0.5, np.nan, 6.0, np.nan])


def test_what_is_no_covariate_is_refused(plant, tmp_path):
    few = np.where(np.arange(1500) < 300, 1.0, np.nan)
    frame = plant.to_dataframe().head(1500).assign(words='low', few=few)
    for covariates, said in (
        ({'vacuum': 'nowhere'}, "--covariate vacuum: DataFrame has no column or topic 'nowhere'"),
        ({'diurnal': COLUMN}, "'diurnal' is a cause of the catalogue"),
        ({'a b': COLUMN}, 'letters, digits and underscores'),
        ({'words': 'words'}, "'words' of DataFrame holds no number"),
        ({'few': 'few'}, 'has values for only'),
    ):
        # The monitor leaves a column of few values out of a diagnosis, and says so.
        for verb in (vf.diagnose, vf.monitor)[: 1 if 'few' in covariates else 2]:
            with pytest.raises(InputError, match=said):
                verb(frame, covariates=covariates)
    for verb in (vf.diagnose, vf.monitor):
        with pytest.raises(InputError, match=r"covariate vacuum: .* has no column or topic '/now"):
            verb(frame, parameters={'covariates': 'vacuum=/nowhere'})
    # The columns that the log has are offered.
    kept = frame.rename(columns={COLUMN: 'vacuum'})
    kept.to_csv(tmp_path / 'a.csv', index=False)
    for source in (kept, tmp_path / 'a.csv'):
        with pytest.raises(InputError, match=r"'vacum'; it has .*: --covariate x=vacuum\."):
            vf.diagnose(source, covariates={'x': 'vacum'})
