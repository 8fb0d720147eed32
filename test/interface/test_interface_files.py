# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One folder for the results of several verbs: nothing of another verb is lost."""

import json

import pytest

from valveflow_ros.baselines import comparison, validation
from valveflow_ros.curve import characteristic_json, shift
from valveflow_ros.diagnosis import result
from valveflow_ros.errors import RecordingError
from valveflow_ros.interface.files import REPORT, Result, back_up, signed, write_texts, writer
from valveflow_ros.report.page import Figure, Page, Section

MODEL = 'extended_model.json'


def renamed(name, mark):
    stem, dot, kind = name.rpartition('.')
    return f'{stem}_{mark}{dot}{kind}'


def report_of(verb, words='x'):
    return Page('Title', f'<p>{words}</p>', [], '', verb).to_html()


def write(folder, verb, words='x', **others):
    """Write as a verb does, after keeping what is another's."""
    files = {**others, REPORT: report_of(verb, words)}
    kept = back_up(folder, verb, files)
    write_texts(folder, files)
    return kept


@pytest.mark.parametrize(('first', 'second'), [
    ('identify', 'diagnose'), ('compare', 'identify'), ('validate', 'validate'),
])  # fmt: skip
def test_the_report_of_another_verb_stays_under_its_name(tmp_path, first, second):
    assert write(tmp_path, first, 'the first').words() == ''
    told = write(tmp_path, second, 'the second').words()
    assert 'the second' in (tmp_path / REPORT).read_text()
    other = tmp_path / renamed(REPORT, first)
    assert other.exists() is (first != second)
    assert (f'valveflow {first} that was there is now report_{first}.html' in told) is (
        first != second
    )
    if first != second:
        assert 'the first' in other.read_text()


def test_a_report_that_came_back_says_which_one_is_new(tmp_path):
    for verb in ('identify', 'diagnose'):
        write(tmp_path, verb)
    told = write(tmp_path, 'identify', 'anew').words()
    assert 'report_identify.html is of an earlier run; the new one is report.html' in told
    assert 'anew' in (tmp_path / REPORT).read_text()


def test_a_page_of_somebody_else_is_kept_each_time(tmp_path):
    for words in ('mine', 'mine again'):
        (tmp_path / REPORT).write_text(words)
        assert 'report_before' in write(tmp_path, 'identify').words()
    kept = [(tmp_path / f'report_before{tail}.html').read_text() for tail in ('', '_2')]
    assert kept == ['mine', 'mine again']


def test_segments_of_compare_and_validate_do_not_replace_each_other(tmp_path):
    theirs = 'segment,kind,paper.static.mse_mw2,proposed.static.mse_mw2\n1,steady,2,3\n'
    ours = 'segment,kind,curve.mse_mw2\n1,steady,2\n'
    write(tmp_path, 'compare', **{'segments.csv': theirs})
    write(tmp_path, 'diagnose')
    told = write(tmp_path, 'validate', **{'segments.csv': ours}).words()
    assert 'The segments.csv that was there is now segments_compare.csv.' in told
    assert (tmp_path / 'segments_compare.csv').read_text() == theirs
    assert write(tmp_path, 'validate', **{'segments.csv': ours}).names == {}


def model_of(verb, words='x'):
    content = {'format': 'valveflow/extended_model', 'version': 1, 'words': words}
    return json.dumps(signed(content, verb) if verb else content, indent=2)


def test_the_model_of_a_diagnosis_is_not_lost_whatever_report_stands_there(tmp_path):
    causes = model_of('diagnose', 'causes')
    write(tmp_path, 'diagnose', **{MODEL: causes})
    write(tmp_path, 'compare')
    kept = write(tmp_path, 'identify', **{MODEL: model_of('identify', 'a curve')})
    assert kept.names == {REPORT: 'report_compare.html', MODEL: 'extended_model_diagnose.json'}
    assert 'The extended_model.json that was there is now extended_model_diagnose' in kept.words()
    assert (tmp_path / 'extended_model_diagnose.json').read_text() == causes
    kept = write(tmp_path, 'diagnose', **{MODEL: model_of('diagnose', 'new causes')})
    assert kept.names[MODEL] == 'extended_model_identify.json'
    assert 'a curve' in (tmp_path / 'extended_model_identify.json').read_text()
    assert write(tmp_path, 'diagnose', **{MODEL: causes}).names == {}


def test_a_model_that_does_not_say_whose_it_is_is_kept(tmp_path):
    for words in ('first', 'second'):
        (tmp_path / MODEL).write_text(model_of('', words))
        write(tmp_path, 'diagnose', **{MODEL: model_of('diagnose')})
    for words, tail in (('first', ''), ('second', '_2')):
        assert words in (tmp_path / f'extended_model_before{tail}.json').read_text()


@pytest.mark.parametrize('name', ['segments.csv', 'comparison.json', MODEL])
def test_a_file_of_a_person_is_kept_whatever_its_name(tmp_path, name):
    (tmp_path / name).write_text('mine')
    copy = renamed(name, 'before')
    (tmp_path / copy).write_text('mine too')
    kept = write(tmp_path, 'compare', **{name: 'x'})
    assert kept.names[name] == renamed(name, 'before_2')
    assert f'The {name} that was there is now' in kept.words()
    assert (tmp_path / copy).read_text() == 'mine too'
    assert (tmp_path / renamed(name, 'before_2')).read_text() == 'mine'


def test_what_cannot_be_read_is_not_replaced(tmp_path, monkeypatch):
    def denied(path):
        raise PermissionError(13, 'Permission denied', str(path))

    (tmp_path / 'segments.csv').write_text('mine')
    monkeypatch.setattr('pathlib.Path.read_bytes', denied)
    with pytest.raises(RecordingError, match='cannot be read to keep it'):
        write(tmp_path, 'compare', **{'segments.csv': 'x'})
    assert (tmp_path / 'segments.csv').read_text() == 'mine'


def test_every_file_for_programs_tells_its_verb(tmp_path):
    path = tmp_path / 'some.json'
    for form, verb in (
        (characteristic_json, 'identify'), (shift, 'identify'), (result, 'diagnose'),
        (comparison, 'compare'), (validation, 'validate'),
    ):  # fmt: skip
        for indent in (1, 2):
            path.write_text(json.dumps({'format': form.FORMAT, 'version': 1}, indent=indent))
            assert writer(path) == verb


def test_a_verb_says_whose_pictures_it_replaced(tmp_path):
    class Drawn(Result):
        def __init__(self, verb, y):
            self.verb, self.y = verb, y

        def texts(self):
            return {}

        def page(self):
            trace = {
                'type': 'scatter',
                'mode': 'lines',
                'name': 'a',
                'x': [0, 1],
                'y': [0, self.y],
            }
            names = ('history', 'curve')
            figures = [Figure(n, 'A caption.', 'Words.', [trace], {}, 300) for n in names]
            return Page('Title', '', [Section('A section', figures)], '', self.verb)

    def written(verb, y):
        return '\n'.join(Drawn(verb, y).write(tmp_path, tables=True).words)

    assert 'replaced' not in written('identify', 1)
    assert 'replaced' not in written('diagnose', 1)
    told = 'tables/history.csv: what was there showed something else and is replaced.'
    assert told in written('identify', 2)
