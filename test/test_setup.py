# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The set-up: which Python it takes, what it says of a machine that lacks something, env.sh."""

import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / 'tools'))

import machine  # noqa: E402
import packages  # noqa: E402
import tree  # noqa: E402
import wheels  # noqa: E402

VERSION = '{}.{}'.format(*sys.version_info[:2])

# --- what is said of a machine ---------------------------------------------------------------


@pytest.mark.parametrize(('language', 'variable', 'names'), machine.COMPILERS)
def test_no_compiler(monkeypatch, tmp_path, language, variable, names):
    monkeypatch.setenv('PATH', str(tmp_path))
    monkeypatch.delenv(variable, raising=False)
    sentence = f'no {language} compiler.*sudo apt install build-essential'
    with pytest.raises(tree.SetupError, match=sentence.replace('+', r'\+')):
        machine.check_compiler(language, variable, names)
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


def test_the_platform_of_the_wheels(monkeypatch):
    for system, processor, libc, fits in (
        ('linux', 'x86_64', ('glibc', '2.28'), True),
        ('linux', 'x86_64', ('glibc', '2.17'), False),
        ('linux', 'x86_64', ('', ''), False),
        ('linux', 'aarch64', ('glibc', '2.36'), False),
        ('darwin', 'x86_64', ('', ''), False),
    ):
        monkeypatch.setattr(machine.sys, 'platform', system)
        monkeypatch.setattr(machine.platform, 'machine', lambda processor=processor: processor)
        monkeypatch.setattr(machine.platform, 'libc_ver', lambda libc=libc: libc)
        if fits:
            machine.check_platform()
            continue
        sentence = rf'this is {system} {processor}.*colcon build --base-paths \. msg'
        with pytest.raises(tree.SetupError, match=sentence):
            machine.check_platform()


def test_paths_that_the_build_cannot_take(monkeypatch):
    monkeypatch.setattr(machine, 'ROOT', Path('/a/b-c_d.e'))
    machine.check_path()
    for path in ('/a/b c', '/a/b:c'):
        monkeypatch.setattr(machine, 'ROOT', Path(path))
        with pytest.raises(tree.SetupError, match='move the folder'):
            machine.check_path()


def test_the_reason_is_read_from_the_output():
    for output, why in (
        ('ok\nE: [Errno -3] Temporary failure in name resolution\nERROR: No match', 'no address'),
        ('cause: dns error', 'no address'),
        ("Retrying after connection broken by 'NewConnectionError(... refused)'", 'no connection'),
        ('ERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS', 'another hash'),
        ('OSError: [Errno 28] No space left on device', 'no space left'),
        ('one\nfoo.c:3:1: error: expected identifier\nmore errors', 'foo.c:3:1: error: expected'),
        ('one\ntwo\n\n', 'two'),
        ('', 'printed nothing'),
    ):
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
    assert {k: env[k] for k in tree.FOREIGN if k in env} == {'AMENT_PREFIX_PATH': 'ours'}
    assert env['PATH'].startswith(f'{tree.VENV}/bin:')


# --- the steps -------------------------------------------------------------------------------


@pytest.mark.parametrize('core', ['_core', 'core'])
def test_cmake_files_are_repaired_once_and_never_in_place(monkeypatch, tmp_path, core):
    """The installer's cache, which shares the file, keeps its own content."""
    monkeypatch.setattr(wheels, 'VENV', tmp_path / 'venv')
    site = tmp_path / 'venv' / 'lib' / f'python{VERSION}' / 'site-packages'
    headers, folder = site / 'numpy' / core / 'include', tmp_path / 'venv/share/any_msgs/cmake'
    headers.mkdir(parents=True)
    folder.mkdir(parents=True)
    cache = tmp_path / 'cached.cmake'
    before = (
        'INCLUDE "/opt/python/cp311-cp311/include/python3.11;'
        '/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include"\n'
        'OTHER "/opt/ros/jazzy/include"\n'
    )
    cache.write_text(before)
    os.link(cache, folder / 'export.cmake')
    (folder / 'plain.cmake').write_text('set(x "/opt/ros/jazzy")\n')
    assert wheels.repair_cmake() == 1
    text = (folder / 'export.cmake').read_text()
    include, numpy = text.split('"')[1].split(';')
    assert Path(include, 'Python.h').is_file()
    assert (Path(numpy), '/opt/python' in text) == (headers, False)
    assert 'OTHER "/opt/ros/jazzy/include"' in text
    assert cache.read_text() == before
    assert wheels.repair_cmake() == 0
    assert (folder / 'export.cmake').read_text() == text
    assert sorted(p.name for p in folder.iterdir()) == ['export.cmake', 'plain.cmake']


