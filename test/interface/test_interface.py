# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``import valveflow_ros as vf``: the verbs as functions, DataFrames in and out, results."""

import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from extended_file import write_extended
from streams import needs_jit

import valveflow_ros as vf
from valveflow_ros.cli.main import main
from valveflow_ros.curve.shift import minute
from valveflow_ros.errors import DataError, InputError, RecordingError, UsageError
from valveflow_ros.logs import write_table
from valveflow_ros.logs.mcap.importing import write_readings
from valveflow_ros.records import SIGNALS, SampleTable, Signal, table_to_readings
from valveflow_ros.report.words import moment, percent

QUICK = {'refine': False, 'selection_rule': 'paper'}
JUNE_NS = 1_717_200_000 * 10**9


HEAVY = {'numpy', 'numba', 'scipy', 'pandas', 'pyarrow', 'plotly', 'yaml'}


class Heard(vf.Progress):
    """What was told, in its order."""

    def __init__(self):
        self.shares, self.words, self.said = [], [], []

    def __call__(self, share, what):
        self.shares.append(share)
        self.words.append(what)

    def say(self, sentence):
        self.said.append(sentence)


@pytest.fixture(scope='module')
def identified(log):
    return vf.identify(log)


def test_the_package_loads_nothing_before_it_is_asked():
    code = 'import sys, valveflow_ros as vf; dir(vf); print(*sys.modules)'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert not HEAVY & set(done.stdout.split())


