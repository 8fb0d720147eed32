"""The packages' metadata agree with each other, with the contract and with the lock."""

from __future__ import annotations

import importlib.metadata
import os
import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

import valveflow_ros

ROOT = Path(__file__).resolve().parent.parent
LOCK = (ROOT / 'requirements.lock').read_text(encoding='utf-8')
NAME = re.compile(r'[A-Za-z0-9][A-Za-z0-9._-]*')


@pytest.fixture(scope='module')
def arguments():
    """What setup.py hands to setuptools."""
    caught = {}
    folder = os.getcwd()
    patch = pytest.MonkeyPatch()
    patch.setattr('setuptools.setup', lambda **kwargs: caught.update(kwargs))
    os.chdir(ROOT)
    try:
        runpy.run_path(str(ROOT / 'setup.py'))
    finally:
        os.chdir(folder)
        patch.undo()
    return caught


def manifest(folder):
    return ElementTree.parse(ROOT / folder / 'package.xml').getroot()


def wanted():
    """The names in requirements.in, without extras, versions and comments."""
    lines = (ROOT / 'requirements.in').read_text(encoding='utf-8').splitlines()
    return {NAME.match(line)[0] for line in lines if line and not line.startswith('#')}


def entries():
    """The entries of the lock: name -> text."""
    found = {}
    for entry in re.split(r'\n(?=[A-Za-z0-9])', LOCK):
        if '==' in entry.split('\n')[0]:
            found.setdefault(NAME.match(entry)[0], []).append(entry)
    return found


def test_one_version():
    versions = {manifest('.').findtext('version'), manifest('msg').findtext('version')}
    assert versions == {valveflow_ros.__version__}


@pytest.mark.parametrize('folder', ['.', 'msg'])
def test_manifests(folder):
    """colcon takes a package whose mail address it cannot read for something else."""
    root = manifest(folder)
    assert root.get('format') == '3'
    assert root.findtext('license') == 'Apache-2.0'
    assert re.fullmatch(r'[\w.]+@[\w.]+\.\w+', root.find('maintainer').get('email'))
    assert root.findtext('maintainer')
    assert root.findtext('description')


def test_licence_text():
    text = (ROOT / 'LICENSE').read_text(encoding='utf-8')
    assert 'Apache License' in text
    assert 'Version 2.0, January 2004' in text
    assert 'END OF TERMS AND CONDITIONS' in text


def test_executables_are_those_of_the_contract(arguments):
    scripts = dict(
        re.split(r'\s*=\s*', line) for line in arguments['entry_points']['console_scripts']
    )
    assert set(scripts) == {
        'monitor', 'page', 'plant_simulator', 'replay', 'watch', 'valveflow',
    }  # fmt: skip
    for target in scripts.values():
        assert re.fullmatch(r'valveflow_ros(\.\w+)+:main', target)
        assert (ROOT / (target.split(':')[0].replace('.', '/') + '.py')).is_file()


def test_every_package_is_shipped(arguments):
    """A folder with Python files and without __init__.py would be left behind."""
    folders = {p.parent for p in (ROOT / 'valveflow_ros').rglob('*.py')}
    assert {str(p.relative_to(ROOT)).replace('/', '.') for p in folders} == set(
        arguments['packages']
    )


def test_data_files_exist(arguments):
    targets = dict(arguments['data_files'])
    assert targets['share/ament_index/resource_index/packages'] == ['resource/valveflow_ros']
    assert targets['share/valveflow_ros'] == ['package.xml']
    assert len(targets['share/valveflow_ros/msg']) == len(list((ROOT / 'msg').glob('*.msg')))
    for files in targets.values():
        assert all((ROOT / name).is_file() for name in files)


def test_what_pip_installs_is_in_the_lock(arguments):
    names = {NAME.match(requirement)[0] for requirement in arguments['install_requires']}
    assert names <= wanted()
    assert not any(name.startswith('ros') for name in names), 'pip install must work without ROS'


def test_the_lock_holds_what_is_wanted():
    assert wanted() <= set(entries()), 'requirements.in has changed; run make lock'


