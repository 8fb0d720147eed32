# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Who may import whom: between the folders, and between the modules inside each of them."""

import ast
import functools
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = 'valveflow_ros'
HOUSE = ROOT / PACKAGE

# In the order of the data: a folder, or a module at the top, may import from those before it
# that are named, and from itself. '' is the package's own __init__.
BASE = {'errors', 'records', 'parameters', 'numerics', 'state'}
SIGNAL = BASE | {'signals'}
SEGMENT = SIGNAL | {'segments', 'partition'}
MODEL = SEGMENT | {'curve', 'fit'}
METHOD = MODEL | {'monitoring', 'diagnosis', 'baselines', 'plant'}
FACES = METHOD | {'logs', 'opcua', 'report', 'interface', 'page'}
ALLOWED: dict[str, set[str]] = {
    '': {'interface'},
    'errors': set(),
    'records': {'errors'},
    'parameters': {'errors', 'records'},
    'numerics': {'errors', 'records'},
    'state': {'errors', 'records'},
    'signals': BASE,
    'segments': SIGNAL,
    'partition': SIGNAL,
    'curve': SEGMENT,
    'fit': SEGMENT | {'curve'},
    'monitoring': MODEL,
    'diagnosis': MODEL | {'monitoring'},
    'baselines': MODEL | {'monitoring'},
    'plant': BASE,
    'logs': {'errors', 'records'},
    'opcua': SIGNAL | {'plant'},
    'report': METHOD,
    'page': METHOD | {'report'},
    'interface': METHOD | {'logs', 'opcua', 'report'},
    'cli': FACES,
    'ros': FACES,
}
# What only a machine with ROS has; only ros/ may know it.
ROS = {
    'ament_index_python', 'builtin_interfaces', 'diagnostic_msgs', 'launch', 'launch_ros',
    'lifecycle_msgs', 'rcl_interfaces', 'rclpy', 'rosgraph_msgs', 'rosidl_runtime_py',
    'std_msgs', 'std_srvs', 'valveflow_msgs',
}  # fmt: skip
# Time is an argument and files are for logs/: what would bring either in by another door.
WORLDLY = {'asyncio', 'datetime', 'logging', 'pathlib', 'socket', 'subprocess', 'tempfile', 'time'}
PURE = ('signals', 'segments', 'partition', 'curve', 'fit', 'monitoring', 'diagnosis',
        'baselines', 'plant')  # fmt: skip


def sources() -> list[Path]:
    """Every Python file of the package."""
    return sorted(HOUSE.rglob('*.py'))


def room(path: Path) -> str:
    """The folder a file belongs to, or its own name at the top."""
    first = path.relative_to(HOUSE).parts[0]
    return '' if first == '__init__.py' else first.removesuffix('.py')


@functools.cache
def imported(path: Path) -> tuple[tuple[int, str], ...]:
    """Every import of a file, inside functions and type checks too, as an absolute name.

    For ``from a import b`` both ``a`` and ``a.b``: ``b`` may be a module. Names
    handed to ``import_module`` and ``__import__`` as text count as well.
    """
    found = []
    package = [PACKAGE, *path.relative_to(HOUSE).parts][:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'), str(path))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, name.name) for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, *filter(None, [node.module])]
            names = [base, *([*base, name.name] for name in node.names)]
            found += [(node.lineno, '.'.join(name)) for name in names]
        elif isinstance(node, ast.Call) and node.args:
            called = getattr(node.func, 'attr', getattr(node.func, 'id', ''))
            what = getattr(node.args[0], 'value', None)
            if called in ('import_module', '__import__') and isinstance(what, str):
                found.append((node.lineno, what))
    return tuple(found)


def wrong_arrows(path: Path) -> list[str]:
    """What a file imports from folders it may not."""
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


def circles() -> list[list[str]]:
    """Every set of modules that import one another in a circle, type checks included."""
    names = {}
    for path in sources():
        name = '.'.join((PACKAGE, *path.relative_to(HOUSE).with_suffix('').parts))
        names[name.removesuffix('.__init__')] = path
    uses: dict[str, set[str]] = {}
    for name, path in names.items():
        found = {there for _, there in imported(path) if there in names and there != name}
        # The package's own __init__ loads the Python interface when it is asked for; others
        # only take the version from it.
        found.discard(PACKAGE)
        # ``from a import b`` names the package a as well, where b is a module of it.
        uses[name] = {n for n in found if not any(m.startswith(f'{n}.') for m in found)}
    # What imports nothing that is left, or is imported by nothing that is left, is in no circle.
    while ends := [
        n for n in uses if not uses[n] or not any(n in there for there in uses.values())
    ]:
        for name in ends:
            del uses[name]
        for there in uses.values():
            there.difference_update(ends)
    return [[name, *sorted(there)] for name, there in sorted(uses.items())]


def test_arrows():
    """A new folder must be given its arrows here before it has any."""
    assert {room(path) for path in sources()} <= set(ALLOWED)
    assert len(sources()) > 100
    assert [arrow for path in sources() for arrow in wrong_arrows(path)] == []
    assert circles() == []


@pytest.mark.parametrize(
    ('rooms', 'known'),
    [(set(ALLOWED) - {'ros'}, ROS), (set(PURE), WORLDLY), (set(ALLOWED) - {'opcua'}, {'asyncua'})],
    ids=['only ros knows ROS', 'the method has no clock and no files', 'asyncua is an extra'],
)
def test_nobody_knows_what_is_not_his(rooms, known):
    wrong = [
        f'{path.relative_to(ROOT)}:{line} imports {name}'
        for path in sources()
        if room(path) in rooms
        for line, name in imported(path)
        if name.split('.')[0] in known
    ]
    assert wrong == []


# Every form that an import can have.
WRONG = (
    ('cli/x.py', 'def f():\n    import valveflow_ros.ros.node'),
    ('cli/x.py', 'from valveflow_ros import ros'),
    ('cli/x.py', 'from ..ros import node'),
    ('cli/x.py', 'from importlib import import_module\nimport_module("valveflow_ros.ros")'),
    ('fit/deep/x.py', 'from ...plant import unit'),
    ('records.py', 'from valveflow_ros.parameters import TABLE'),
)
RIGHT = (
    ('cli/x.py', 'from valveflow_ros.logs import mcap\nfrom . import table'),
    ('cli/x.py', 'from valveflow_ros import __version__'),
    ('fit/deep/x.py', 'from ..problem import Problem'),
)
CIRCLES = (
    ('from valveflow_ros.fit.a import x', True),
    ('def f():\n    from valveflow_ros.fit import a', True),
    ('if TYPE_CHECKING:\n    from valveflow_ros.fit.a import x', True),
    ('from valveflow_ros.curve.c import x', False),
)


def test_wrong_arrows_and_circles_are_found_and_others_are_not(monkeypatch, tmp_path):
    monkeypatch.setattr(f'{__name__}.HOUSE', tmp_path / PACKAGE)
    monkeypatch.setattr(f'{__name__}.ROOT', tmp_path)

    def write(file: str, text: str) -> Path:
        path = tmp_path / PACKAGE / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        imported.cache_clear()
        return path

    for k, (file, text) in enumerate((*WRONG, *RIGHT)):
        path = write(file, text)
        assert bool(wrong_arrows(path)) is (k < len(WRONG)), text
        path.write_text('')
    write('fit/__init__.py', '')
    write('fit/a.py', 'from valveflow_ros.fit.b import y')
    write('curve/c.py', '')
    for text, caught in CIRCLES:
        write('fit/b.py', text)
        assert bool(circles()) is caught, text