def test_what_it_offers_is_listed_and_there():
    assert set(vf.__all__) <= set(dir(vf))
    for name in vf.__all__:
        assert getattr(vf, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'identity'"):
        _ = vf.identity


class TestLog:
    def test_a_dataframe_comes_back_as_it_was(self, simulation):
        frame = simulation.to_dataframe().head(5000)
        frame.loc[100:120, 'generated_power_mw'] = np.nan
        back = vf.open_log(frame).to_dataframe()
        assert list(back) == list(frame)
        assert back['time'].tolist() == frame['time'].tolist()
        for info in SIGNALS:
            np.testing.assert_array_equal(back[info.column], frame[info.column])

    def test_between_two_times_it_is_the_log_of_these_rows(self, simulation):
        frame = simulation.to_dataframe().head(3000)
        start, end = (frame['time'].iloc[k] for k in (1000, 1999))
        log = vf.open_log(frame)
        part = log.between(start.value, end.value).to_dataframe()
        pd.testing.assert_frame_equal(part, vf.open_log(frame.iloc[1000:2000]).to_dataframe())
        assert len(log.between(None, end.value).to_dataframe()) == 2000
        with pytest.raises(InputError, match='no readings between these times'):
            log.between(end.value + 10**15, None)

    def test_order_time_kinds_and_gaps_of_a_dataframe(self, simulation):
        frame = simulation.to_dataframe().head(60)
        want = vf.open_log(frame).to_dataframe()
        stamps = frame['time']
        for times in (
            stamps.dt.tz_localize(None), stamps.dt.tz_convert('Asia/Tokyo'),
            stamps.map(lambda t: t.isoformat()), stamps.astype('int64') / 1e9,
        ):  # fmt: skip
            told = frame.assign(time=times).sample(frac=1.0, random_state=3)
            pd.testing.assert_frame_equal(vf.open_log(told).to_dataframe(), want)
        indexed = vf.open_log(frame.set_index('time')).to_dataframe()
        pd.testing.assert_frame_equal(indexed, want)
        late = frame.astype({'time': object})
        late.loc[7, 'time'] = None
        assert len(vf.open_log(late).to_dataframe()) == 59

    def test_columns_constants_and_units(self, simulation):
        frame = simulation.to_dataframe().head(100).drop(columns='main_steam_temperature_degc')
        frame['P'] = 10.0 * frame.pop('main_steam_pressure_mpa') - 1.01325
        log = vf.open_log(
            frame, columns={'main_steam_pressure': 'P:barg'},
            constants={'main_steam_temperature': '1004:degF'},
        )  # fmt: skip
        back, want = log.to_dataframe(), simulation.to_dataframe().head(100)
        np.testing.assert_allclose(
            back['main_steam_pressure_mpa'], want['main_steam_pressure_mpa'], atol=1e-9
        )
        assert back['main_steam_temperature_degc'].tolist() == pytest.approx([540.0] * 100)

    @pytest.mark.parametrize(('unit', 'asks'), [('', True), (':MW', False), (':t/h', False)])
    def test_an_output_without_unit_beside_a_constant_pressure_may_be_a_flow(
        self, simulation, unit, asks
    ):
        frame = simulation.to_dataframe().head(100).drop(columns='main_steam_pressure_mpa')
        frame['FT'], heard = frame.pop('generated_power_mw'), Heard()
        heard.warn = heard.said.append
        vf.open_log(
            frame, columns={'generated_power': f'FT{unit}'},
            constants={'main_steam_pressure': 1.0}, progress=heard,
        )  # fmt: skip
        told = [s for s in heard.said if '--column generated_power=FT:t/h' in s]
        assert len(told) == asks

    def test_a_file_and_its_dataframe_are_the_same_log(self, simulation, tmp_path):
        write_table(simulation.data.table.part(0, 1000), tmp_path / 'a.parquet')
        frame = pd.read_parquet(tmp_path / 'a.parquet')
        frame['valve_opening_percent_quality'] = np.uint8([0, 1] * 500)  # keeps its mark
        frame.to_parquet(tmp_path / 'a.parquet')
        file, there = vf.open_log(tmp_path / 'a.parquet'), vf.open_log(frame)
        for name in ('time_ns', 'signal', 'value', 'quality'):
            np.testing.assert_array_equal(
                getattr(file.readings, name), getattr(there.readings, name)
            )
        assert (file.name, there.name) == ('a.parquet', 'DataFrame')
        marks = there.to_dataframe()['valve_opening_percent_quality']
        assert marks.tolist() == [0, 1] * 500

    def test_what_cannot_be_read_is_one_sentence(self, simulation):
        frame = simulation.to_dataframe().head(10)
        for given, options, error, said in (
            (frame.assign(time=None), {}, DataError, 'no row with a time'),
            (frame, {'columns': {'valve_opening': 'V'}}, InputError, "no column 'V'"),
            (frame, {'columns': {'generated_power': 'generated_power_mw:stone'}}, InputError,
             "Unit 'stone'"),
            (frame, {'constants': {'main_steam_pressure': 160}}, UsageError, 'impossible'),
            (frame, {'time_zone': 'Europe/Nowhere'}, UsageError, 'not known'),
            (frame[['valve_opening_percent']], {}, InputError, "no column 'time'"),
            (frame[['time']], {}, DataError, 'none of the columns valve_opening_percent'),
            ('nowhere.mcap', {}, RecordingError, 'no such file'),
        ):  # fmt: skip
            with pytest.raises(error, match=said):
                vf.open_log(given, **options)


@needs_jit
class TestIdentify:
    def test_it_is_the_verb(self, simulation, tmp_path):
        log = str(simulation.write(tmp_path / 'plant.parquet'))
        pairs = [word for k, v in QUICK.items() for word in ('--set', f'{k}={str(v).lower()}')]
        assert main(['identify', log, '-o', str(tmp_path / 'verb'), '--quiet', *pairs]) == 0
        found = vf.identify(log, parameters=QUICK)
        done = found.write(tmp_path / 'call')
        for name in ('characteristic.json', 'report.html'):
            assert (tmp_path / 'call' / name).read_text() == (tmp_path / 'verb' / name).read_text()
        assert done.files['report.html'] == tmp_path / 'call' / 'report.html'
        told = json.loads((tmp_path / 'call' / 'characteristic.json').read_text())
        assert told == found.to_json()
        read = vf.load_characteristic(tmp_path / 'call')
        assert read.model_id == found.characteristic.model_id
        assert read.pieces == found.characteristic.pieces

    def test_a_picture_is_a_plotly_figure(self, identified):
        figure = identified.plot()
        assert len(figure.data) > 2
        assert 'token:' not in figure.to_json()
        assert identified.plot('signals') != figure
        with pytest.raises(InputError, match="no picture 'nothing'; it has: curve"):
            identified.plot('nothing')

    def test_a_curve_of_before_and_after_a_change_is_told_to_be_a_mixture(self):
        # Means over a minute; the thermal unit shares no formula with the curve.
        step, told = 'gain_step:g=-0.02,t0_days=2', 0
        for number in (451, 452):
            unit = f'choked:number={number}'
            record = vf.simulate(4.0, number - 444, [step], unit=unit, recording='minute')
            notes = vf.identify(record.log).notes
            for sentence in [n for n in notes if 'mixture of before and after' in n]:
                onset = re.search(r'since about (\S+ \S+) UTC it gives ([\d.]+) MW less', sentence)
                away = pd.Timestamp(onset[1], tz='UTC') - record.to_dataframe()['time'][0]
                assert abs(away - pd.Timedelta(days=2)) < pd.Timedelta(hours=6)
                assert 2.0 < float(onset[2]) < 9.0  # 2 % of 130 to 330 MW, and days of weather
                told += 1
        assert told == 2

    @pytest.mark.parametrize(('lost', 'least'), [
        (9.0, 6.0),
        # A large one leaves a misfit within a piece, which is no slow variation.
        pytest.param(25.0, 15.0, marks=pytest.mark.long),
    ])  # fmt: skip
    def test_so_is_one_of_a_valve_that_fails_at_the_loads_that_need_it(
        self, identified, lost, least
    ):
        fails = f'curve_step:s_mw={-lost},u_from=1500,u_to=1700,t0_days=1.5'
        record = vf.simulate(3.0, 461, [fails])
        said = vf.identify(record.log).data.mixture
        found = re.search(r'since about (\S+ \S+) UTC it gives ([\d.]+) MW less at 2\d\d', said)
        away = pd.Timestamp(found[1], tz='UTC') - record.to_dataframe()['time'][0]
        assert abs(away - pd.Timedelta(days=1.5)) < pd.Timedelta(hours=12)
        assert least < float(found[2]) < 1.2 * lost
        assert not identified.data.mixture

    @pytest.mark.long
    def test_days_of_a_sound_valve_are_no_mixture(self):
        assert not vf.identify(vf.simulate(3.0, 461).log).data.mixture

    def test_what_does_not_go_is_refused(self, log):
        for options, error, said in (
            ({'parameters': {'time_constnt': 3}}, InputError, "did you mean 'time_constant'"),
            ({'step_test': True}, DataError, 'no step test'),
            ({'model': 3}, UsageError, 'must be ExtendedModel, or the path of one; it is int'),
            ({'reference': 3}, UsageError, 'must be Characteristic, or the path of one; it is'),
        ):
            with pytest.raises(error, match=said):
                vf.identify(log, **options)

    def test_progress_and_messages_are_heard(self, simulation):
        heard = Heard()
        frame = simulation.to_dataframe()[::10]
        found = vf.identify(frame, parameters=QUICK, progress=heard)
        assert heard.shares == sorted(heard.shares)
        assert any('a value every 10 s' in sentence for sentence in heard.said)
        assert set(heard.said) & set(found.notes)

    def test_nothing_is_replaced_if_a_file_cannot_be_written(self, identified, tmp_path):
        (tmp_path / 'characteristic.json').write_text('mine')
        (tmp_path / 'report.html').mkdir()
        with pytest.raises(RecordingError, match='cannot be written into'):
            identified.write(tmp_path)
        assert (tmp_path / 'characteristic.json').read_text() == 'mine'
        assert sorted(p.name for p in tmp_path.glob('*.draft')) == []

    def test_results_are_there_before_pictures_are_drawn(self, identified, tmp_path, monkeypatch):
        def fail(_figure):
            raise MemoryError

        monkeypatch.setattr('valveflow_ros.report.figure.figure_csv', fail)
        with pytest.raises(MemoryError):
            identified.write(tmp_path, tables=True)
        assert (tmp_path / 'characteristic.json').is_file()
        assert (tmp_path / 'report.html').is_file()

    def test_that_plotly_is_missing_is_told_before_any_work(self, tmp_path, monkeypatch, capsys):
        (tmp_path / 'log.mcap').write_bytes(b'cannot even be read')
        monkeypatch.setattr('valveflow_ros.report.page.find_spec', lambda name: None)
        assert main(['identify', str(tmp_path / 'log.mcap'), '-o', str(tmp_path / 'o')]) == 1
        assert 'pip install plotly' in capsys.readouterr().err
        assert not (tmp_path / 'o').exists()


@needs_jit
def test_a_curve_is_held_against_other_days(log, identified, tmp_path):
    found = vf.validate(log, identified.characteristic, parameters=QUICK)
    assert found.to_json()['model'] == identified.characteristic.model_id
    # The result that has the curve does as well as the curve.
    assert vf.validate(log, identified, parameters=QUICK).to_json() == found.to_json()
    for shown in (found, identified, log):  # in a notebook
        assert len(repr(shown)) < 500
        assert 'array' not in repr(shown)
    assert found.validation.overall.segments > 5
    assert len(found.plot().data) > 0
    names = set(found.write(tmp_path).files)
    assert names == {'validation.json', 'segments.csv', 'report.html'}
    assert json.loads((tmp_path / 'validation.json').read_text()) == found.to_json()
    with pytest.raises(UsageError, match='The model is a curve over V p'):
        vf.validate(log, identified.characteristic, parameters={'pressure_exponent': 1.0})
    with pytest.raises(UsageError, match='leave the parameter axis out'):
        vf.compare(log, parameters={'axis': 'opening'})
    with pytest.raises(DataError, match='DataFrame'):
        vf.compare(vf.open_log(log.to_dataframe().head(1)))


@needs_jit
class TestMonitor:
    @pytest.fixture(scope='class')
    @classmethod
    def heard(cls):
        return Heard()

    @pytest.fixture(scope='class')
    @classmethod
    def told(cls, heard):
        faulty = vf.simulate(1.2, 5, effects=['gain_step:g=-0.05,t0_days=0.8']).to_dataframe()
        return vf.monitor(faulty[::10], parameters={**QUICK, 'refit_segments': 40}, progress=heard)

    def test_without_diagnoses_no_parameter_asks_for_one(self, simulation):
        frame = simulation.to_dataframe().head(3000)
        asked = {'diagnosis_hour': 3, 'diagnosis_on_mismatch': True}
        settings = vf.monitor(frame, parameters=asked, diagnose=False).settings
        assert settings.whole('diagnosis_hour') == -1
        assert not settings.flag('diagnosis_on_mismatch')

    def test_progress_follows_the_rows_and_names_each_fit_and_diagnosis(self, told, heard):
        assert heard.shares == sorted(heard.shares)
        assert max(np.diff(heard.shares)) < 0.3
        assert heard.shares[-1] == pytest.approx(0.95)
        (at, _), first = told.diagnoses[0], told.curves[0][0]
        assert f'diagnosis 1, data up to {minute(at)}' in heard.words
        fits = [what for what in heard.words if what.startswith('fit ')]
        assert len(fits) >= len(told.curves)
        assert f'data up to {minute(first)}' in ' '.join(fits)
        assert heard.words[-1].startswith('monitoring, data up to ')

    def test_curves_alarms_and_predictions(self, told):
        content = told.to_json()
        assert (content['format'], content['version']) == ('valveflow/monitor', 1)
        assert [c['model_id'] for c in content['curves']] == [c.model_id for _, c in told.curves]
        assert len(content['curves']) > 3
        for entry in content['curves']:
            assert entry['window_from'] < entry['window_to'] <= entry['adopted']
        assert {a['name'] for a in content['alarms']} >= {'residual'}
        for alarm in content['alarms']:
            assert told.start_ns < alarm['raised'] <= told.end_ns
            assert alarm['cleared'] is None or alarm['cleared'] >= alarm['raised']
            assert alarm['sentence'].endswith('.')
        # A diagnosis that is not sure is repeated with more data.
        assert {tuple(d['causes']) for d in content['diagnoses']} == {('gain_step',)}
        # What went wrong leaves the curve of before as the reference.
        first = min(a['raised'] for a in content['alarms'])
        assert content['reference']['set'] >= first
        assert content['reference']['model_id'] in [c['model_id'] for c in content['curves']]
        columns = told.predictions()
        assert len({len(column) for column in columns.values()}) == 1
        assert len(columns['time_ns']) == 1.2 * 8640
        assert np.isfinite(columns['residual_mw']).any()

    def test_report_and_picture(self, told, tmp_path):
        assert set(told.write(tmp_path).files) == {'monitor.json', 'report.html'}
        page = (tmp_path / 'report.html').read_text()
        parts = [
            'The answer', 'How near the residual came to an alarm', 'How the curve moved',
            'What the monitor said',
        ]  # fmt: skip
        places = [page.index(f'<h2>{part}</h2>') for part in parts]
        assert places == sorted(places)
        # What stands at the end and the named cause come before any picture.
        answer = page[places[0] : places[1]]
        standing = [a for a in told.to_json()['alarms'] if a['cleared'] is None]
        assert standing
        for alarm in standing:
            assert f'<b>{alarm["name"].replace("_", " ")}</b>' in answer
        assert 'gain_step: ' in answer
        assert told.diagnoses[-1][1]['sentence'].split('<')[0][:60] in answer
        model_id = told.to_json()['reference']['model_id']
        assert f'is curve {model_id}, from data of 20' in told.reference_words
        assert len(told.plot('alarms').data) > 0

    def test_how_near_an_alarm_was_is_told_without_the_alarm_itself(self, told):
        rows, (alarm, *_) = told.predictions(), told.to_json()['alarms']
        assert (alarm['name'], alarm['cleared']) == ('residual', None)
        at, share = told.largest_evidence
        assert told.to_json()['largest_evidence'] == {'time': at, 'share': share}
        evidence = np.abs(rows['evidence'])
        assert evidence[np.flatnonzero(rows['time_ns'] == at)[0]] == share
        assert at < alarm['raised']
        assert 0.0 < share < 1.0 < np.nanmax(evidence)
        words = told.evidence_words
        assert f'at most {percent(share)} of its limit, at {moment(at)}.' in words
        page = told.page().to_html()
        assert words in page
        # Evidence that did not last has its own sentence.
        early = [e for e in told.events if getattr(e, 'name', '') != 'residual']
        without = replace(told, events=tuple(early))
        assert without.largest_evidence[1] > 1.0
        assert 'but not for alarm_on_delay (15 min).' in without.evidence_words

    def test_a_model_and_a_reference_go_with_it(self, log, identified, tmp_path):
        model = write_extended(tmp_path / 'model.json', output_offset_drift={'b_mw': 8.0})
        given = {**QUICK, 'refit_segments': 8}
        told = vf.monitor(
            log, diagnose=False, parameters=given, model=model,
            reference=identified.characteristic,
        )  # fmt: skip
        model_id = identified.characteristic.model_id
        assert told.to_json()['reference'] == {'set': told.start_ns, 'model_id': model_id}
        assert len(told.curves) > 1
        assert f'is curve {model_id}, from data of 20' in told.reference_words
        for _, curve in told.curves:
            assert [h.name for h in curve.held] == ['output_offset_drift']

    def test_a_log_without_power_is_refused(self, simulation):
        frame = simulation.to_dataframe().head(5000).assign(generated_power_mw=np.nan)
        with pytest.raises(DataError, match='generated_power has no usable value'):
            vf.monitor(frame, diagnose=False)


def test_a_simulation_is_written_with_its_truth(tmp_path):
    plant = vf.simulate(0.01, 3, effects=['gain_drift:g=0.02'])
    assert len(plant.data) == 864
    assert plant.write(tmp_path / 'a.csv', truth=tmp_path / 't.json') == tmp_path / 'a.csv'
    assert json.loads((tmp_path / 't.json').read_text()) == plant.to_json()
    back = vf.open_log(tmp_path / 'a.csv').to_dataframe()
    pd.testing.assert_frame_equal(back, plant.log.to_dataframe())
    with pytest.raises(RecordingError, match='exists already'):
        plant.write(tmp_path / 'a.csv')
    with pytest.raises(InputError, match='more than 0'):
        vf.simulate(-1.0)
    with pytest.raises(InputError, match="Did you mean 'gain_drift'"):
        vf.simulate(1.0, effects=['gain_drif'])
    for given, said in (
        ({'unit': 'chocked'}, "There is no unit 'chocked': use one of paper, choked, "),
        ({'recording': 'minute'}, "The paper's unit is recorded once a second only"),
        ({'unit': 'choked', 'effects': ['exponent']}, 'no meaning on the unit'),
    ):
        with pytest.raises(InputError, match=said):
            vf.simulate(0.01, 1, **given)


class TestOtherUnits:
    @pytest.mark.parametrize(
        ('name', 'kept'),
        [('a.csv', '1s'), ('a.parquet', 'compressed:resample_s=5'), ('a.mcap', 'minute')],
    )
    def test_what_is_written_is_what_was_kept(self, tmp_path, name, kept):
        plant = vf.simulate(0.05, 3, unit='sequence', recording=kept)
        plant.write(tmp_path / name, truth=tmp_path / 't.json')
        assert json.loads((tmp_path / 't.json').read_text()) == plant.to_json()
        back = vf.open_log(tmp_path / name).to_dataframe()
        pd.testing.assert_frame_equal(back, plant.log.to_dataframe())

    def test_values_with_their_own_times_are_written_and_no_empty_cell_is(self, tmp_path):
        plant = vf.simulate(0.05, 3, unit='choked', recording='compressed')
        frame = plant.to_dataframe()
        plant.write(tmp_path / 'a.mcap')
        readings = vf.open_log(tmp_path / 'a.mcap').recorded
        assert np.isfinite(readings.value).all()
        for info in SIGNALS:
            mine = readings.signal == info.signal
            kept = frame[info.column].dropna()
            np.testing.assert_array_equal(np.sort(readings.value[mine]), np.sort(kept))
        plant.write(tmp_path / 'a.csv')
        table = pd.read_csv(tmp_path / 'a.csv')
        assert table['main_steam_pressure_mpa'].isna().mean() > 0.3

    @pytest.mark.parametrize(
        ('unit', 'seed'), [
            ('choked:number=1', 1),
            pytest.param('sequence:number=9', 21, marks=pytest.mark.long),
            pytest.param('integrated_input:number=3', 3, marks=pytest.mark.long),
        ],
    )  # fmt: skip
    def test_a_compressed_log_is_identified(self, tmp_path, unit, seed):
        plant = vf.simulate(8, seed, unit=unit, recording='compressed')
        plant.write(tmp_path / 'a.csv')
        found = vf.identify(tmp_path / 'a.csv')
        truth = plant.data.truth
        opening, pressure = truth.plug[::60], truth.pressure[::60]
        error = found.characteristic.power(opening, pressure) - plant.static_power(
            opening, pressure
        )
        assert np.sqrt(np.nanmean(error**2)) < 1.6
        assert np.isfinite(error).mean() > 0.95
        said = ' '.join(found.notes)
        assert 'The log is compressed by exception: valve_opening typically every ' in said
        assert 'from changes of 2 MW on' in said
        assert 'The log has a value every' not in said
        # Held pressures make m uncertain: no interval is claimed for it.
        exponent = [n for n in found.characteristic.notes if 'The exponent m' in n]
        assert len(exponent) == 1
        assert all('cannot be judged in this log' in note for note in exponent)
        refused = {n for c in found.data.counts.values() for r, n in c.items() if r != 'accepted'}
        assert refused == {0}

    @pytest.mark.parametrize('kind', [
        'sequence', pytest.param('choked', marks=pytest.mark.long),
        pytest.param('integrated_input', marks=pytest.mark.long),
    ])  # fmt: skip
    def test_half_a_day_of_a_sliding_unit_gets_the_right_form(self, kind):
        plant = vf.simulate(0.5, 604, unit=f'{kind}:number=604')
        curve, truth = vf.identify(plant.log).characteristic, plant.data.truth
        opening, pressure = truth.plug[::60], truth.pressure[::60]
        error = curve.power(opening, pressure) - plant.static_power(opening, pressure)
        assert np.nanstd(error) < 1.0

    def test_a_change_is_not_dated_in_a_compressed_log(self):
        unit = {'unit': 'choked:number=41', 'recording': 'compressed'}
        reference = vf.identify(vf.simulate(2.5, 8, **unit).log).characteristic
        changed = vf.simulate(2.5, 108, ['gain_step:g=-0.03,t0_days=0'], start_ns=JUNE_NS, **unit)
        shift = vf.identify(changed.log, reference=reference).data.shift
        assert shift.moved
        assert shift.since_ns == 0
        assert 'since when is not known' in shift.sentence

    def test_the_truth_tells_form_and_static_power(self):
        plant = vf.simulate(0.01, 3, ['backlash'], unit='choked:number=4', recording='minute')
        truth = plant.to_json()
        assert (truth['form'], truth['recording']['recording']) == ('opening', 'minute')
        assert truth['pressure_scale_exponent'] == truth['pressure_exponent']
        assert truth['effects'] == [{'name': 'backlash', 'parameters': {'w_percent': 0.6}}]
        curve = truth['curve']
        opening = np.array(curve['opening_percent'])
        power = plant.static_power(opening, curve['pressure_mpa'])
        np.testing.assert_allclose(power, curve['power_mw'])
        half = plant.static_power(opening, 0.5 * curve['pressure_mpa'])
        scale, c = 0.5 ** truth['pressure_exponent'], truth['offset_mw']
        np.testing.assert_allclose(half - c, scale * (power - c))
        other = vf.simulate(0.01, 3, unit='integrated_input').to_json()
        assert (other['form'], other['offset_mw']) == ('integrated_input', 0.0)
        assert other['pressure_scale_exponent'] == 0.0 < other['no_load_mw']
        paper = vf.simulate(0.01, 3)
        assert paper.static_power(100.0, 1050.0 ** (8.0 / 9.0) / 100.0 ** (8.0 / 9.0)) == (
            pytest.approx(152.0)
        )


def test_the_units_are_those_the_monitor_was_told_if_they_are_units(tmp_path):
    table = vf.simulate(0.01, 1).data.table
    values = table.values.copy()
    values[:, Signal.MAIN_STEAM_PRESSURE] *= 10.0
    sent = SampleTable(table.time_ns, values, table.quality)
    told = {'bar': 'bar', 'ell': 'MPa', None: 'MPa', 'no parameters': 'MPa'}
    for k, (unit, expected) in enumerate(told.items()):
        parameters = [1] if unit == 'no parameters' else {'main_steam_pressure_unit': unit}
        path = tmp_path / f'{k}' / 'a.mcap'
        attached = {'parameters.json': json.dumps(parameters).encode()}
        write_readings([table_to_readings(sent)], list(Signal), path, attachments=attached)
        log = vf.open_log(path)
        assert log.units[Signal.MAIN_STEAM_PRESSURE] == expected
        mine = log.readings.value[log.readings.signal == Signal.MAIN_STEAM_PRESSURE]
        assert (mine.max() < 20.0) == (expected == 'bar')
