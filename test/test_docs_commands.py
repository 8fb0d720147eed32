# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every command of README and handbook is run here, in a folder of its own, as a reader would."""

import itertools
import os
import re
import shlex
import subprocess
import sys
from argparse import ArgumentError, ArgumentParser
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').rglob('*.md'))]
_FENCE = re.compile(r'^( *)```([^\n]*)\n(.*?)^\1```', re.M | re.S)
# sh: run here. long: the same, but only where slow tests are asked for. jazzy: needs what is not
# here; its names are checked. The others are not commands.
KINDS = {
    'sh', 'sh long', 'sh jazzy', 'sh make', 'console', 'console fails', 'yaml', 'text', 'python',
}  # fmt: skip
RUN = ('sh', 'console', 'console fails')
# Parameters of the other nodes.
OTHERS = {
    'rate', 'stamped', 'use_clock', 'effects', 'days', 'seed', 'use_sim_time', 'mapping_file',
}  # fmt: skip
EXECUTABLES = {'monitor', 'opcua_gateway', 'page', 'replay', 'plant_simulator', 'watch'}


class Block(NamedTuple):
    """A fenced block of a page."""

    page: str
    line: int
    kind: str
    text: str


def blocks(page: Path) -> list[Block]:
    source = page.read_text()
    name = str(page.relative_to(ROOT))
    return [
        Block(name, source.count('\n', 0, found.start()) + 1, found[2].strip(), found[3])
        for found in _FENCE.finditer(source)
    ]


ALL = [block for page in PAGES for block in blocks(page)]


def commands(block: Block) -> list[list[str]]:
    """Return the commands of a block as words; a here-document is left out."""
    text = re.sub(r"<<'?(\w+)'?\n.*?^\1$", '', block.text, flags=re.M | re.S)
    joined = text.replace('\\\n', ' ')
    if block.kind.startswith('console'):
        joined = '\n'.join(line[2:] for line in joined.splitlines() if line.startswith('$ '))
    lines = [part for line in joined.splitlines() for part in re.split(r'\s*(?:&&|\|)\s*', line)]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def test_every_block_says_what_it_is_and_every_page_that_is_run_is_named() -> None:
    """A page with commands that no test runs would be a promise."""
    assert {block.kind for block in ALL} <= KINDS
    named = {*SHORT, 'docs/tutorial_live.md', 'docs/tutorial_opcua.md'}
    assert {block.page for block in ALL if block.kind in RUN} <= named


def _parser(verb: str) -> ArgumentParser:
    from valveflow_ros.cli.main import load

    parser = ArgumentParser(exit_on_error=False)
    load(verb).arguments(parser)
    parser.add_argument('--json', action='store_true')
    parser.add_argument('--quiet', action='store_true')
    return parser


def test_every_command_is_one_the_programs_take() -> None:
    blocks = [b for b in ALL if b.kind.split()[0] in ('sh', 'console')]
    assert len(blocks) > 50
    for block in blocks:
        for words in commands(block):
            while words and ('=' in words[0] or words[0] in ('nice', 'sudo')):
                words = words[1:]
            try:
                _check(words)
            except (AssertionError, OSError, ArgumentError) as error:
                pytest.fail(f'{block.page}:{block.line}: {shlex.join(words)}: {error}')


def _check(words: list[str]) -> None:
    """Look at the options, names and files of a command."""
    if words[:1] == ['valveflow'] and len(words) > 1 and not words[1].startswith('-'):
        kept = [w for w in words[2:] if not w.startswith(('>', '2>')) and w != '&']
        _, rest = _parser(words[1]).parse_known_args(kept)
        assert not [w for w in rest if w.startswith('-')]
    elif words[:3] == ['ros2', 'run', 'valveflow_ros']:
        assert words[3] in EXECUTABLES
        _check_ros(words[4:])
    elif words[:3] == ['ros2', 'launch', 'valveflow_ros']:
        text = (ROOT / 'launch' / words[3]).read_text()
        for word in words[4:]:
            assert f"'{word.split(':=')[0]}'" in text
    elif words[:2] == ['python', '-m']:
        path = ROOT / words[2].replace('.', '/')
        assert path.with_suffix('.py').exists() or (path / '__main__.py').exists()
    elif words[:1] == ['make']:
        makefile = (ROOT / 'Makefile').read_text()
        for target in (w for w in words[1:] if not w.startswith('-') and '=' not in w):
            assert re.search(rf'^{target}:', makefile, re.M)


