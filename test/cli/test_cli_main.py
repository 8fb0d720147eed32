# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command as a whole: help, usage, refusals, exit status, completion, no traceback."""

import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from valveflow_ros import __version__
from valveflow_ros.cli.main import VERBS, parser_of
from valveflow_ros.cli.verbs import info
from valveflow_ros.cli.verbs.completion import SHELLS
from valveflow_ros.errors import DataError, UsageError
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.records import SIGNALS
from valveflow_ros.report.terminal import text

NAMES = [name for name, _, _ in VERBS]
HEAVY = {'numba', 'scipy', 'pandas', 'pyarrow', 'plotly', 'rclpy'}


def process(code, **more):
    words = [sys.executable, '-c', code]
    return subprocess.run(words, capture_output=True, text=True, check=True, **more)


def test_help_of_the_command_and_of_every_verb(run):
    ran = run()
    assert ran.status == 0
    assert run('--help').out == ran.out
    for name, _, about in VERBS:
        assert f'valveflow {name}' in ran.out
        assert about in ran.out
        page = run(name, '--help')
        assert (page.status, page.err) == (0, '')
        assert f'example:\n  valveflow {name} ' in page.out


def test_help_loads_nothing_heavy():
    pages = [['--help'], ['--version'], *([name, '--help'] for name in NAMES)]
    done = process(
        'import sys\nfrom valveflow_ros.cli.main import main\n'
        f'for words in {pages!r}: main(words)\nprint(*sys.modules, file=sys.stderr)'
    )
    assert not (HEAVY | {'numpy', 'yaml'}) & set(done.stderr.split())


def test_module_is_the_command(run):
    assert run('--version').out == f'valveflow {__version__}\n'
    for module in ('valveflow_ros.cli', 'valveflow_ros.cli.main'):
        words = [sys.executable, '-m', module, '--version']
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        assert done.stdout == f'valveflow {__version__}\n'


@pytest.mark.parametrize(('wished', 'threads'), [(None, '1'), ('2', '2')])
def test_one_thread_of_blas_unless_told_otherwise(run, monkeypatch, wished, threads):
    monkeypatch.setenv('OPENBLAS_NUM_THREADS', wished or '1')
    if wished is None:
        monkeypatch.delenv('OPENBLAS_NUM_THREADS')
    run('--version')
    assert os.environ['OPENBLAS_NUM_THREADS'] == threads


def test_output_cut_off_by_a_reader_is_no_error():
    command = f'{sys.executable} -m valveflow_ros.cli simulate --effects | head -n 1'
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=True)
    assert done.stdout
    assert done.stderr == ''


@pytest.mark.parametrize(
    ('error', 'parts'),
    [
        (ZeroDivisionError('by zero'),
         ['ZeroDivisionError: by zero', 'test_cli_main.py line', 'VALVEFLOW_DEBUG=1']),
        (DataError('Not today.'), ['valveflow: Not today.']),
        (OSError(28, 'No space left on device', 'x'), ['valveflow: x: no space left on device.']),
        (MemoryError(), ['There is not enough memory for this log']),
    ],
)  # fmt: skip
def test_any_error_is_one_sentence(run, monkeypatch, tmp_path, error, parts):
    def fail(options, console):
        raise error

    monkeypatch.setattr(info, 'run', fail)
    (tmp_path / 'x.mcap').touch()
    sentence = run('info', tmp_path / 'x.mcap').refused()
    assert all(part in sentence for part in parts)
    monkeypatch.setenv('VALVEFLOW_DEBUG', '1')
    ran = run('info', tmp_path / 'x.mcap')
    assert ran.status == 1
    assert ('Traceback' in ran.err) != isinstance(error, MemoryError)
    assert ran.err.endswith(f'{sentence}\n')


def test_a_file_that_is_not_there_is_told_before_anything_is_loaded(tmp_path):
    words = {
        'nothing.mcap: ': ['identify', 'nothing.mcap', '-o', 'o'],
        'log.mcap: is not a folder': ['identify', 'log.mcap', '-o', 'log.mcap/o'],
        'nothing.json: ': ['validate', 'log.mcap', '-o', 'o', '--model', 'nothing.json'],
        'other.mcap: ': ['compare', 'log.mcap', '-o', 'o', '--test', 'other.mcap'],
        'nowhere': ['simulate', '-o', 'x.mcap', '--truth', 'nowhere/truth.json'],
    }
    (tmp_path / 'log.mcap').write_bytes(b'x')
    done = process(
        'import sys\nfrom valveflow_ros.cli.main import main\n'
        f'print([main(w) for w in {list(words.values())!r}], file=sys.stderr)\n'
        'print(*sys.modules, file=sys.stderr)', cwd=tmp_path,
    )  # fmt: skip
    *said, statuses, modules = done.stderr.splitlines()
    assert statuses == str([1] * len(words))
    assert all(part in line for line, part in zip(said, words, strict=True)), said
    assert not (HEAVY | {'numpy', 'yaml'}) & set(modules.split())
    assert [p.name for p in tmp_path.iterdir()] == ['log.mcap']


