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
    if getattr(action.type, '__module__', '') == text.__name__
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


@pytest.mark.parametrize('given', ['0', '-3', '401'])
def test_a_number_out_of_range_is_refused_before_anything_is_done(run, tmp_path, given):
    said = run('simulate', '-o', tmp_path / 'a.csv', '--days', given).refused(2)
    assert f"above 0 and at most 400, such as --days 10; '{given}' is not" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['simulate', '--days'], '--days wants a value after it'),
        (['completion', 'tcsh'], "SHELL must be one of bash, zsh, fish, not 'tcsh'"),
        (['info', 'a.csv', 'b.csv'], "There is no place for 'b.csv' here"),
    ],
)
def test_wrong_usage_is_told_without_jargon(run, words, said):
    assert said in run(*words).refused(2)


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
