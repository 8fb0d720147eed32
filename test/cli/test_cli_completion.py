"""``valveflow completion``: the scripts are asked in the shells themselves."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from valveflow_ros.cli.completion_table import Kind, table
from valveflow_ros.cli.verbs import VERBS
from valveflow_ros.parameters import TABLE
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.records import SIGNALS

NAMES = [name for name, _, _ in VERBS]


@pytest.fixture(scope='module')
def scripts():
    from valveflow_ros.cli.completion_scripts import script

    return {shell: script(shell, table()) for shell in ('bash', 'zsh', 'fish')}


@pytest.fixture
def complete(scripts, tmp_path):
    """Press Tab in bash behind some words; the last is what was begun."""
    path = tmp_path / 'completion.bash'
    path.write_text(scripts['bash'])

    def press(*words):
        code = (
            'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(( $# - 1 )); '
            '_valveflow; (( ${#COMPREPLY[@]} )) && printf "%s\\n" "${COMPREPLY[@]}"; true'
        )
        done = subprocess.run(
            ['bash', '-c', code, '-', str(path), 'valveflow', *words],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert done.stderr == ''
        return done.stdout.split('\n')[:-1]

    return press


def test_verbs(complete):
    assert complete('') == [*NAMES, '--help', '--version']
    assert complete('ide') == ['identify']
    assert complete('comp') == ['compare', 'compensate', 'completion']
    assert complete('xyz') == []


@pytest.mark.parametrize('name', NAMES)
def test_every_option_of_every_verb(complete, run, name):
    offered = complete(name, '--')
    assert '--json' in offered
    page = run(name, '--help').out
    for option in offered:
        assert option in page


def test_names_that_are_known(complete):
    assert complete('simulate', '--effect', '') == list(catalogue())
    assert complete('simulate', '--effect', 'gain_') == ['gain_drift', 'gain_step']
    assert complete('identify', '--column', '') == ['time=', *(f'{i.topic}=' for i in SIGNALS)]
    assert complete('identify', '--constant', 'main_steam_t') == ['main_steam_temperature=']
    assert complete('identify', '--set', 'time_c') == ['time_constant=']
    assert len(complete('identify', '--set', '')) == len(TABLE)
    assert complete('completion', '')[:3] == ['bash', 'zsh', 'fish']


def test_where_a_file_is_meant_the_shell_is_left_alone(complete):
    assert complete('identify', 'plant.m') == []
    assert complete('validate', '--model', '') == []
    assert complete('identify', '-o', '') == []
    assert complete('simulate', '--seed', '') == []


def test_files_are_told_from_values():
    kinds = {
        (verb.name, option.flags[-1]): option.kind for verb in table() for option in verb.options
    }
    assert kinds['validate', '--model'] is Kind.FILE
    assert kinds['simulate', '--seed'] is Kind.VALUE
    assert kinds['simulate', '--overwrite'] is Kind.NOTHING


@pytest.mark.skipif(shutil.which('zsh') is None, reason='zsh is not here')
def test_zsh_understands_its_script(scripts, tmp_path):
    path = tmp_path / 'completion.zsh'
    path.write_text(scripts['zsh'])
    code = 'autoload -Uz compinit; compinit -D; source "$1"; print -r -- $_comps[valveflow]'
    done = subprocess.run(
        ['zsh', '-f', '-c', code, '-', str(path)], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ['_valveflow']
    assert done.stderr == ''


@pytest.mark.parametrize('shell', ['zsh', 'fish'])
def test_the_other_shells_are_told_the_same(scripts, shell):
    text = scripts[shell]
    for name in NAMES:
        assert name in text
    for name in catalogue():
        assert name in text
    assert 'main_steam_pressure=' in text


@pytest.mark.skipif(shutil.which('fish') is None, reason='fish is not here')
def test_fish_understands_its_script(scripts, tmp_path):
    path = tmp_path / 'completion.fish'
    path.write_text(scripts['fish'])
    code = f'source {path}; complete -C "valveflow simulate --effect gain_"'
    done = subprocess.run(['fish', '-c', code], capture_output=True, text=True, check=True)
    assert [line.split('\t')[0] for line in done.stdout.splitlines()] == [
        'gain_drift',
        'gain_step',
    ]


def test_the_verb_prints_it(run, scripts):
    assert run('completion', 'bash').out == scripts['bash']
    assert run('completion', 'tcsh').refused(2).startswith('valveflow: SHELL must be one of bash')
