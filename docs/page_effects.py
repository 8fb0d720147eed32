# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The generated parts of the pages about effects, from the catalogue and from one trial each."""

from __future__ import annotations

import functools
import inspect
import json
import textwrap
from typing import Any

from docs.page_tables import table
from docs.picture_data import DATA, commands
from valveflow_ros.diagnosis import causes
from valveflow_ros.plant import effects

FAULTS = ('flatline', 'quantisation', 'spikes')
_STAGES = {
    'OPENING': 'between position sensor and plug',
    'INPUT': 'in u, before the curve',
    'FLOW': 'in the curve',
    'GAIN': 'between flow and power',
    'DYNAMICS': 'in the dynamics',
    'OUTPUT': 'at the power meter',
}


def names() -> list[str]:
    """Return every effect: the causes first, then the faults of a record."""
    return [*sorted(causes.catalogue()), *FAULTS]


@functools.cache
def trial(name: str) -> dict[str, Any]:
    """Return what was simulated and what the program said of it."""
    return dict(json.loads((DATA / f'{name}.json').read_text()))


def part(name: str, which: str) -> str:
    """Return a generated part of the page of an effect."""
    return {
        'physics': _physics, 'picture': _picture, 'numbers': _numbers, 'others': _others,
        'to_do': _to_do,
    }[which](name)  # fmt: skip


def _to_do(name: str) -> str:
    return textwrap.fill(causes.TO_DO[name], 116, break_on_hyphens=False) + '\n'


def _docstring(name: str) -> str:
    does = effects.catalogue()[name].install if name in FAULTS else causes.catalogue()[name].act
    return inspect.getdoc(does) or ''


def _physics(name: str) -> str:
    """Return the docstring of what it does, its formulas as blocks."""
    parts = []
    for paragraph in _docstring(name).split('\n\n'):
        if paragraph.startswith('    '):
            parts.append('```text\n' + inspect.cleandoc(paragraph) + '\n```')
        else:
            parts.append(' '.join(paragraph.replace('``', '`').split('\n')))
    where = ''
    if name not in FAULTS:
        where = f'It acts {_STAGES[causes.catalogue()[name].stage.name]}.\n'
    return '\n\n'.join(parts) + '\n\n' + where


def _estimates(cause: dict[str, Any]) -> str:
    told = []
    for key, e in cause['parameters'].items():
        unit = f' {e["unit"]}' if e['unit'] else ''
        between = ''
        if e.get('low') is not None and e.get('high') is not None:
            between = f' (95 %: {e["low"]:.4g} to {e["high"]:.4g})'
        told.append(f'`{key}` {e["value"]:.4g}{unit}{between}')
    return ', '.join(told)


def _picture(name: str) -> str:
    t = trial(name)
    d = t['diagnosis']
    lines = [
        f'![{name}](../pictures/{name}.svg)',
        '',
        '```sh long',
        *commands(name),
        '```',
        '',
        f'The answer of the program to this plant: *{t["sentence"]}*',
    ]
    for cause in d['causes']:
        lines += ['', f'Estimated: {_estimates(cause)}.']
    # The sentence has said the others.
    if near := [n for n in d['not_told_apart'] if n not in t['sentence']]:
        apart = ', '.join(f'[{n}]({n}.md)' for n in near)
        lines += ['', f'Not told apart in this record: {apart}.']
    return '\n'.join(lines)


def _numbers(name: str) -> str:
    effect = effects.catalogue()[name]
    switched = table(
        ('to switch it on', 'default', 'unit', ''),
        [(f'`{p.name}`', f'{p.default}', p.unit, p.sentence) for p in effect.parameters],
    )
    if name in FAULTS:
        return switched
    cause = causes.catalogue()[name]
    found = table(
        ('what a diagnosis estimates', 'unit', 'range'),
        [(f'`{u.name}`', u.unit, f'{u.low:g} to {u.high:g}') for u in cause.unknowns],
    )
    return f'{switched}\n{found}'


def _others(name: str) -> str:
    if name in FAULTS:
        return (
            'It is a fault of the record, not of the plant: the diagnosis leaves the values out, '
            'and no model is extended by it.'
        )
    cause = causes.catalogue()[name]
    links = ', '.join(f'[{n}]({n}.md)' for n in cause.confusers)
    return f'It can be taken for {links}.\n\nWhat tells them apart: {cause.experiment}'


def index() -> str:
    """Return the list of all effects."""
    rows = []
    for name in names():
        family = 'the record' if name in FAULTS else causes.catalogue()[name].family
        rows.append((f'[{name}]({name}.md)', effects.catalogue()[name].summary, family))
    return table(('effect', 'what is wrong', 'family'), rows)