def test_keys_change_with_what_they_depend_on_and_nothing_else(monkeypatch, tmp_path):
    for name in ('msg', 'resource', 'tools', 'valveflow_ros', 'launch'):
        (tmp_path / name).mkdir()
    for name in ('msg/A.msg', 'package.xml', 'setup.py', 'setup.cfg', 'tools/quick_build.cmake'):
        (tmp_path / name).write_text(name)
    for module, name, value in (
        (packages, 'ROOT', tmp_path), (tree, 'ROOT', tmp_path),
        (packages, 'QUICK', tmp_path / 'tools' / 'quick_build.cmake'),
        (packages, '__file__', str(tmp_path / 'tools' / 'quick_build.cmake')),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, value)

    def keys():
        messages = packages.messages_key('wheels')
        return messages, packages.node_key(messages)

    first = keys()
    (tmp_path / 'valveflow_ros' / 'new.py').write_text('x = 1')
    assert keys() == first
    (tmp_path / 'launch' / 'demo.launch.py').write_text('')
    second = keys()
    assert (second[0] == first[0], second[1] == first[1]) == (True, False)
    (tmp_path / 'msg' / 'A.msg').write_text('other')
    third = keys()
    assert not set(third) & set(second)
    monkeypatch.setenv('CC', 'another-cc')
    assert keys()[0] != third[0]


def test_a_build_of_somebody_else_is_not_removed(monkeypatch, tmp_path):
    install = tmp_path / 'install'
    monkeypatch.setattr(packages, 'INSTALL', install)
    packages.check_install()
    (install / 'valveflow_ros').mkdir(parents=True)
    with pytest.raises(tree.SetupError, match='did not make'):
        packages.check_install()
    tree.stamp(install, 'unfinished')
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


# --- which Python it takes -------------------------------------------------------------------


@pytest.fixture
def bare(tmp_path):
    """A folder with a set-up that only reports who runs it, and an empty PATH to fill."""
    (tmp_path / 'tools').mkdir()
    (tmp_path / 'bin').mkdir()
    shutil.copy(ROOT / 'tools' / 'setup.sh', tmp_path / 'tools')
    script = 'import sys; print("handed over to %d.%d" % sys.version_info[:2])\n'
    (tmp_path / 'tools' / 'setup_tree.py').write_text(script)
    for tool in ('dirname', 'sed', 'sh'):
        (tmp_path / 'bin' / tool).symlink_to(shutil.which(tool))
    return tmp_path


def add(bare, name, text):
    program = bare / 'bin' / name
    program.write_text(f'#!/bin/sh\n{text}\n')
    program.chmod(0o755)


def real(bare, *blocked):
    """A line that runs this Python as if it lacked some modules."""
    missing = bare / 'missing'
    missing.mkdir(exist_ok=True)
    for module in blocked:
        (missing / f'{module}.py').write_text('raise ImportError')
    # The wheels of ROS start Python twice, and would do so without the path given here.
    start = f'PYTHONPATH={missing} _ROS_WHEELS_BOOTSTRAP_COMPLETE=1'
    return f'{start} exec {sys.executable} "$@"'


def set_up(bare, **env):
    """Run the set-up on the bare machine."""
    return subprocess.run(
        [shutil.which('sh'), bare / 'tools' / 'setup.sh'],
        env={'PATH': str(bare / 'bin')} | env, capture_output=True, text=True, check=False,
    )  # fmt: skip


def assert_one_sentence(done, *words):
    """It failed, and said why in one line that holds the words."""
    assert (done.returncode, done.stdout, done.stderr.count('\n')) == (1, '', 1)
    assert done.stderr.startswith('setup: ')
    for word in words:
        assert word in done.stderr


