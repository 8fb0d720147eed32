"""The house's arrows: who may import whom, read from the sources themselves."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = 'valveflow_ros'
HOUSE = ROOT / PACKAGE

# A room of the house -> the rooms it may import from. '' is the package's own
# __init__ with its version. A room may always import from itself.
ALLOWED: dict[str, set[str]] = {
    '': set(),
    'errors': set(),
    'records': {'errors'},
    'config': {'errors', 'records'},
    'core': {'errors', 'records', 'config'},
    'diagnosis': {'errors', 'records', 'config', 'core'},
    'compare': {'errors', 'records', 'config', 'core'},
    'plant': {'errors', 'records', 'config', 'core'},
    'logs': {'errors', 'records'},
    'report': {'errors', 'records', 'config', 'core', 'diagnosis', 'compare', 'plant'},
    'cli': {
        'errors', 'records', 'config', 'core', 'diagnosis', 'compare', 'plant', 'report', 'logs',
    },
    'ros': {
        'errors', 'records', 'config', 'core', 'diagnosis', 'compare', 'plant', 'report', 'logs',
    },
}  # fmt: skip
# What only a machine with ROS has; only ros/ may know it.
ROS = {
    'ament_index_python',
    'builtin_interfaces',
    'diagnostic_msgs',
    'launch',
    'launch_ros',
    'lifecycle_msgs',
    'rcl_interfaces',
    'rclpy',
    'rosgraph_msgs',
    'rosidl_runtime_py',
    'std_msgs',
    'std_srvs',
    'valveflow_msgs',
}
# Time is an argument and files are for logs/: what would bring either in by another door.
WORLDLY = {'asyncio', 'datetime', 'logging', 'pathlib', 'socket', 'subprocess', 'tempfile', 'time'}
PURE = ('core', 'diagnosis', 'compare', 'plant')


def sources() -> list[Path]:
    """Every Python file of the package."""
    return sorted(HOUSE.rglob('*.py'))


def room(path: Path) -> str:
    """The room a file belongs to: its first folder, or its own name at the root."""
    first = path.relative_to(HOUSE).parts[0]
    return '' if first == '__init__.py' else first.removesuffix('.py')


def imported(path: Path) -> Iterator[tuple[int, str]]:
    """Every import of a file, inside functions and type checks too, as an absolute name.

    For ``from a import b`` both ``a`` and ``a.b``: ``b`` may be a module. Names
    handed to ``import_module`` and ``__import__`` as text count as well.
    """
    package = ('.'.join((PACKAGE, *path.relative_to(HOUSE).parts))).split('.')[:-2]
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'), str(path))):
        if isinstance(node, ast.Import):
            for name in node.names:
                yield node.lineno, name.name
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, *([node.module] if node.module else [])]
            yield node.lineno, '.'.join(base)
            for name in node.names:
                yield node.lineno, '.'.join([*base, name.name])
        elif isinstance(node, ast.Call) and node.args:
            called = getattr(node.func, 'attr', getattr(node.func, 'id', ''))
            what = node.args[0]
            text = isinstance(what, ast.Constant) and isinstance(what.value, str)
            if called in ('import_module', '__import__') and text:
                yield node.lineno, what.value


def wrong_arrows(path: Path) -> list[str]:
    """What a file imports from rooms it may not."""
    here = room(path)
    allowed = ALLOWED[here] | {here, ''}
    wrong = []
    for line, name in imported(path):
        parts = name.split('.')
        if parts[0] != PACKAGE:
            continue
        there = parts[1] if len(parts) > 1 and parts[1] in ALLOWED else ''
        if there not in allowed:
            wrong.append(f'{path.relative_to(ROOT)}:{line} imports {name}')
    return wrong


def test_every_room_is_known():
    """A new folder must be given its arrows here before it has any."""
    assert sources(), 'no sources found'
    assert {room(path) for path in sources()} <= set(ALLOWED)


def test_arrows():
    assert [arrow for path in sources() for arrow in wrong_arrows(path)] == []


def test_only_ros_knows_ros():
    wrong = [
        f'{path.relative_to(ROOT)}:{line} imports {name}'
        for path in sources()
        if room(path) != 'ros'
        for line, name in imported(path)
        if name.split('.')[0] in ROS
    ]
    assert wrong == []


def test_the_pure_rooms_have_no_clock_and_no_files():
    wrong = [
        f'{path.relative_to(ROOT)}:{line} imports {name}'
        for path in sources()
        if room(path) in PURE
        for line, name in imported(path)
        if name.split('.')[0] in WORLDLY
    ]
    assert wrong == []


@pytest.mark.parametrize(
    ('file', 'text', 'caught'),
    [
        ('cli/x.py', 'from valveflow_ros.ros import node', True),
        ('cli/x.py', 'def f():\n    import valveflow_ros.ros.node', True),
        ('cli/x.py', 'from valveflow_ros import ros', True),
        ('cli/x.py', 'from ..ros import node', True),
        (
            'cli/x.py',
            'from importlib import import_module\nimport_module("valveflow_ros.ros")',
            True,
        ),
        ('cli/x.py', 'from valveflow_ros.logs import mcap', False),
        ('cli/x.py', 'from . import table', False),
        ('cli/x.py', 'from valveflow_ros import __version__', False),
        ('core/x.py', 'from valveflow_ros.plant import unit', True),
        ('core/x.py', 'from valveflow_ros.logs import mcap', True),
        ('core/a/x.py', 'from ...plant import unit', True),
        ('core/a/x.py', 'from ..units import u', False),
        ('plant/x.py', 'from valveflow_ros.diagnosis import gain', True),
        ('diagnosis/x.py', 'from valveflow_ros.plant import unit', True),
        ('logs/x.py', 'from valveflow_ros.config import table', True),
        ('logs/x.py', 'from valveflow_ros.records import Readings', False),
        ('records.py', 'from valveflow_ros.config import table', True),
    ],
)
def test_the_reader_of_arrows_catches(file, text, caught, monkeypatch, tmp_path):
    """The reader itself is tried on arrows that are right and wrong."""
    monkeypatch.setattr(f'{__name__}.HOUSE', tmp_path / PACKAGE)
    monkeypatch.setattr(f'{__name__}.ROOT', tmp_path)
    path = tmp_path / PACKAGE / file
    path.parent.mkdir(parents=True)
    path.write_text(text)
    assert bool(wrong_arrows(path)) is caught
