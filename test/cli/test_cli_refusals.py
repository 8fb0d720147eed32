# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is typed wrongly, or goes where nothing can be written, is told at once and in words."""

from __future__ import annotations

import re
from argparse import Action
from pathlib import Path

import pytest

from valveflow_ros.cli.main import VERBS, Parser, load
from valveflow_ros.errors import UsageError
from valveflow_ros.interface.files import check_folder
from valveflow_ros.report.terminal import text


def options_of(verb: str) -> list[Action]:
    """Return what a verb takes."""
    parser = Parser(verb)
    load(verb).arguments(parser)
    return parser._actions


NUMBERS = [
    (verb, action)
    for verb, _, _ in VERBS
    for action in options_of(verb)
    if getattr(action.type, '__module__', '') == text.__name__ and action.dest != 'time_zone'
]


def test_every_number_is_read_by_the_one_that_refuses_in_words():
    assert len(NUMBERS) >= 10
    plain = [(v, a.dest) for v, _, _ in VERBS for a in options_of(v) if a.type in (int, float)]
    assert plain == []


@pytest.mark.parametrize('given', ['zwei', 'nan', 'inf', '-1e400', ''])
@pytest.mark.parametrize(
    ('verb', 'action'), NUMBERS, ids=[f'{v} {a.option_strings[-1]}' for v, a in NUMBERS]
)
def test_what_is_no_number_is_refused_in_words(verb, action, given):
    """The option, what is wanted, its range, an example that is right, and what was given."""
    name = action.option_strings[-1]
    parser = Parser(verb)
    load(verb).arguments(parser)
    with pytest.raises(UsageError) as refused:
        parser.parse_args([f'{name}={given}'])
    said = str(refused.value)
    assert said.startswith(f'{name} must be '), said
    assert f"'{given}' is " in said
    example = re.search(rf'such as {name} (\S+);', said).group(1)
    assert action.type(example) == float(example)


# The words, the exit status, and what the sentence says. LOG is a log that can be read.
REFUSED = [
    *((f'simulate -o a.csv --days {days}', 2, f"such as --days 10; '{days}' is not")
      for days in ('0', '-3', '401', 'nan')),
    ('simulate --days', 2, '--days wants a value after it'),
    ('simulate -o x.xlsx', 1, 'must end in .mcap or .csv or .parquet'),
    ('simulate -o none/x.mcap', 1, 'there is no folder'),
    ('simulate -o x.mcap --seed -1', 2, '0 or more'),
    ('simulate -o x.mcap --effect gain_drif', 2, "Did you mean 'gain_drift'"),
    ('simulate -o x.mcap --effect gain_drift:h=1', 2, "no parameter 'h'"),
    ('simulate -o x.mcap --effect gain_drift:g=big', 2, "not 'big'"),
    ('simulate -o x.csv --truth no/t.json', 1, 'cannot be written'),
    ('import LOG -o x.bag', 1, 'must end in'),
    ('import LOG -o x.mcap --column main_steam_pressure=P:stone', 2, 'MPa, kPa, Pa, bar, psi'),
    ('import LOG --dry-run --time-zone Europe/Nowhere', 2, "'Europe/Nowhere' is not known"),
    ('import LOG --dry-run --date-order dym', 2, 'must be dmy, mdy or ymd'),
    ('import LOG --dry-run --decimal dot', 2, 'must be point or comma'),
    ('export LOG -o a.mcap', 1, 'must end in .csv or .parquet'),
    ('export LOG -o no/a.csv', 1, 'there is no folder'),
    ('identify LOG -o out --set time_constnt=3', 2, "did you mean 'time_constant'"),
    ('identify LOG -o out --set time_constant=1e9', 2, 'must be from'),
    ('identify LOG -o out --set time_constant', 2, 'NAME=VALUE'),
    ('identify LOG -o out --set hold_limit=1 --set sample_period=5', 1, 'not be below sample_per'),
    ('validate --modell x.json', 2, "no option '--modell'. Did you mean '--model'?"),
    ('validate LOG -o out --model LOG --tolerance 0', 2, '--tolerance must be'),
    ('validate LOG -o out', 2, '--model'),
    ('compensate --model x -o t.csv --points 1', 2, 'from 2 to 10000'),
    ('compensate --model x -o t.csv --pressure 0', 2, 'in MPa from 1e-06 to 100'),
    ('compensate --model x -o t.csv --max-gain -1', 2, 'above 0'),
    ('completion tcsh', 2, "SHELL must be one of bash, zsh, fish, not 'tcsh'"),
    ('config make x', 2, "not 'make'"),
    ('config check x.yaml', 1, 'no such file'),
    ('info a.csv b.csv', 2, "'b.csv' is one argument too many. Try"),
    ('simulate plant.csv', 2, "'plant.csv' is one argument too many. Write an output as -o"),
    ('info x.mcap --xyz=1', 2, 'There is no option'),
    ('watch x.csv', 2, 'valveflow info'),
    ('watch nothing.mcap', 1, 'is not there'),
    ('watch .', 1, 'has no recording in it'),
    ('watch x.mcap --node a', 2, '--node'),
    ('watch x.mcap --ask refit', 2, '--ask'),
    ('watch x --interval 0', 2, '0.1 to 3600'),
]  # fmt: skip