def test_without_a_python_that_will_do_one_sentence_says_so(bare):
    assert_one_sentence(set_up(bare), 'no CPython 3.10, 3.11 or 3.12', 'sudo apt install python3')
    add(bare, 'python3', 'echo "wrong cpython 3.9"')
    assert_one_sentence(set_up(bare), '(python3 is cpython 3.9)', 'sudo apt install')


def test_a_shim_that_does_not_run_is_passed_over(bare):
    add(bare, 'python3.12', 'echo "shim: python3.12: command not found" >&2; exit 127')
    add(bare, 'python3', real(bare))
    done = set_up(bare)
    assert (done.returncode, done.stdout) == (0, f'handed over to {VERSION}\n')


@pytest.mark.parametrize('module', ['venv', 'ensurepip'])
def test_a_python_without_venv_is_named_and_does_not_hide_a_whole_one(bare, module):
    add(bare, 'python3.11', real(bare, module))
    assert_one_sentence(set_up(bare), 'venv', f'sudo apt install python{VERSION}-venv')
    add(bare, 'python3', f'exec {sys.executable} "$@"')
    # What was exported for another Python does no harm.
    assert set_up(bare, PYTHONHOME='/nowhere', PYTHONPATH='/nowhere').returncode == 0


def test_the_python_asked_for_is_the_only_one_tried(bare):
    add(bare, 'python3', real(bare))
    asked = bare / 'bin' / 'python2'
    assert_one_sentence(set_up(bare, PYTHON=str(asked)), f'PYTHON={asked}')
    assert set_up(bare, PYTHON='python3').returncode == 0


def test_the_python_of_the_environment_is_kept(bare):
    (bare / '.venv' / 'lib' / f'python{VERSION}').mkdir(parents=True)
    (bare / '.venv' / 'pyvenv.cfg').write_text(f'home = {bare / "home"}\n')
    (bare / 'home').mkdir()
    add(bare, f'../home/python{VERSION}', f'echo kept >&2; exec {sys.executable} "$@"')
    add(bare, 'python3.12', 'echo "good 3.12"')
    done = set_up(bare)
    assert (done.returncode, 'kept' in done.stderr) == (0, True)


# --- env.sh ----------------------------------------------------------------------------------

PATHS = ('PATH', 'PYTHONPATH', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH')
each_shell = pytest.mark.parametrize('shell', ['bash', 'zsh', 'dash'])


@pytest.fixture
def house(tmp_path):
    """A folder that looks like a tree after the set-up."""
    house = tmp_path / 'house'
    site = house / '.venv' / 'lib' / 'python3.11' / 'site-packages'
    for folder in ('tools', '.venv/bin', site / 'ros_a.libs', 'install'):
        (house / folder).mkdir(parents=True)
    shutil.copy(ROOT / 'env.sh', house)
    for name in ('package.xml', 'tools/setup_tree.py', 'install/.valveflow-setup'):
        (house / name).touch()
    (house / '.venv' / 'bin' / 'python').touch(mode=0o755)
    return house


def sourced(shell, folder, script, **env):
    """Run a script in a shell that stops at the first error and unset name."""
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f'{shell} is not installed here')
    bare = {'PATH': '/usr/bin:/bin', 'HOME': '/nowhere'}
    return subprocess.run(
        [program, '-c', f'set -eu\n{script}'], cwd=folder, env=bare | env, capture_output=True,
        text=True, check=False,
    )  # fmt: skip


def variables(text):
    lines = dict(line.split('=', 1) for line in text.splitlines() if '=' in line)
    return {k: v for k, v in lines.items() if k not in ('_', 'SHLVL', 'OLDPWD')}


