# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What /diagnostics holds, read from the code of the node without importing ROS."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from docs.page_tables import table

_PACKAGE = Path(__file__).resolve().parent.parent / 'valveflow_ros'
_NODE = _PACKAGE / 'ros' / 'node'

_ABOUT = {
    'input …': 'one for each signal and covariate: is it there, in time, believable, complete',
    'fit': 'is there a curve, is it renewed, what does it lack',
    'model': 'does the model still fit the plant',
    'diagnosis': 'what the last diagnosis said, and whether one is running',
    'alarm': 'the residual alarm, whether or not its last change was announced',
    'reference': 'the curve against its reference',
    'recorder': 'is everything on disk',
    'state': 'is there a state to go on with after a restart',
    'parameters': 'only where a parameter was given that does not exist',
    'name': 'only where another node of the domain bears the name of this one',
}


def _functions(path: Path) -> dict[str, ast.FunctionDef]:
    tree = ast.parse(path.read_text())
    return {n.name: n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)}


def _names(call: ast.Call) -> Iterator[str]:
    """Yield the item's name, `…` for what is filled in."""
    first = call.args[0]
    if isinstance(first, ast.Constant):
        yield str(first.value)
    elif isinstance(first, ast.JoinedStr):
        yield ''.join(str(p.value) if isinstance(p, ast.Constant) else '…' for p in first.values)


def _calls(function: ast.FunctionDef) -> Iterator[ast.Call]:
    yield from (n for n in ast.walk(function) if isinstance(n, ast.Call))


def _keys(function: ast.FunctionDef, all_: dict[str, ast.FunctionDef]) -> list[str]:
    found: dict[str, None] = {}
    called = {getattr(c.func, 'id', getattr(c.func, 'attr', '')) for c in _calls(function)}
    for one in [function, *(all_[n] for n in sorted(called & set(all_)) if n.startswith('_'))]:
        for node in ast.walk(one):
            keys: list[ast.expr | None] = []
            if isinstance(node, ast.Dict):
                keys = list(node.keys)
            elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store):
                keys = [node.slice]
            for key in keys:
                if isinstance(key, ast.Constant) and isinstance(key.value, str):
                    found[key.value] = None
    return list(found)


def items() -> dict[str, list[str]]:
    """Return the keys of every item of the health, by the item's name."""
    found: dict[str, dict[str, None]] = {}
    for path in sorted(_NODE.glob('*.py')):
        functions = _functions(path)
        for function in functions.values():
            for call in _calls(function):
                if getattr(call.func, 'id', '') == 'Item':
                    for name in _names(call):
                        keys = _keys(function, functions)
                        found.setdefault(name, {}).update(dict.fromkeys(keys))
    return {name: list(keys) for name, keys in found.items()}


def diagnostics() -> str:
    """Return every item with its numbers."""
    found = items()
    order = [n for n in _ABOUT if n in found] + [n for n in found if n not in _ABOUT]
    return table(
        ('item', 'tells', 'numbers beside it'),
        ((f'`{n}`', _ABOUT.get(n, ''), ', '.join(found[n])) for n in order),
    )


def reasons() -> str:
    """Return why a reading is not taken, from the comments of the aligner."""
    source = (_PACKAGE / 'signals' / 'align.py').read_text()
    block = source[source.index('REASONS = (') :].split(')')[0]
    rows = re.findall(r"'(\w+)',\s*# (.*)", block)
    return table(('counted as', 'means'), ((f'`{a.replace("_", " ")}`', b) for a, b in rows))
