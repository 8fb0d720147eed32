# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The packages' metadata agree with each other, with the contract and with the lock."""

import ast
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
sys.path.insert(0, str(ROOT / 'tools'))

import headers  # noqa: E402
import versions  # noqa: E402

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
    lines = (ROOT / 'requirements.in').read_text(encoding='utf-8').splitlines()
    return {NAME.match(line)[0] for line in lines if line and not line.startswith('#')}


def entries():
    found = {}
    for entry in re.split(r'\n(?=[A-Za-z0-9])', LOCK):
        if '==' in entry.split('\n')[0]:
            found.setdefault(NAME.match(entry)[0], []).append(entry)
    return found


@pytest.mark.parametrize('folder', ['.', 'msg'])
def test_manifests(folder):
    """colcon takes a package whose mail address it cannot read for something else."""
    root = manifest(folder)
    assert (root.get('format'), root.findtext('license')) == ('3', 'Apache-2.0')
    assert root.findtext('version') == valveflow_ros.__version__
    assert re.fullmatch(r'[\w.]+@[\w.]+\.\w+', root.find('maintainer').get('email'))
    assert root.findtext('url').startswith('https://')
    assert all(root.findtext(name) for name in ('maintainer', 'description'))
    # As rosdep resolves them on Ubuntu 24.04: by apt. Those resolved by pip are refused there.
    assert keys(folder) - {'valveflow_msgs'} <= NATIVE
    text = (ROOT / 'LICENSE').read_text(encoding='utf-8')
    for words in ('Apache License', 'Version 2.0, January 2004', 'END OF TERMS AND CONDITIONS'):
        assert words in text


def test_executables_are_those_of_the_contract(arguments):
    scripts = dict(
        re.split(r'\s*=\s*', line) for line in arguments['entry_points']['console_scripts']
    )
    assert set(scripts) == {
        'monitor', 'opcua_gateway', 'page', 'plant_simulator', 'replay', 'watch', 'valveflow',
    }  # fmt: skip
    for target in scripts.values():
        module, _, name = target.partition(':')
        assert callable(getattr(importlib.import_module(module), name))


def test_packages_and_data_files_are_shipped(arguments):
    """A folder with Python files and without __init__.py would be left behind."""
    folders = {p.parent for p in (ROOT / 'valveflow_ros').rglob('*.py')}
    named = {str(p.relative_to(ROOT)).replace('/', '.') for p in folders}
    assert named == set(arguments['packages'])
    targets = dict(arguments['data_files'])
    assert targets['share/ament_index/resource_index/packages'] == ['resource/valveflow_ros']
    assert targets['share/valveflow_ros'] == ['package.xml']
    assert len(targets['share/valveflow_ros/msg']) == len(list((ROOT / 'msg').glob('*.msg')))
    config = set(targets['share/valveflow_ros/config'])
    assert {f'config/{name}_layout.{kind}' for name, kind in LAYOUTS} <= config
    for files in targets.values():
        assert all((ROOT / name).is_file() for name in files)
    # colcon asks for it; without pytest in it, it would run unittest and find nothing.
    assert 'pytest' in arguments['extras_require']['test']


LAYOUTS = (('foxglove', 'json'), ('plotjuggler', 'xml'))
NATIVE = {
    'ament_cmake', 'ament_index_python', 'builtin_interfaces', 'diagnostic_msgs', 'launch',
    'launch_ros', 'lifecycle_msgs', 'rcl_interfaces', 'rclpy', 'rosgraph_msgs',
    'rosidl_default_generators', 'rosidl_default_runtime', 'std_msgs', 'std_srvs',
    'python3-argcomplete', 'python3-hypothesis', 'python3-matplotlib', 'python3-numba',
    'python3-numpy', 'python3-openpyxl', 'python3-pandas', 'python3-psutil', 'python3-pytest',
    'python3-scipy', 'python3-yaml',
}  # fmt: skip


def keys(folder):
    return {e.text for e in manifest(folder).iter() if e.tag.endswith('depend')}