@pytest.mark.parametrize(('words', 'status', 'said'), REFUSED, ids=[r[0] for r in REFUSED])
def test_what_is_refused_leaves_one_sentence_and_nothing_else(
    run, logs, tmp_path, monkeypatch, words, status, said
):
    monkeypatch.chdir(tmp_path)
    given = [str(logs / 'plant.csv') if word == 'LOG' else word for word in words.split()]
    assert said in run(*given).refused(status)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    'words',
    [
        ['identify', 'LOG', '-o', '/proc/x'],
        ['validate', 'LOG', '--model', 'LOG', '-o', '/proc/x'],
        ['simulate', '-o', '/proc/x.mcap'],
        ['simulate', '-o', '/proc/x'],
        ['simulate', '-o', 'a.csv', '--truth', '/proc/x.json'],
        ['export', 'LOG', '-o', '/proc/x.csv'],
        ['identify', 'LOG', '-o', 'LOG'],
        ['identify', 'LOG', '-o', 'LOG/deeper'],
    ],
)
@pytest.mark.skipif(not Path('/proc/self').is_dir(), reason='there is no place like /proc here')
def test_a_place_that_takes_no_files_is_refused_before_the_work(run, tmp_path, monkeypatch, words):
    """The log cannot even be read, and a plant of 400 days not be simulated in a moment."""
    monkeypatch.chdir(tmp_path)
    Path('LOG').write_bytes(b'nothing')
    days = ['--days', '400'] if words[0] == 'simulate' else []
    said = run(*words, *days).refused()
    assert ('/proc' if '/proc' in ' '.join(words) else 'LOG: is not a folder') in said
    assert 'choose another' in said
    assert Path('LOG').read_bytes() == b'nothing'


def test_a_folder_that_was_only_tried_is_not_left_behind(tmp_path):
    check_folder(tmp_path / 'a' / 'b')
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ('content', 'part'),
    [
        ('{', 'holds no JSON'),
        ('[' * 100_000, 'holds no JSON'),
        ('{"format": "other", "pieces": 3}', 'cannot be used'),
    ],
)
@pytest.mark.parametrize('words', [
    ['identify', '--reference'], ['identify', '--model'], ['diagnose', '--model'],
    ['validate', '--model'], ['validate', '--model', 'MODEL', '--against'],
    ['compare', '--truth'], ['compensate', '--model'],
])  # fmt: skip
def test_a_file_that_is_no_model_is_refused_before_any_work(
    run, tmp_path, identified, words, content, part
):
    """The log cannot even be read."""
    (tmp_path / 'log.mcap').write_bytes(b'nothing')
    path = tmp_path / 'wrong.json'
    path.write_text(content)
    verb, *more = [identified if word == 'MODEL' else word for word in words]
    log = [] if verb == 'compensate' else [tmp_path / 'log.mcap']
    output = tmp_path / ('o.csv' if verb == 'compensate' else 'o')
    said = run(verb, *log, '-o', output, *more, path).refused()
    assert part in said
    assert 'wrong.json' in said
    assert not output.exists()
    path.unlink()
    gone = run(verb, *log, '-o', output, *more, path).refused()
    assert 'wrong.json: cannot be read (no such file' in gone
