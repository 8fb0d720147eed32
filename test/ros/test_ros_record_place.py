"""A place that cannot be recorded into is told before the engine is loaded."""

from __future__ import annotations

import os

import pytest

from valveflow_ros.errors import RecordingError
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node.recording import check_record_directory


def settings(place, record=True):
    return Settings({'record_directory': str(place), 'record': record})


def test_a_place_that_will_do_is_left_as_it_is(tmp_path):
    check_record_directory(settings(tmp_path))
    check_record_directory(settings(tmp_path / 'a' / 'b'))
    assert list(tmp_path.iterdir()) == []


def test_below_a_file_there_is_no_folder(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='is not a folder; set record_directory'):
        check_record_directory(settings(tmp_path / 'file' / 'records'))
    check_record_directory(settings(tmp_path / 'file' / 'records', record=False))


@pytest.mark.skipif(os.geteuid() == 0, reason='root may write everywhere')
def test_where_nobody_may_write(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(RecordingError, match='may not be written into'):
        check_record_directory(settings(tmp_path / 'records'))


def test_the_rights_are_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(os, 'access', lambda *_: False)
    with pytest.raises(RecordingError, match='may not be written into; set record_directory'):
        check_record_directory(settings(tmp_path))


def test_the_home_of_nobody():
    with pytest.raises(RecordingError, match='not there'):
        check_record_directory(settings('~nobody-of-this-name/records'))
