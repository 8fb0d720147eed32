# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command as a whole: help, usage, exit status, no traceback."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from valveflow_ros import __version__
from valveflow_ros.cli.main import VERBS
from valveflow_ros.cli.verbs import info
from valveflow_ros.errors import DataError

NAMES = [name for name, _, _ in VERBS]
HEAVY = {'numpy', 'numba', 'scipy', 'pandas', 'pyarrow', 'plotly', 'yaml', 'rclpy'}


def test_without_arguments_it_tells_what_it_does(run):
    ran = run()
    assert ran.status == 0
    for name, _, about in VERBS:
        assert f'valveflow {name}' in ran.out
        assert about in ran.out
    assert run('--help').out == ran.out


@pytest.mark.parametrize('name', NAMES)
def test_help_of_a_verb_has_an_example_that_begins_like_the_command(run, name):
    ran = run(name, '--help')
    assert ran.status == 0
    assert f'example:\n  valveflow {name} ' in ran.out
    assert ran.err == ''


@pytest.mark.parametrize('words', [['--help'], ['--version'], *([n, '--help'] for n in NAMES)])
def test_help_loads_nothing_heavy(words):
    code = (
        'import sys\nfrom valveflow_ros.cli.main import main\n'
        f'main({words!r})\nprint(*sys.modules, file=sys.stderr)'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert not HEAVY & set(done.stderr.split())


def test_version(run):
    assert run('--version').out == f'valveflow {__version__}\n'


@pytest.mark.parametrize(
    ('words', 'part'),
    [
        (['identfy', 'x'], "Did you mean 'identify'?"),
        (['xyzzy'], 'The verbs are simulate,'),
        (['--json', 'info'], 'The verb comes first'),
        (['info'], 'LOG'),
        (['identify', 'x.mcap'], '-o'),
        (['identify', 'x.mcap', '-o', 'y', '--nonsense'], '--nonsense'),
        (['simulate', '-o', 'x.mcap', '--days', 'ten'], 'ten'),
        (['simulate'], '-o LOG'),
    ],
)
def test_wrong_usage_is_status_2_with_a_hint(run, words, part):
    sentence = run(*words).refused(2)
    assert part in sentence
    assert sentence.endswith('--help".')


def test_module_is_the_command():
    for module in ('valveflow_ros.cli', 'valveflow_ros.cli.main'):
        done = subprocess.run(
            [sys.executable, '-m', module, '--version'], capture_output=True, text=True, check=True
        )
        assert done.stdout == f'valveflow {__version__}\n'


@pytest.mark.parametrize(('wished', 'threads'), [(None, '1'), ('2', '2')])
def test_one_thread_of_blas_unless_told_otherwise(wished, threads):
    code = (
        'import os, sys\n'
        'from valveflow_ros.cli import main\n'
        'def load(name):\n'
        '    print("numpy" in sys.modules, os.environ["OPENBLAS_NUM_THREADS"])\n'
        '    sys.exit()\n'
        'main.load = load\n'
        'main.main(["info", "x.mcap"])'
    )
    environment = {k: v for k, v in os.environ.items() if k != 'OPENBLAS_NUM_THREADS'}
    if wished:
        environment['OPENBLAS_NUM_THREADS'] = wished
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout == f'False {threads}\n'


def test_output_cut_off_by_a_reader_is_no_error():
    command = f'{sys.executable} -m valveflow_ros.cli simulate --effects | head -n 1'
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=True)
    assert done.stdout
    assert done.stderr == ''


@pytest.fixture
def breaks(run, monkeypatch, tmp_path):
    """Let a verb raise something; return what the command made of it."""

    def command(error):
        def fail(options, console):
            raise error

        monkeypatch.setattr(info, 'run', fail)
        (tmp_path / 'x.mcap').touch()
        return run('info', tmp_path / 'x.mcap')

    return command


def test_an_error_nobody_foresaw_is_one_sentence_with_its_place(breaks):
    sentence = breaks(ZeroDivisionError('by zero')).refused()
    assert 'ZeroDivisionError: by zero' in sentence
    assert 'test_cli_main.py line' in sentence
    assert 'VALVEFLOW_DEBUG=1' in sentence


def test_debug_shows_the_traceback(breaks, monkeypatch):
    monkeypatch.setenv('VALVEFLOW_DEBUG', '1')
    ran = breaks(DataError('Not today.'))
    assert ran.status == 1
    assert 'Traceback' in ran.err
    assert ran.err.endswith('valveflow: Not today.\n')


def test_errors_raised_on_purpose_and_by_the_system(breaks):
    assert breaks(DataError('Not today.')).refused() == 'valveflow: Not today.'
    full = OSError(28, 'No space left on device', 'x.mcap')
    assert breaks(full).refused() == 'valveflow: x.mcap: no space left on device.'
    assert 'memory' in breaks(MemoryError()).refused()


def test_a_file_that_is_not_there_is_told_before_anything_is_loaded(tmp_path):
    words = [
        ['identify', 'nothing.mcap', '-o', 'o'],
        ['identify', 'log.mcap', '-o', 'log.mcap/o'],
        ['identify', 'log.mcap', '-o', 'o', '--reference', 'nothing.json'],
        ['validate', 'log.mcap', '-o', 'o', '--model', 'nothing.json'],
        ['compare', 'log.mcap', '-o', 'o', '--test', 'nothing.mcap'],
        ['simulate', '-o', 'x.mcap', '--truth', 'nowhere/truth.json'],
    ]
    (tmp_path / 'log.mcap').write_bytes(b'x')
    code = (
        'import sys\nfrom valveflow_ros.cli.main import main\n'
        f'print([main(w) for w in {words!r}], file=sys.stderr)\n'
        'print(*sys.modules, file=sys.stderr)'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    *said, statuses, modules = done.stderr.splitlines()
    assert statuses == str([1] * len(words))
    assert len(said) == len(words)
    named = ['nothing.mcap', 'log.mcap', 'nothing.json', 'nothing.json', 'nothing.mcap', 'nowhere']
    for line, name in zip(said, named, strict=True):
        assert name in line
    assert not HEAVY & set(modules.split())
    assert [p.name for p in tmp_path.iterdir()] == ['log.mcap']