@each_shell
def test_what_it_sets_is_the_same_the_second_time_and_nothing_else_is_left(house, shell):
    done = sourced(shell, house, f'. {house}/env.sh; env')
    assert (done.returncode, done.stderr) == (0, '')
    env = variables(done.stdout)
    install, venv = f'{house}/install', f'{house}/.venv'
    site = 'lib/python3.11/site-packages'
    assert {name: env[name] for name in PATHS} == {
        'PATH': f'{install}/valveflow_ros/bin:{venv}/bin:/usr/bin:/bin',
        'AMENT_PREFIX_PATH': f'{install}/valveflow_ros:{install}/valveflow_msgs:{venv}',
        'PYTHONPATH': f'{house}/build/valveflow_ros:{install}/valveflow_ros/{site}:'
        f'{install}/valveflow_msgs/{site}',
        'LD_LIBRARY_PATH': f'{install}/valveflow_msgs/lib:{venv}/lib:{venv}/{site}/ros_a.libs',
    }
    names = ('RMW_IMPLEMENTATION', 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_DISTRO', 'VIRTUAL_ENV')
    assert [env[n] for n in names] == ['rmw_fastrtps_cpp', 'LOCALHOST', 'jazzy', venv]
    twice = sourced(shell, house, f'. {house}/env.sh; . {house}/env.sh; env')
    assert variables(twice.stdout) == env
    names = sourced(shell, house, f'. {house}/env.sh; set; command -v _vf_put || echo none')
    assert [line for line in names.stdout.splitlines() if line.startswith('_vf_')] == []
    assert names.stdout.endswith('none\n')


@each_shell
def test_before_the_set_up_it_says_so_and_changes_nothing(house, shell):
    (house / 'install' / '.valveflow-setup').unlink()
    before = sourced(shell, house, 'env')
    # dash ends at once under set -e, whatever stands behind the dot command.
    done = sourced(shell, house, f'set +e; . {house}/env.sh; echo status $?; env')
    assert 'status 1\n' in done.stdout
    assert done.stderr == f'env.sh: not set up yet; run: make -C {house} setup\n'
    assert variables(done.stdout) == variables(before.stdout)


@each_shell
def test_what_was_there_stays_but_another_ros_is_set_aside_in_this_shell(house, shell, tmp_path):
    ros, overlay = tmp_path / 'opt' / 'ros', tmp_path / 'overlay'
    marker = ros / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'rclpy'
    marker.parent.mkdir(parents=True)
    marker.touch()
    done = sourced(
        shell, house, f'. {house}/env.sh; env', ROS_AUTOMATIC_DISCOVERY_RANGE='OFF',
        AMENT_PREFIX_PATH=f'{overlay}:{ros}', PYTHONPATH=f'/b c:{overlay}/py:{ros}/py',
        LD_LIBRARY_PATH=f'{ros}/lib:/a', PATH=f'{ros}/bin:/usr/bin:/bin',
    )  # fmt: skip
    said = f'env.sh: the ROS installation in {ros} is set aside in this shell\n'
    assert (done.returncode, done.stderr) == (0, said)
    env = variables(done.stdout)
    ends = {'AMENT_PREFIX_PATH': overlay, 'PYTHONPATH': f'/b c:{overlay}/py',
            'LD_LIBRARY_PATH': '/a', 'PATH': '/usr/bin:/bin'}  # fmt: skip
    for name, end in ends.items():
        assert env[name].endswith(f':{end}')
        assert f'{ros}/' not in env[name] + '/'
    assert env['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'OFF'
    assert sorted(p.name for p in ros.iterdir()) == ['share']


def test_it_is_found_from_any_folder_or_says_what_to_do(house, tmp_path):
    for shell in filter(shutil.which, ('bash', 'zsh')):
        done = sourced(shell, tmp_path, '. house/env.sh; cd /; env')
        assert variables(done.stdout)['VIRTUAL_ENV'] == f'{house}/.venv', done.stderr
    done = sourced('dash', tmp_path, f'. {house}/env.sh')
    assert (done.returncode, done.stderr) == (
        1, 'env.sh: this shell cannot tell where env.sh lies; source it from its own folder\n'
    )  # fmt: skip


# --- what it carries -------------------------------------------------------------------------


def test_a_domain_is_held_for_this_test_alone(ros_environment):
    import rclpy

    domain = int(ros_environment['ROS_DOMAIN_ID'])
    assert 1 <= domain <= 101
    path = Path(tempfile.gettempdir(), f'valveflow-ros-domain-{domain}.lock')
    with path.open('r+') as other, pytest.raises(BlockingIOError):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    assert rclpy.get_rmw_implementation_identifier() == 'rmw_fastrtps_cpp'
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        assert context.get_domain_id() == domain
    finally:
        context.try_shutdown()