def imports(path, everywhere):
    """The packages that a file imports, or only those that it cannot be loaded without."""
    parsed = ast.parse(path.read_text(encoding='utf-8'))
    for node in ast.walk(parsed) if everywhere else parsed.body:
        if isinstance(node, ast.Import):
            yield from (alias.name.partition('.')[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition('.')[0]


def test_every_ros_package_that_is_imported_is_a_dependency():
    files = [*(ROOT / 'valveflow_ros').rglob('*.py'), *(ROOT / 'launch').glob('*.py')]
    found = {name for path in files for name in imports(path, everywhere=True)}
    ros = re.compile(r'rclpy|launch(_ros)?|ament_\w+|\w+_(msgs|srvs|interfaces)')
    assert {name for name in found if ros.fullmatch(name)} <= keys('.')


def test_what_apt_does_not_bring_is_said_with_the_command(arguments):
    """What is always needed, and what reads Parquet beside the NumPy of Ubuntu 24.04."""
    needed = {NAME.match(need)[0] for need in arguments['install_requires']}
    by_apt = {key.removeprefix('python3-').replace('yaml', 'pyyaml') for key in keys('.')}
    by_mcap = {'lz4', 'zstandard'}
    page = (ROOT / 'docs' / 'jazzy.md').read_text(encoding='utf-8')
    line = re.search(r'pip install --break-system-packages (.*)', page)[1]
    assert set(line.split()) == needed - by_apt - by_mcap | {"'pyarrow<26'"}
    assert 'rosdep install --from-paths src src/valveflow_ros/msg ' in page
    image = (ROOT / 'docker' / 'Dockerfile.jazzy').read_text(encoding='utf-8')
    taken = re.search(r'--break-system-packages (mcap .*) \\', image)[1]
    assert set(taken.split()) == {*line.split(), 'asyncua'}
    # pip cannot remove what apt has installed.
    assert '--ignore-installed cryptography' in image


def test_an_image_keeps_the_compiled_program_for_every_user():
    """Numba uses a cache only where it can write."""
    for name in ('Dockerfile', 'Dockerfile.jazzy'):
        image = (ROOT / 'docker' / name).read_text(encoding='utf-8')
        cache = re.search(r'NUMBA_CACHE_DIR=(\S+)', image)[1]
        assert re.search(rf'diagnose plant.mcap [^#]*chmod -R a\+rwX {cache}\n', image)


def test_the_tests_load_without_what_apt_does_not_bring():
    """`colcon test` skips what needs such a library, instead of failing to load the file."""
    extras = {
        'dash', 'matplotlib', 'mcap_ros2', 'openpyxl', 'plotly', 'prometheus_client', 'pyarrow',
        'python_calamine', 'rosbags', 'waitress',
    }  # fmt: skip
    for path in (ROOT / 'test').rglob('*.py'):
        body = path.read_text(encoding='utf-8')
        found = extras.intersection(imports(path, everywhere=False))
        assert all(f"pytest.importorskip('{name}'" in body for name in found), path


def run_setup(prefix, *words):
    """Run setup.py as colcon does, beside a prefix; return what it says."""
    done = subprocess.run(
        [sys.executable, 'setup.py', '--dry-run', *words],
        cwd=ROOT, env=os.environ | {'AMENT_PREFIX_PATH': f'/nowhere:{prefix}'},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.stderr


def test_a_build_without_the_messages_says_so(tmp_path):
    # Help is asked for, so nothing is installed.
    said = run_setup(tmp_path, 'install', '--help')
    assert 'WARNING: the message package valveflow_msgs is not built' in said
    assert 'colcon build --base-paths src src/valveflow_ros/msg' in said
    # A wheel needs none.
    assert 'valveflow_msgs' not in run_setup(tmp_path, 'bdist_wheel', '--help')
    marker = tmp_path / 'share/ament_index/resource_index/packages/valveflow_msgs'
    marker.parent.mkdir(parents=True)
    marker.touch()
    assert 'valveflow_msgs' not in run_setup(tmp_path, 'develop', '--help')


def without(module, code):
    """Run code where a module is not installed."""
    return subprocess.run(
        [sys.executable, '-c', f'import sys; sys.modules[{module!r}] = None\n{code}'],
        env=os.environ | {'PYTHONPATH': f'{ROOT}:{os.environ.get("PYTHONPATH", "")}'},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_a_node_without_the_messages_names_the_command():
    """All of them begin with the same check."""
    done = without('valveflow_msgs', 'from valveflow_ros import ros\nsys.exit(ros.page())')
    assert (done.returncode, done.stderr) == (
        1,
        'valveflow page: The message package valveflow_msgs is not found. In the workspace: '
        'colcon build --base-paths src src/valveflow_ros/msg, then source install/setup.bash.\n',
    )


def test_without_mcap_a_log_is_refused_in_words():
    """No rosdep key brings it."""
    code = "from valveflow_ros.cli.main import main\nsys.exit(main(['info', 'README.md']))"
    done = without('mcap', code)
    assert (done.returncode, done.stderr.count('\n')) == (1, 1)
    assert done.stderr.endswith('which is not installed: pip install mcap.\n')


def test_every_source_file_names_copyright_and_licence():
    assert headers.lacking() == [], 'run: python tools/headers.py'


def test_the_oldest_libraries_are_those_that_are_tested(arguments):
    oldest = dict(re.findall(r'^(\w+)==(\d+\.\d+)', '\n'.join(versions.UBUNTU['3.12']), re.M))
    assert set(oldest) == {'numpy', 'scipy', 'pandas', 'numba'}
    assert {f'{name}>={version}' for name, version in oldest.items()} <= set(
        arguments['install_requires']
    )


def test_the_lock_holds_what_is_wanted(arguments):
    names = {NAME.match(requirement)[0] for requirement in arguments['install_requires']}
    assert names <= wanted() <= set(entries()), 'requirements.in has changed; run make lock'
    assert not any(name.startswith('ros') for name in names), 'pip install must work without ROS'


def test_one_version_of_each_for_every_python():
    """The markers of a name's entries do not overlap, and one of them fits."""
    markers = pytest.importorskip('packaging.markers')
    for version in ('3.10', '3.11', '3.12'):
        env = {'python_version': version, 'python_full_version': f'{version}.5',
               'sys_platform': 'linux'}  # fmt: skip
        for name, texts in entries().items():
            found = [re.match(r'\S+( ; (.*))? \\', text)[2] for text in texts]
            fits = [m for m in found if m is None or markers.Marker(m).evaluate(env)]
            assert len(fits) <= 1, name
            assert len(fits) == 1 or name not in wanted(), name


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
        classes = [c for c in metadata.get_all('Classifier') or [] if 'License' in c]
        stated = ' '.join([metadata.get('License-Expression') or '', *classes])
        # Compilers' run-time libraries inside wheels come with an exception that allows it.
        allowed = r'GPL-[\d.]+(-or-later)? ?(WITH |-with-)GCC-exception\S*'
        assert 'GPL' not in re.sub(allowed, '', stated), f'{name}: {stated}'


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
    command = [sys.executable, '-m', 'pip', 'wheel', '--no-deps', '--no-build-isolation']
    done = subprocess.run(
        [*command, '--no-index', '-w', tmp_path, tree], capture_output=True, text=True, check=False
    )  # fmt: skip
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
    files = (p for p in (ROOT / 'valveflow_ros').rglob('*') if '__pycache__' not in p.parts)
    shipped = {str(path.relative_to(ROOT)) for path in files if path.is_file()}
    assert {n for n in names if n.startswith('valveflow_ros/')} == shipped
    share = f'valveflow_ros-{version}.data/data/share'
    assert f'{share}/ament_index/resource_index/packages/valveflow_ros' in names
    assert f'{share}/valveflow_ros/msg/Alarm.msg' in names
    about = tmp_path / 'out' / f'valveflow_ros-{version}.dist-info'
    points = (about / 'entry_points.txt').read_text()
    assert points.strip() == '[console_scripts]\nvalveflow = valveflow_ros.cli.main:main'
    loaded = subprocess.run(
        [sys.executable, '-c', 'import valveflow_ros; print(valveflow_ros.__file__)'],
        cwd=tmp_path, env=os.environ | {'PYTHONPATH': str(tmp_path / 'out')},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert loaded.stdout.startswith(str(tmp_path / 'out'))