def _check_ros(words: list[str]) -> None:
    """Look at parameters and remaps of a node."""
    from valveflow_ros.parameters import PARAMETERS
    from valveflow_ros.records import SIGNALS

    topics = {s.topic for s in SIGNALS} | {'plant_sample'}
    for option, value in itertools.pairwise(words):
        if option == '-p':
            name = value.split(':=')[0]
            assert name in PARAMETERS or name in OTHERS, value
        elif option == '-r':
            assert value.split(':=')[0] in topics or value.startswith('__'), value


def test_parameter_files_are_ones_the_monitor_takes() -> None:
    yaml = pytest.importorskip('yaml')
    from valveflow_ros.parameters import Settings

    files = [yaml.safe_load(block.text) for block in ALL if block.kind == 'yaml']
    assert files
    for found in files:
        (node,) = found.values()
        assert Settings(node['ros__parameters'])


def _shim(folder: Path) -> dict[str, str]:
    """Return an environment in which the command and this Python are found first."""
    tools = folder / '.tools'
    tools.mkdir()
    for name, arguments in (('valveflow', '-m valveflow_ros.cli'), ('python', '')):
        path = tools / name
        path.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {arguments} "$@"\n')
        path.chmod(0o755)
    python = os.pathsep.join(filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')]))
    return {
        **os.environ, 'PATH': f'{tools}{os.pathsep}{os.environ["PATH"]}', 'PYTHONPATH': python,
    }  # fmt: skip


def _bare(text: str) -> str:
    """Return the words of an output: numbers, blanks and file names may differ."""
    return ' '.join(re.sub(r'[-+−±]?\d[\d\s.,:]*', ' # ', text).split())


def run(page: Path, folder: Path, kinds: tuple[str, ...], environment: dict[str, str]) -> int:
    """Run the blocks of a page one after the other; return how many there were."""
    done = 0
    for block in blocks(page):
        if block.kind not in kinds:
            continue
        if not block.kind.startswith('console'):
            _shell(block, block.text, folder, environment)
            done += 1
            continue
        for part in re.split(r'^\$ ', block.text, flags=re.M)[1:]:
            lines = part.replace('\\\n', ' ').splitlines()
            fails = block.kind == 'console fails'
            said = _bare(_shell(block, lines[0], folder, environment, 1 if fails else 0))
            for line in lines[1:]:
                for piece in filter(None, (_bare(p) for p in line.split('…'))):
                    assert piece in said, f'{block.page}:{block.line}: not said: {line}\n{said}'
            done += 1
    return done


def _shell(
    block: Block, text: str, folder: Path, environment: dict[str, str], status: int = 0
) -> str:
    ended = subprocess.run(
        ['bash', '-euo', 'pipefail', '-c', text],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    said = ended.stdout + ended.stderr
    assert ended.returncode == status, f'{block.page}:{block.line}: {text}\n{said}'
    return said


SHORT = ['docs/tutorial_csv.md', 'README.md', 'docs/troubleshooting.md']


@pytest.fixture(scope='module')
def short_pages(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Future[int]]]:
    """Run the short pages that are asked for, one after the other, beside the live one.

    Most of a command is Python that starts and a monitor that waits: a second core is idle.
    """
    asked = [
        item.callspec.params['name'] for item in request.session.items
        if isinstance(item, pytest.Function) and item.originalname == SHORT_TEST
    ]  # fmt: skip
    with ThreadPoolExecutor(1) as beside:
        begun: dict[str, Future[int]] = {}
        for name in asked:
            folder = tmp_path_factory.mktemp('page')
            begun[name] = beside.submit(run, ROOT / name, folder, RUN, _shim(folder))
        yield begun
        for page in begun.values():
            page.cancel()


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize('name', ['live', 'opcua'])
def test_the_live_tutorials_work(
    name: str, short_pages: dict[str, Future[int]], tmp_path: Path,
    ros_environment: dict[str, str],
) -> None:  # fmt: skip
    if name == 'opcua':
        pytest.importorskip('asyncua')
    environment = {**ros_environment, **_shim(tmp_path)}
    assert run(ROOT / f'docs/tutorial_{name}.md', tmp_path, RUN, environment) > 0


SHORT_TEST = 'test_the_commands_of_a_page_work_in_their_order'


@pytest.mark.parametrize('name', SHORT)
def test_the_commands_of_a_page_work_in_their_order(
    name: str, short_pages: dict[str, Future[int]]
) -> None:
    assert short_pages[name].result() > 0


@pytest.mark.long
@pytest.mark.parametrize('page', sorted({b.page for b in ALL if b.kind == 'sh long'}), ids=str)
def test_the_commands_that_take_minutes_work(page: str, tmp_path: Path) -> None:
    assert run(ROOT / page, tmp_path, ('sh long',), _shim(tmp_path)) > 0
