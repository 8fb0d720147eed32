# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables for the handbook, made from the code: verbs, topics, parameters, messages."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from valveflow_ros.cli.main import VERBS
from valveflow_ros.opcua.mapping import LINK, NODE, SECURITY, USER
from valveflow_ros.parameters import TABLE, Parameter
from valveflow_ros.records import SIGNALS

ROOT = Path(__file__).resolve().parent.parent
_NODE = ROOT / 'valveflow_ros' / 'ros'

# What each output is good for, in a line; the test asks for all of them.
_OUTPUTS = {
    'characteristic': 'the curve with its errors',
    'breakpoints': 'the same for standard clients: the breakpoints',
    'slopes': 'the same for stock clients: the slopes',
    'prediction': 'each row: measured, predicted, residual, limits',
    'segments': 'each special segment when it closes',
    'alarms': "each change of an alarm's state; active alarms are sent again at least once a day",
    'diagnosis': 'what the simulation gets wrong: verdict, causes, gain, one sentence',
    'journal': 'each decision that is not a row; it makes a replay exact',
}
_UNIT_WORDS = {
    'valve_opening': ' of full opening',
    'main_steam_pressure': ', absolute',
    'valve_command': ', the commanded opening',
}
_SERVICES = {
    'refit': 'find the curve anew now',
    'acknowledge_alarms': 'somebody has seen the standing alarms',
    'shelve_alarms': 'put the standing alarms aside for `alarm_shelve_time`',
    'unshelve_alarms': 'take them back',
    'set_reference': "today's curve is what later ones are judged against",
    'diagnose': 'diagnose the window now; the result follows on `~/diagnosis`',
}


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [_row(head), _row(['---'] * len(head)), *(_row(row) for row in rows)]
    return '\n'.join(lines) + '\n'


def _row(cells: Sequence[str]) -> str:
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |'


def verbs() -> str:
    """Return the verbs of the command."""
    return table(('verb', 'does'), ((f'`{name}`', about) for name, _, about in VERBS))


def inputs() -> str:
    """Return the input topics."""
    rows = (
        (
            f'`{s.topic}`' + ('' if s.required else ' (optional)'),
            s.unit + _UNIT_WORDS.get(s.topic, ''),
        )
        for s in SIGNALS
    )
    return table(('topic, `std_msgs/Float64`', 'unit'), rows)


def _literal(module: str, name: str) -> ast.expr:
    """Return what a module of the node assigns to a name; nothing of ROS is imported."""
    tree = ast.parse((_NODE / module).read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign) and getattr(node.target, 'id', '') == name:
            assert node.value is not None
            return node.value
    raise LookupError(f'{module} has no {name}')


