"""One folder for the results of several verbs: nothing of another verb is lost."""

from __future__ import annotations

import pytest

from valveflow_ros.cli.files import write_texts
from valveflow_ros.cli.keeping import REPORT, keep_others, renamed
from valveflow_ros.report.page import Page

VERBS = ('identify', 'diagnose', 'compare', 'validate')


def report_of(verb, words='x'):
    return Page('Title', f'<p>{words}</p>', [], '', verb).to_html()


def write(folder, verb, words='x', **others):
    """Write as a verb does, after keeping what is another's."""
    files = {**others, REPORT: report_of(verb, words)}
    kept = keep_others(folder, verb, files)
    write_texts(folder, files)
    return kept


@pytest.mark.parametrize('first', VERBS)
@pytest.mark.parametrize('second', VERBS)
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


def test_the_model_of_a_diagnosis_is_not_lost_to_identify(tmp_path):
    write(tmp_path, 'diagnose', **{'extended_model.json': 'causes'})
    kept = write(tmp_path, 'identify', **{'extended_model.json': 'a new curve'})
    assert kept.names['extended_model.json'] == 'extended_model_diagnose.json'
    assert (tmp_path / 'extended_model_diagnose.json').read_text() == 'causes'
