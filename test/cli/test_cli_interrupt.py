# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C at any moment: one sentence, its exit status, nothing half-written."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest

from valveflow_ros.cli import command as shared

SAID = 'valveflow: stopped; nothing was left half-written.\n'


@pytest.fixture
def stopped_at(run, monkeypatch):
    # What a shell starts in the background ignores Ctrl-C, and so may this process.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(sys, 'unraisablehook', sys.unraisablehook)

    def command(part, number, *words):
        command.seen = seen = []

        def progress(self, share, what):
            if what not in seen:
                seen.append(what)
                if len(seen) == part:
                    os.kill(os.getpid(), number)

        monkeypatch.setattr(shared.Console, '__call__', progress)
        return run(*words)

    yield command
    signal.signal(signal.SIGINT, before)


def everything(folder):
    return {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}


def words_of(verb, logs, model, out):
    csv, mcap = logs / 'plant.csv', logs / 'plant.mcap'
    return {
        'simulate': [verb, '-o', out / 'x.mcap', '--days', '0.1'],
        'import': [verb, csv, '-o', out / 'x.mcap'],
        'info': [verb, mcap],
        'export': [verb, mcap, '-o', out / 'x.csv'],
        'recover': [verb, mcap, '-o', out / 'x.mcap'],
        'validate': [verb, mcap, '-o', out / 'new', '--model', model],
        'loop': [verb, csv, '-o', out / 'new', '--command', 'valve_opening_percent',
                 '--process', 'generated_power_mw'],
    }.get(verb, [verb, mcap, '-o', out / 'new', *(
        ['--no-diagnosis'] if verb in ('monitor', 'fleet') else [])])  # fmt: skip


@pytest.mark.parametrize('verb', ['simulate', 'import', 'export', 'recover', 'validate', 'loop'])
def test_ctrl_c_in_every_part_of_a_verb(stopped_at, logs, identified, tmp_path, verb):
    (tmp_path / 'whole').mkdir()
    words = words_of(verb, logs, identified, tmp_path / 'whole')
    assert stopped_at(0, signal.SIGINT, *words).status == 0
    parts = len(stopped_at.seen)
    assert parts, 'the verb tells of no part of its work'
    # Of many parts some from the beginning, the middle and the end.
    for part in sorted({1, parts // 2 + 1, parts}):
        out = tmp_path / str(part)
        out.mkdir()
        ran = stopped_at(part, signal.SIGINT, *words_of(verb, logs, identified, out))
        assert ran.status == 130, ran.err
        assert ran.err.endswith(SAID)
        assert 'Traceback' not in ran.err
        assert everything(out) == {}


@pytest.mark.parametrize(('verb', 'part', 'number'), [
    ('info', 1, signal.SIGINT), ('identify', 1, signal.SIGINT), ('identify', 4, signal.SIGINT),
    ('diagnose', 3, signal.SIGINT), ('compare', 2, signal.SIGINT), ('monitor', 2, signal.SIGINT),
    ('fleet', 1, signal.SIGINT), ('export', 2, signal.SIGTERM),
])  # fmt: skip
def test_a_signal_in_one_part_of_a_verb(
    stopped_at, logs, identified, tmp_path, verb, part, number
):
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    ran = stopped_at(part, number, *words_of(verb, logs, identified, tmp_path))
    assert ran.status == 128 + number, ran.err
    assert ran.err.endswith(SAID)
    assert everything(tmp_path) == {}
    # The handlers of the process come back.
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers


def test_ctrl_c_while_the_interpreter_ends_changes_nothing():
    code = (
        'import atexit, os, signal, sys\n'
        'signal.signal(signal.SIGINT, signal.default_int_handler)\n'
        'from valveflow_ros.cli import main\n'
        'class Last:\n'
        '    def __del__(self, kill=os.kill, me=os.getpid()):\n'
        '        kill(me, 2)\n'
        'sys.last = Last()\n'
        'atexit.register(os.kill, os.getpid(), signal.SIGINT)\n'
        'sys.argv[1:] = ["--version"]\n'
        'sys.exit(main.main())'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('valveflow ')


@pytest.mark.parametrize('seed', range(2))
def test_ctrl_c_at_any_moment_of_a_real_process(logs, identified, tmp_path, seed):
    """From the first import to the last byte; pressed twice, as people do."""
    words = [str(word) for word in words_of('identify', logs, identified, tmp_path)]
    code = (
        'import signal, sys\n'
        # A shell that starts things in the background lets them ignore it.
        'signal.signal(signal.SIGINT, signal.default_int_handler)\n'
        'from valveflow_ros.cli import main\n'
        'usual = main.load\n'
        'main.load = lambda name: print("begun", flush=True) or usual(name)\n'
        f'sys.argv[1:] = {words!r}\n'
        'sys.exit(main.main())'
    )
    done = subprocess.Popen(
        [sys.executable, '-c', code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert done.stdout is not None
    assert done.stdout.readline() == 'begun\n'
    time.sleep(random.Random(seed).uniform(0.0, 1.5))
    for _ in range(2):
        done.send_signal(signal.SIGINT)
    out, err = done.communicate(timeout=60)
    assert 'Traceback' not in err
    if done.returncode:
        assert done.returncode == 130
        assert err.endswith(SAID)
        assert out == ''
        assert everything(tmp_path) == {}