MIB = 1 << 20


@pytest.mark.parametrize(('verb', 'limit_mib'), [
    ('info', 300), ('identify', 700), pytest.param('identify', 1100, marks=pytest.mark.long),
    ('identify', 2000),
])  # fmt: skip
def test_a_process_of_limited_memory_works_or_says_what_it_needs(verb, limit_mib, tmp_path):
    log = tmp_path / 'log.csv'
    rows = [f'{t},{50 + t % 7},{12},{540},{200 + t % 7}' for t in range(300)]
    names = 'time,valve_opening,main_steam_pressure,main_steam_temperature,generated_power'
    log.write_text('\n'.join([names, *rows]))
    more = ['-o', str(tmp_path / 'out')] if verb == 'identify' else []

    def limited():
        resource.setrlimit(resource.RLIMIT_AS, (limit_mib * MIB, limit_mib * MIB))

    command = [sys.executable, '-m', 'valveflow_ros.cli.main', verb, str(log), *more]
    done = subprocess.run(
        command, preexec_fn=limited, capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode in (0, 1), 'it died of a signal'
    if done.returncode:
        assert f'may use {limit_mib} MiB of address space' in done.stderr
        assert done.stderr.count('\n') == 1


# What is typed wrongly.


NUMBERS = [
    (verb, action)
    for verb in NAMES
    for action in parser_of(verb)._actions
    if getattr(action.type, '__module__', '') == text.__name__ and action.dest != 'time_zone'
]


def test_what_is_no_number_is_refused_in_words():
    """The option, what is wanted, its range, an example that is right, and what was given."""
    assert NUMBERS
    for verb, action in NUMBERS:
        assert not any(a.type in (int, float) for a in parser_of(verb)._actions)
        name = action.option_strings[-1]
        for given in ('zwei', 'nan', 'inf', '-1e400', ''):
            with pytest.raises(UsageError) as refused:
                parser_of(verb).parse_args([f'{name}={given}'])
            said = str(refused.value)
            assert said.startswith(f'{name} must be '), said
            assert f"'{given}' is " in said
            example = re.search(rf'such as {name} (\S+);', said).group(1)
            assert action.type(example) == float(example)


# The words, the exit status, and what the sentence says. LOG is a log that can be read.
REFUSED = [
    ('identfy x', 2, "Did you mean 'identify'?"),
    ('xyzzy', 2, 'The verbs are simulate,'),
    ('--json info', 2, 'The verb comes first'),
    ('info', 2, 'LOG'),
    ('identify x.mcap', 2, '-o'),
    ('simulate', 2, '-o LOG'),
    ('simulate -o a.csv --days 401', 2, "such as --days 10; '401' is not"),
    ('simulate --days', 2, '--days wants a value after it'),
    ('simulate -o x.xlsx', 1, 'must end in .mcap or .csv or .parquet'),
    ('simulate -o none/x.mcap', 1, 'there is no folder'),
    ('simulate -o x.mcap --seed -1', 2, '0 or more'),
    ('simulate -o x.mcap --effect gain_drif', 2, "Did you mean 'gain_drift'"),
    ('simulate -o x.csv --recording hourly', 2, 'no recording'),
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
    ('identify LOG -o out --set hold_limit=1 --set sample_period=5', 1, 'not be below sample_per'),
    ('validate --modell x.json', 2, "no option '--modell'. Did you mean '--model'?"),
    ('validate LOG -o out --model LOG --tolerance 0', 2, '--tolerance must be'),
    ('validate LOG -o out', 2, '--model'),
    ('compensate --model x -o t.csv --points 1', 2, 'from 2 to 10000'),
    ('completion tcsh', 2, "SHELL must be one of bash, zsh, fish, not 'tcsh'"),
    ('config make x', 2, "not 'make'"),
    ('config check x.yaml', 1, 'no such file'),
    ('info a.csv b.csv', 2, "'b.csv' is one argument too many. Try"),
    ('simulate plant.csv', 2, "'plant.csv' is one argument too many. Write an output as -o"),
    ('info x.mcap --xyz=1', 2, 'There is no option'),
    ('fleet gone.csv -o out', 1, 'gone.csv: cannot be opened (no such file or directory)'),
    ('watch x.csv', 2, 'valveflow info'),
    ('watch nothing.mcap', 1, 'is not there'),
    ('watch .', 1, 'has no recording in it'),
    ('watch x.mcap --node a', 2, '--node'),
    ('watch x.mcap --ask refit', 2, '--ask'),
    ('watch x --interval 0', 2, '0.1 to 3600'),
]  # fmt: skip


def test_what_is_refused_leaves_one_sentence_and_nothing_else(run, logs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, status, said in REFUSED:
        given = [str(logs / 'plant.csv') if word == 'LOG' else word for word in words.split()]
        sentence = run(*given).refused(status)
        assert said in sentence, words
        assert sentence.endswith('--help".') == (status == 2), words
        assert not list(tmp_path.iterdir()), words


@pytest.mark.skipif(not Path('/proc/self').is_dir(), reason='there is no place like /proc here')
def test_a_place_that_takes_no_files_is_refused_before_the_work(run, tmp_path, monkeypatch):
    """The log cannot even be read, and a plant of 400 days not be simulated in a moment."""
    monkeypatch.chdir(tmp_path)
    Path('LOG').write_bytes(b'nothing')
    for words in (
        'identify LOG -o /proc/x', 'validate LOG --model LOG -o /proc/x',
        'simulate --days 400 -o /proc/x.mcap', 'simulate --days 400 -o /proc/x',
        'simulate --days 400 -o a.csv --truth /proc/x.json', 'export LOG -o /proc/x.csv',
        'identify LOG -o LOG', 'identify LOG -o LOG/deeper',
    ):  # fmt: skip
        said = run(*words.split()).refused()
        assert ('/proc' if '/proc' in words else 'LOG: is not a folder') in said, words
        assert 'choose another' in said, words
        assert Path('LOG').read_bytes() == b'nothing', words
        assert [p.name for p in tmp_path.iterdir()] == ['LOG'], words


def test_a_file_that_is_no_model_is_refused_before_any_work(run, tmp_path, identified):
    """The log cannot even be read."""
    (tmp_path / 'log.mcap').write_bytes(b'nothing')
    path, deep = tmp_path / 'wrong.json', '[' * 100_000
    for verb, *more in (
        ['identify', '--reference'], ['identify', '--model'], ['diagnose', '--model'],
        ['validate', '--model'], ['validate', '--model', identified, '--against'],
        ['compare', '--truth'], ['compensate', '--model'],
    ):  # fmt: skip
        log = [] if verb == 'compensate' else [tmp_path / 'log.mcap']
        output = tmp_path / ('o.csv' if verb == 'compensate' else 'o')
        for content, part in (
            ('{', 'holds no JSON'), (deep, 'holds no JSON'), (None, 'cannot be read (no such'),
            ('{"format": "other", "pieces": 3}', 'cannot be used'),
        ):  # fmt: skip
            path.unlink() if content is None else path.write_text(content)
            said = run(verb, *log, '-o', output, *more, path).refused()
            assert 'wrong.json: ' in said
            assert part in said
            assert not output.exists()


# What the shell asks when Tab is pressed.


@pytest.fixture
def complete(tmp_path):
    """Press Tab behind a line as the scripts of the shells do; return what is offered."""

    def press(line):
        answer, seen = tmp_path / 'answer', tmp_path / 'seen'
        code = (
            'import os, sys\n'
            f'os._exit = lambda n: (open({str(seen)!r}, "w").write(" ".join(sys.modules)), '
            'sys.exit(0))\nfrom valveflow_ros.cli.main import main\nmain()'
        )
        done = process(
            code,
            env={**os.environ, '_ARGCOMPLETE': '1', '_ARGCOMPLETE_IFS': '\n',
                 'COMP_LINE': line, 'COMP_POINT': str(len(line)), 'COMP_TYPE': '9',
                 '_ARGCOMPLETE_STDOUT_FILENAME': str(answer)},
        )  # fmt: skip
        assert done.stderr == ''
        assert not HEAVY & set(seen.read_text().split())
        return [word.strip() for word in answer.read_text().split('\n') if word]

    return press


def test_what_is_known_is_completed(complete, run, tmp_path, monkeypatch):
    topics = [f'{info.topic}=' for info in SIGNALS]
    assert complete('valveflow ') == NAMES
    assert complete('valveflow comp') == ['compare', 'compensate', 'completion']
    assert complete('valveflow simulate --effect ') == list(catalogue())
    assert complete('valveflow identify --column ') == ['time=', *topics]
    assert complete('valveflow identify --constant main_steam_t') == ['main_steam_temperature=']
    assert complete('valveflow identify --set time_c') == ['time_constant=']
    assert complete('valveflow completion ') == list(SHELLS)
    offered, page = complete('valveflow identify --'), run('identify', '--help').out
    assert '--json' in offered
    assert all(option in page for option in offered)
    # A file is offered where one is meant.
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'plant.mcap').touch()
    assert complete('valveflow validate --model pl') == ['plant.mcap']


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
