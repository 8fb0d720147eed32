# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The set-up on machines that lack something: one sentence that names it and its cure."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / 'tools'))

import machine  # noqa: E402
import packages  # noqa: E402
import tree  # noqa: E402
import wheels  # noqa: E402


@pytest.mark.parametrize(('language', 'variable', 'names'), machine.COMPILERS)
def test_no_compiler(monkeypatch, tmp_path, language, variable, names):
    monkeypatch.setenv('PATH', str(tmp_path))
    monkeypatch.delenv(variable, raising=False)
    with pytest.raises(tree.SetupError) as caught:
        machine.check_compiler(language, variable, names)
    assert f'no {language} compiler' in str(caught.value)
    assert 'sudo apt install build-essential' in str(caught.value)
    monkeypatch.setenv(variable, 'ccache nowhere-cc')
    with pytest.raises(tree.SetupError, match=f'{variable}=ccache'):
        machine.check_compiler(language, variable, names)
    (tmp_path / 'ccache').touch(mode=0o755)
    machine.check_compiler(language, variable, names)


def test_no_headers(monkeypatch, tmp_path):
    machine.check_headers()
    monkeypatch.setattr(machine.sysconfig, 'get_config_var', lambda _: str(tmp_path))
    with pytest.raises(tree.SetupError, match=r'Python\.h.*sudo apt install python3\.\d+-dev'):
        machine.check_headers()


@pytest.mark.parametrize(
    ('system', 'processor', 'libc', 'fits'),
    [
        ('linux', 'x86_64', ('glibc', '2.28'), True),
        ('linux', 'x86_64', ('glibc', '2.40'), True),
        ('linux', 'x86_64', ('glibc', '2.17'), False),
        ('linux', 'x86_64', ('', ''), False),
        ('linux', 'aarch64', ('glibc', '2.36'), False),
        ('darwin', 'x86_64', ('', ''), False),
    ],
)
def test_the_platform_of_the_wheels(monkeypatch, system, processor, libc, fits):
    monkeypatch.setattr(machine.sys, 'platform', system)
    monkeypatch.setattr(machine.platform, 'machine', lambda: processor)
    monkeypatch.setattr(machine.platform, 'libc_ver', lambda: libc)
    if fits:
        machine.check_platform()
        return
    with pytest.raises(tree.SetupError, match=r'colcon build --base-paths \. msg') as caught:
        machine.check_platform()
    assert f'this is {system} {processor}' in str(caught.value)


@pytest.mark.parametrize(
    ('path', 'fits'), [('/a/b-c_d.e', True), ('/a/b c', False), ('/a/b:c', False)]
)
def test_paths_that_the_build_cannot_take(monkeypatch, path, fits):
    monkeypatch.setattr(machine, 'ROOT', Path(path))
    if fits:
        machine.check_path()
        return
    with pytest.raises(tree.SetupError, match='move the folder'):
        machine.check_path()


@pytest.mark.parametrize(
    ('output', 'why'),
    [
        ('ok\nE: [Errno -3] Temporary failure in name resolution\nERROR: No match', 'no address'),
        ('cause: dns error', 'no address'),
        ("Retrying after connection broken by 'NewConnectionError(... refused)'", 'no connection'),
        ('ERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS', 'another hash'),
        ('OSError: [Errno 28] No space left on device', 'no space left'),
        ('one\nfoo.c:3:1: error: expected identifier\nmore errors', 'foo.c:3:1: error: expected'),
        ('one\ntwo\n\n', 'two'),
        ('', 'printed nothing'),
    ],
)
def test_the_reason_is_read_from_the_output(output, why):
    assert why in tree.reason(output)
    assert '\n' not in tree.reason(output)


def test_a_command_that_fails_says_why(tmp_path):
    log = tmp_path / 'log'
    log.write_text('an error of an earlier command\n')
    assert tree.run(['sh', '-c', 'true'], log) is None
    assert tree.run(['sh', '-c', 'echo fine; echo this failed >&2; exit 3'], log) == 'this failed'
    assert 'fine\nthis failed\n' in log.read_text()


def test_children_do_not_see_another_ros(monkeypatch):
    for name in tree.FOREIGN:
        monkeypatch.setenv(name, '/opt/ros/jazzy')
    env = tree.clean_environment(AMENT_PREFIX_PATH='ours')
    assert [name for name in tree.FOREIGN if name in env] == ['AMENT_PREFIX_PATH']
    assert env['AMENT_PREFIX_PATH'] == 'ours'
    assert env['PATH'].startswith(f'{tree.VENV}/bin:')