def output_topics() -> dict[str, tuple[str, bool]]:
    """Return type and whether it is latched of every output topic of the node."""
    found = _literal('node/outputs.py', 'OUTPUTS')
    assert isinstance(found, ast.Dict)
    tree = ast.parse((_NODE / 'node/outputs.py').read_text())
    package = {
        alias.name: node.module.partition('.')[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    topics = {}
    for key, call in zip(found.keys, found.values, strict=True):
        kind, latched = (call.args if isinstance(call, ast.Call) else [])[:2]
        name = ast.unparse(kind)
        topics[_text(key)] = f'{package[name]}/{name}', bool(ast.literal_eval(latched))
    return topics


def _text(node: Any) -> str:
    return str(ast.literal_eval(node))


def outputs() -> str:
    """Return the output topics."""
    rows = [
        (f'`~/{name}`', f'`{kind}`', _OUTPUTS[name] + ('; latched' if latched else ''))
        for name, (kind, latched) in output_topics().items()
    ]
    rows.append(
        ('`/diagnostics`', '`diagnostic_msgs/DiagnosticArray`',
         'health of inputs, fit, model, alarms, recorder and saved state')
    )  # fmt: skip
    return table(('output', 'type', ''), rows)


def service_names() -> list[str]:
    """Return the services the node offers, without ``~/``."""
    return list(ast.literal_eval(_literal('node/outputs.py', 'SERVICES')))


def services() -> str:
    """Return the services."""
    rows = [(f'`~/{name}`', _SERVICES[name]) for name in service_names()]
    rows.append(
        ('`~/operate_alarm`, `valveflow_msgs/OperateAlarm`',
         'acknowledge, shelve or unshelve the alarm of a name')
    )  # fmt: skip
    return table(('service, `std_srvs/Trigger`', 'does'), rows)


def _range(row: Parameter) -> str:
    if row.choices:
        return ', '.join(f'`{c}`' for c in row.choices)
    if row.low is None or row.high is None:
        return ''
    return f'{row.low:g} to {row.high:g}'


def _default(row: Parameter) -> str:
    if isinstance(row.default, bool):
        return f'`{str(row.default).lower()}`'
    return f"`'{row.default}'`" if isinstance(row.default, str) else f'`{row.default}`'


def parameters() -> str:
    """Return every parameter of the monitor."""
    rows = (
        (
            f'`{row.name}`' + (' *' if row.live else ''),
            _default(row), row.unit, _range(row), row.sentence.replace('<', '&lt;'),
        )
        for row in TABLE
    )  # fmt: skip
    return table(('parameter', 'default', 'unit', 'range', ''), rows)


def mapping() -> str:
    """Return every key of the mapping file of the OPC UA gateway."""
    places = (('', LINK), ('security: ', SECURITY), ('user: ', USER), ('a signal: ', NODE))
    rows = (
        (f'{place}`{row.name}`', _default(row), row.unit, _range(row), row.sentence)
        for place, keys in places for row in keys
    )  # fmt: skip
    return table(('key', 'default', 'unit', 'range', ''), rows)


_FIELD = re.compile(r'^([A-Za-z0-9_/\[\]]+)\s+([A-Za-z0-9_]+)\s*(=\s*(\S+))?\s*(?:#\s*(.*))?$')
_TAGGED = re.compile(r'^\[([^\]]*)\]\s*(.*)$')


def message(path: Path) -> tuple[str, list[tuple[str, str, str, str]], list[list[str]]]:
    """Read a definition: its introduction, its constants and its fields.

    Returns
    -------
    str
        The comment at its head.
    list of (name, type, unit, meaning)
        The fields.
    list of [name, value, meaning]
        The constants.
    """
    lines = path.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if not line.startswith('#'))
    about = '\n'.join(line.removeprefix('#').strip() for line in lines[:first])
    fields, constants = [], []
    for line in lines[first:]:
        found = _FIELD.match(line.strip())
        if not found or line.startswith('#'):
            continue
        kind, name, _, value, comment = found.groups()
        tagged = _TAGGED.match(comment or '')
        unit, meaning = tagged.groups() if tagged else ('', comment or '')
        if value is not None:
            constants.append([name, value, meaning])
        else:
            fields.append((name, kind, unit, meaning))
    return about, fields, constants


def _paragraphs(about: str) -> str:
    """Return a comment as Markdown: indented lines are formulas."""
    return '\n\n'.join(
        ' '.join(part.split('\n')) if '=' not in part else '```text\n' + part + '\n```'
        for part in about.strip().split('\n\n')
    )


def messages() -> str:
    """Return every message with its fields."""
    parts = []
    for path in sorted((ROOT / 'msg').glob('*.msg')):
        about, fields, constants = message(path)
        parts.append(f'### {path.stem}\n\n{_paragraphs(about)}\n')
        if constants:
            parts.append(table(('constant', 'value', 'meaning'), [
                (f'`{name}`', value, meaning) for name, value, meaning in constants
            ]))  # fmt: skip
        parts.append(table(('field', 'type', 'unit', 'meaning'), [
            (f'`{name}`', f'`{kind}`', unit, meaning) for name, kind, unit, meaning in fields
        ]))  # fmt: skip
    return '\n'.join(parts)