@pytest.mark.parametrize('version', ['3.10', '3.11', '3.12'])
def test_one_version_of_each_for_every_python(version):
    """The markers of a name's entries do not overlap, and one of them fits."""
    markers = pytest.importorskip('packaging.markers')
    env = {
        'python_version': version,
        'python_full_version': f'{version}.5',
        'sys_platform': 'linux',
    }
    for name, texts in entries().items():
        found = [re.match(r'\S+( ; (.*))? \\', text)[2] for text in texts]
        fits = [m for m in found if m is None or markers.Marker(m).evaluate(env)]
        assert len(fits) <= 1, name
        if name in wanted():
            assert len(fits) == 1, name


def closure(names):
    """The installed distributions that some names bring along."""
    found, todo = {}, list(names)
    while todo:
        name = todo.pop()
        try:
            distribution = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue  # a marker of another platform
        if distribution.metadata['Name'] in found:
            continue
        found[distribution.metadata['Name']] = distribution
        needs = [need for need in distribution.requires or [] if 'extra ==' not in need]
        todo += [NAME.match(need)[0] for need in needs]
    return found


def test_no_dependency_asks_for_a_gpl(arguments):
    found = closure(NAME.match(need)[0] for need in arguments['install_requires'])
    assert len(found) >= len(arguments['install_requires'])
    for name, distribution in found.items():
        metadata = distribution.metadata
        stated = [
            metadata.get('License-Expression') or '',
            *(metadata.get_all('Classifier') or []),
        ]
        licences = [text for text in stated if 'License' in text or text == stated[0]]
        # Compilers' run-time libraries inside wheels come with an exception that allows it.
        text = re.sub(
            r'GPL-[\d.]+(-or-later)? ?(WITH |-with-)GCC-exception\S*', '', ' '.join(licences)
        )
        assert 'GPL' not in text, f'{name}: {text}'


def test_the_wheel_of_the_pure_part(tmp_path):
    """Pip's wheel holds the package and the command, no tests, and loads without ROS."""
    pytest.importorskip('setuptools')
    tree = tmp_path / 'tree'
    tree.mkdir()
    for name in ('valveflow_ros', 'msg', 'resource', 'config', 'launch', 'test'):
        if (ROOT / name).is_dir():
            ignore = shutil.ignore_patterns('__pycache__')
            shutil.copytree(ROOT / name, tree / name, ignore=ignore)
    for name in ('setup.py', 'setup.cfg', 'pyproject.toml', 'package.xml', 'README.md', 'LICENSE'):
        shutil.copy(ROOT / name, tree)
    command = [
        sys.executable,
        '-m',
        'pip',
        'wheel',
        '--no-deps',
        '--no-build-isolation',
        '--no-index',
    ]
    done = subprocess.run(
        [*command, '-w', tmp_path, tree], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    wheel = next(tmp_path.glob('*.whl'))
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / 'out')
    version = valveflow_ros.__version__
    assert wheel.name == f'valveflow_ros-{version}-py3-none-any.whl'
    assert {n.split('/')[0] for n in names} == {
        'valveflow_ros', f'valveflow_ros-{version}.data', f'valveflow_ros-{version}.dist-info',
    }  # fmt: skip
    files = {
        str(path.relative_to(ROOT))
        for path in (ROOT / 'valveflow_ros').rglob('*')
        if path.is_file() and '__pycache__' not in path.parts
    }
    assert {n for n in names if n.startswith('valveflow_ros/')} == files
    share = f'valveflow_ros-{version}.data/data/share'
    assert f'{share}/ament_index/resource_index/packages/valveflow_ros' in names
    assert f'{share}/valveflow_ros/msg/Alarm.msg' in names
    points = (
        tmp_path / 'out' / f'valveflow_ros-{version}.dist-info' / 'entry_points.txt'
    ).read_text()
    assert points.strip() == '[console_scripts]\nvalveflow = valveflow_ros.cli.main:main'
    loaded = subprocess.run(
        [sys.executable, '-c', 'import valveflow_ros; print(valveflow_ros.__file__)'],
        cwd=tmp_path, env=os.environ | {'PYTHONPATH': str(tmp_path / 'out')},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert loaded.stdout.startswith(str(tmp_path / 'out'))