@pytest.mark.parametrize('core', ['_core', 'core'])
def test_cmake_files_are_repaired_once_and_never_in_place(monkeypatch, tmp_path, core):
    """The installer's cache, which shares the file, keeps its own content."""
    monkeypatch.setattr(wheels, 'VENV', tmp_path / 'venv')
    version = 'python{}.{}'.format(*sys.version_info[:2])
    headers = tmp_path / 'venv' / 'lib' / version / 'site-packages' / 'numpy' / core / 'include'
    headers.mkdir(parents=True)
    folder = tmp_path / 'venv' / 'share' / 'any_msgs' / 'cmake'
    folder.mkdir(parents=True)
    cache = tmp_path / 'cached.cmake'
    cache.write_text(
        'INCLUDE "/opt/python/cp311-cp311/include/python3.11;'
        '/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include"\n'
        'OTHER "/opt/ros/jazzy/include"\n'
    )
    os.link(cache, folder / 'export.cmake')
    untouched = folder / 'plain.cmake'
    untouched.write_text('set(x "/opt/ros/jazzy")\n')
    before = cache.read_text()

    assert wheels.repair_cmake() == 1
    text = (folder / 'export.cmake').read_text()
    assert '/opt/python' not in text
    include, numpy = text.split('"')[1].split(';')
    assert Path(include, 'Python.h').is_file()
    assert Path(numpy) == headers
    assert 'OTHER "/opt/ros/jazzy/include"' in text
    assert cache.read_text() == before

    assert wheels.repair_cmake() == 0
    assert (folder / 'export.cmake').read_text() == text
    assert sorted(p.name for p in folder.iterdir()) == ['export.cmake', 'plain.cmake']


def test_keys_change_with_what_they_depend_on_and_nothing_else(monkeypatch, tmp_path):
    for name in ('msg', 'resource', 'tools', 'valveflow_ros'):
        (tmp_path / name).mkdir()
    for name in ('msg/A.msg', 'package.xml', 'setup.py', 'setup.cfg', 'tools/quick_build.cmake'):
        (tmp_path / name).write_text(name)
    monkeypatch.setattr(packages, 'ROOT', tmp_path)
    monkeypatch.setattr(tree, 'ROOT', tmp_path)
    monkeypatch.setattr(packages, 'QUICK', tmp_path / 'tools' / 'quick_build.cmake')
    monkeypatch.setattr(packages, '__file__', str(tmp_path / 'tools' / 'quick_build.cmake'))

    def keys():
        messages = packages.messages_key('wheels')
        return messages, packages.node_key(messages)

    first = keys()
    (tmp_path / 'valveflow_ros' / 'new.py').write_text('x = 1')
    assert keys() == first
    (tmp_path / 'launch').mkdir()
    (tmp_path / 'launch' / 'demo.launch.py').write_text('')
    second = keys()
    assert second[0] == first[0]
    assert second[1] != first[1]
    (tmp_path / 'msg' / 'A.msg').write_text('other')
    third = keys()
    assert third[0] != second[0]
    assert third[1] != second[1]
    monkeypatch.setenv('CC', 'another-cc')
    assert keys()[0] != third[0]


def test_a_build_of_somebody_else_is_not_removed(monkeypatch, tmp_path):
    monkeypatch.setattr(packages, 'INSTALL', tmp_path / 'install')
    packages.check_install()
    (tmp_path / 'install').mkdir()
    packages.check_install()
    (tmp_path / 'install' / 'valveflow_ros').mkdir()
    with pytest.raises(tree.SetupError, match='did not make'):
        packages.check_install()
    tree.stamp(tmp_path / 'install', 'unfinished')
    packages.check_install()


def test_only_the_installers_are_taken_from_the_lock_first():
    text = wheels.locked(('setuptools', 'uv'))
    entries = [line for line in text.splitlines() if '==' in line]
    assert [line.split('==')[0] for line in entries] == ['setuptools', 'uv']
    assert text.count('--hash=sha256:') >= len(entries)


@pytest.mark.skipif(Path(sys.prefix) != tree.VENV, reason='does not run in the set-up .venv')
def test_a_second_set_up_does_nothing():
    """It says nothing, too, and leaves what it made as it was."""
    # Tried only where nothing is to be done: a build now would pull the floor from other tests.
    assert packages.packages_done(wheels.wheels_key()), 'install/ is out of date; run make setup'
    stamps = [p / tree.STAMP for p in (tree.VENV, tree.INSTALL / 'valveflow_msgs')]
    before = [p.stat().st_mtime_ns for p in stamps]
    done = subprocess.run(
        ['sh', ROOT / 'tools' / 'setup.sh'], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
    assert [p.stat().st_mtime_ns for p in stamps] == before
