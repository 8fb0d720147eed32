# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow completion``: the shells ask the command itself what can follow."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

from valveflow_ros.cli.main import VERBS
from valveflow_ros.cli.verbs.completion import SHELLS
from valveflow_ros.parameters import TABLE
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.records import SIGNALS

NAMES = [name for name, _, _ in VERBS]
HEAVY = {'numba', 'scipy', 'pandas', 'pyarrow', 'plotly', 'rclpy'}


@pytest.fixture
def complete(tmp_path):
    """Press Tab behind a line as the scripts of the shells do; return what is offered."""

    def press(line, code='from valveflow_ros.cli.main import main; main()'):
        answer = tmp_path / 'answer'
        done = subprocess.run(
            [sys.executable, '-c', code], capture_output=True, text=True, check=True,
            env={**os.environ, '_ARGCOMPLETE': '1', '_ARGCOMPLETE_IFS': '\n',
                 'COMP_LINE': line, 'COMP_POINT': str(len(line)), 'COMP_TYPE': '9',
                 '_ARGCOMPLETE_STDOUT_FILENAME': str(answer)},
        )  # fmt: skip
        assert done.stderr == ''
        return [word.strip() for word in answer.read_text().split('\n') if word]

    return press


def test_verbs(complete):
    assert complete('valveflow ') == NAMES
    assert complete('valveflow ide') == ['identify']
    assert complete('valveflow comp') == ['compare', 'compensate', 'completion']
    assert complete('valveflow xyz') == []


@pytest.mark.parametrize('name', ['identify', 'watch', 'config'])
def test_every_option_of_a_verb(complete, run, name):
    offered = complete(f'valveflow {name} --')
    page = run(name, '--help').out
    assert '--json' in offered
    assert len(offered) > 4
    assert all(option in page for option in offered)


def test_names_that_are_known(complete):
    assert complete('valveflow simulate --effect ') == list(catalogue())
    assert complete('valveflow simulate --effect gain_') == ['gain_drift', 'gain_step']
    columns = complete('valveflow identify --column ')
    assert columns == ['time=', *(f'{i.topic}=' for i in SIGNALS)]
    assert complete('valveflow identify --constant main_steam_t') == ['main_steam_temperature=']
    assert complete('valveflow identify --set time_c') == ['time_constant=']
    assert len(complete('valveflow identify --set ')) == len(TABLE)
    assert complete('valveflow completion ') == list(SHELLS)


def test_a_file_is_offered_where_one_is_meant(complete, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'plant.mcap').touch()
    assert complete('valveflow identify pl') == ['plant.mcap']
    assert complete('valveflow validate --model pl') == ['plant.mcap']


def test_nothing_heavy_is_loaded(complete, tmp_path):
    code = (
        'import os, sys\n'
        f'os._exit = lambda n: (open({str(tmp_path / "seen")!r}, "w").write(" ".join('
        'sys.modules)), sys.exit(0))\n'
        'from valveflow_ros.cli.main import main\nmain()'
    )
    for line in ('valveflow identify --', 'valveflow diagnose --set '):
        complete(line, code)
        seen = set((tmp_path / 'seen').read_text().split())
        assert 'valveflow_ros.cli.main' in seen
        assert not HEAVY & seen


@pytest.mark.parametrize('shell', SHELLS)
def test_each_shell_understands_its_script(run, tmp_path, shell):
    text = run('completion', shell).out
    assert run('completion', shell, '--json').json['script'].strip() == text.strip()
    assert '_ARGCOMPLETE' in text
    assert 'valveflow' in text
    if shutil.which(shell) is None:
        return
    path = tmp_path / 'script'
    path.write_text(text)
    more = ['-f'] if shell == 'zsh' else []
    before = 'autoload -Uz compinit; compinit -D; ' if shell == 'zsh' else ''
    done = subprocess.run(
        [shell, *more, '-c', f'{before}source {path}'], capture_output=True, text=True, check=True
    )
    assert done.stderr == ''
