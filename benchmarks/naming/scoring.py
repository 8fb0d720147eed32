# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Score answers against the truth: names, sizes, onsets."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.naming.records import NAMES
from valveflow_ros.errors import InputError, RecordingError

UNKNOWN = 'unknown'  # something is there, and it has no name
OUTCOMES = ('right', 'wrong', 'silent', 'unknown')
_Z = 1.96
_ESTIMATES = ('size', 'onset_hours')
_NUMBERS = ('value', 'low', 'high')


def read(path: Path) -> dict[str, Any]:
    """Return a JSON object in a file."""
    try:
        found = json.loads(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise RecordingError(path, f'it cannot be read ({error.strerror})') from None
    except ValueError as error:
        raise RecordingError(path, f'it is not JSON ({error})') from None
    if not isinstance(found, dict):
        raise RecordingError(path, 'it must hold one JSON object with an entry for each record')
    return found


def check(answers: dict[str, Any], truth: dict[str, Any]) -> None:
    """Check that each record has an answer, and that each can be scored."""
    for name in truth:
        if name not in answers:
            raise InputError(
                f"The answers have no entry '{name}': each record needs one, "
                'with "names": [] if it is healthy.'
            )
    for record, answer in answers.items():
        if record not in truth:
            raise InputError(f"The answers name '{record}', which is no record of this set.")
        names = answer.get('names') if isinstance(answer, dict) else None
        listed = isinstance(names, list) and all(isinstance(n, str) for n in names)
        if not (listed or names == UNKNOWN):
            raise InputError(
                f"{record}: an answer needs 'names', a list of causes (empty: healthy) or "
                f"'{UNKNOWN}'."
            )
        for key in set(answer) - {'names', *_ESTIMATES}:
            known = ', '.join(_ESTIMATES)
            raise InputError(f"{record}: '{key}' is not known; use names, {known}.")
        for name in names if listed else ():
            if name not in NAMES:
                raise InputError(f"{record}: there is no cause '{name}'; use {', '.join(NAMES)}.")
        for key in _ESTIMATES:
            given = answer.get(key)
            numbers = [given.get(k) for k in _NUMBERS] if isinstance(given, dict) else [None]
            right = all(isinstance(x, int | float) and np.isfinite(x) for x in numbers)
            if not (given is None or right):
                raise InputError(f"{record}: '{key}' needs the numbers value, low and high.")


def outcome(truth: dict[str, Any], answer: dict[str, Any]) -> str:
    """Return what an answer is: right, wrong name, silent, or unknown."""
    names = answer['names']
    if names == UNKNOWN:
        return 'right' if truth['kind'] == 'outside' else 'unknown'
    names = set(names) - set(truth['also'])
    if names == set(truth['names']) and truth['kind'] != 'outside':
        return 'right'
    return 'wrong' if names else 'silent'


def wilson(count: int, of: int) -> list[float]:
    """Return the 95 % interval of a probability after Wilson."""
    if not of:
        return [0.0, 1.0]
    share, z2 = count / of, _Z**2 / of
    middle, half = share + z2 / 2.0, _Z * math.sqrt(share * (1.0 - share) / of + z2 / of / 4.0)
    ends = (middle - half) / (1.0 + z2), (middle + half) / (1.0 + z2)
    return [round(max(ends[0], 0.0), 3), round(min(ends[1], 1.0), 3)]


def score(truth: dict[str, Any], answers: dict[str, Any]) -> dict[str, Any]:
    """Return the counts of all records and of each kind, cause and plant, sizes and onsets."""
    check(answers, truth)
    rows = [
        {**t, 'outcome': outcome(t, answers[r]), 'answer': answers[r],
         'place': f'{t["plant"]}, {t["recording"]}'}
        for r, t in truth.items()
    ]  # fmt: skip
    hidden = [r for r in rows if r['kind'] == 'hidden']
    named = [r for r in hidden if r['outcome'] == 'right']
    return {
        'all': _counts(rows), 'kinds': _by('kind', rows), 'plants': _by('place', rows),
        'causes': _by('label', hidden), 'size': _held(named, 'size'),
        'onset_hours': _held(named, 'onset_hours'),
    }  # fmt: skip


def _by(key: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {k: _counts([r for r in rows if r[key] == k]) for k in sorted({r[key] for r in rows})}


def _counts(rows: list[dict[str, Any]]) -> dict[str, Any]:
    said = [r['outcome'] for r in rows]
    counts = {o: said.count(o) for o in OUTCOMES}
    return {'records': len(rows), **counts, 'interval': wilson(counts['right'], len(rows))}


def _held(named: list[dict[str, Any]], key: str) -> dict[str, Any]:
    """Return how far an estimate is off where the name is right, and how many intervals hold."""
    given = [(r[key], r['answer'][key]) for r in named if key in r and r['answer'].get(key)]
    held = sum(e['low'] <= true <= e['high'] for true, e in given)
    errors = [abs(e['value'] - true) for true, e in given]
    off = {'median_error': round(float(np.median(errors)), 3) if errors else None,
           'largest_error': round(max(errors), 3) if errors else None}  # fmt: skip
    return {
        'asked': sum(key in r for r in named), 'given': len(given), 'held': held,
        'interval': wilson(held, len(given)), **(off if key == 'onset_hours' else {}),
    }  # fmt: skip


def words(scored: dict[str, Any]) -> str:
    """Return a score as a table of text."""
    lines = [f'{"":24}' + ''.join(f'{w:>9}' for w in ('records', *OUTCOMES)) + '  right, 95 %']
    groups = {'all': scored['all']}
    for group in ('kinds', 'plants', 'causes'):
        groups |= scored[group]
    for name, c in groups.items():
        numbers = ''.join(f'{c[w]:9}' for w in ('records', *OUTCOMES))
        low, high = c['interval']
        lines.append(f'{name:24}{numbers}  {100.0 * low:.0f} to {100.0 * high:.0f} %')
    for key in ('size', 'onset_hours'):
        s = scored[key]
        off = s.get('median_error')
        more = '' if off is None else f'; error {off:g} h in the median, {s["largest_error"]:g} h'
        lines.append(f'{key}: {s["held"]} of {s["given"]} intervals hold the truth{more}')
    return '\n'.join(lines)
