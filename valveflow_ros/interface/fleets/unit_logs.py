# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The logs of a fleet: read folders, globs and manifests into units with sorted logs."""

from __future__ import annotations

import csv
import glob
import json
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from valveflow_ros.errors import InputError, RecordingError, UsageError, ValveflowError, listed
from valveflow_ros.interface.files import reason
from valveflow_ros.interface.mapping import LogMapping, read_mapping
from valveflow_ros.interface.settings import read_parameters

SUFFIXES = ('.csv', '.db3', '.mcap', '.parquet', '.xlsx')
_MANIFEST = {'unit', 'log', 'options'}
_PAIRED = ('--column', '--constant', '--set')
_TABLE = ('--time-zone', '--date-order', '--decimal', '--sheet', '--max-unpacked', '--period')
_NO_DIAGNOSIS = '--no-diagnosis'
# Not allowed: the reference is the previous log's curve, and `key_of` does not hash a model.
_FILES = ('model_file', 'reference_file')
_LONGEST_HEAD = 1 << 16
_SPLIT = re.compile(r'_\d+\.(mcap|db3)(\.zstd)?$')


@dataclass(frozen=True, slots=True)
class Options:
    """How a log is read and evaluated, also as ``text`` for the hash.

    ``diagnosis``: the monitor's own diagnoses are computed.
    """

    mapping: LogMapping
    parameters: dict[str, Any]
    diagnosis: bool
    text: str


@dataclass(frozen=True, slots=True)
class UnitLog:
    """One log of a unit, usually a month; its name has no suffix, its path is absolute."""

    unit: str
    name: str
    log: Path
    options: Options


def read_options(words: Sequence[str]) -> Options:
    """Read options in the form of the verbs; a later option overrides an earlier equal one.

    They are ``--column``, ``--constant``, ``--set``, ``--params`` and the options of a table, each
    followed by its value, and ``--no-diagnosis``.
    """
    said: dict[tuple[str, str], str] = {}
    rest = list(words)
    while rest:
        option, equals, value = rest.pop(0).partition('=')
        if option == _NO_DIAGNOSIS:
            said[option, ''] = ''
            continue
        if option not in (*_PAIRED, *_TABLE, '--params'):
            known = listed([*_PAIRED, '--params', *_TABLE, _NO_DIAGNOSIS])
            raise UsageError(f"A fleet has no option '{option}' for a log; it has {known}.")
        if not equals and not rest:
            raise UsageError(f'{option} wants a value after it.')
        value = value if equals else rest.pop(0)
        name = value.partition('=')[0].strip() if option in _PAIRED else ''
        said[option, name] = value
    columns, constants, pairs = ([v for (o, _), v in said.items() if o == p] for p in _PAIRED)
    table = {o[2:].replace('-', '_'): v for (o, _), v in said.items() if o in _TABLE}
    file, no_diagnosis = said.get(('--params', '')), (_NO_DIAGNOSIS, '') in said
    parameters = read_parameters(None if file is None else Path(file).expanduser(), pairs)
    for name in _FILES:
        if parameters.get(name):
            raise UsageError(
                f'{name} has no place in a fleet: the reference of a log is the curve of the one '
                'before it.'
            )
    given = [sorted(columns), sorted(constants), sorted(table.items()), parameters, no_diagnosis]
    mapping = read_mapping(columns, constants, **table)
    return Options(mapping, parameters, not no_diagnosis, json.dumps(given, sort_keys=True))


def read_fleet(
    sources: Sequence[str | Path], options: Sequence[str] = (), output: Path | None = None
) -> dict[str, list[UnitLog]]:
    """Return the logs of each unit in chronological order.

    Parameters
    ----------
    sources : sequence of str or Path
        Logs, folders and globs; the folder of a log is the name of its unit, and logs are sorted
        by name. Or manifests, CSV files with the columns ``unit``, ``log`` and optionally
        ``options``; ``log`` is a log, folder or glob relative to the manifest.
    options : sequence of str
        Options of all logs; see `read_options`. Options in a manifest override them.
    output : Path, optional
        The folder of results; logs in it are ignored.
    """
    found: dict[str, list[UnitLog]] = {}
    origin: dict[str, tuple[str, object]] = {}
    common = read_options(options)
    skipped = None if output is None else output.resolve()

    def add(unit: str, log: Path, how: Options, where: object) -> None:
        log = log.resolve()
        known, place = origin.setdefault(unit.casefold(), (unit, where))
        if (known, place) != (unit, where):
            both = f"'{unit}'" if known == unit else f"'{known}' and '{unit}'"
            raise InputError(
                f'{place} and {where} hold two units of one name, {both}: give each unit a name '
                'of its own in a manifest.'
            )
        logs = found.setdefault(unit, [])
        name = log.name if log.is_dir() else log.stem
        for other in logs:
            if other.name == name:
                raise InputError(
                    f'{log} was given twice.'
                    if other.log == log
                    else f"Unit '{unit}' has two logs of one name, {other.log} and {log}: give "
                    'two units two names, or rename one of the logs.'
                )
        logs.append(UnitLog(unit, name, log, how))

    for source in map(Path, sources):
        rows = _manifest(source)
        if rows is None:
            for log in _logs_at(source, skipped):
                home = log.resolve().parent
                add(_unit_name(home.name), log, common, home)
        for line, row in rows or ():
            try:
                own = shlex.split(row.get('options', ''))
                how = read_options([*options, *own]) if own else common
                for log in _logs_at(source.parent / Path(row['log']).expanduser(), skipped):
                    add(_unit_name(row['unit']), log, how, source)
            except (ValueError, ValveflowError) as error:  # the former of shlex
                raise InputError(f'{source}, line {line}: {str(error).rstrip(".")}.') from None
    if not found:
        raise InputError(
            f'There is no log in {listed([str(s) for s in sources])}: a log ends in '
            f'{listed(SUFFIXES, "or")}, or is a rosbag2 folder.'
        )
    return found


def _unit_name(name: str) -> str:
    """Return a unit's name; raise `InputError` if it cannot be the name of a folder."""
    if not name or name != name.strip(' .') or '/' in name or not name.isprintable():
        raise InputError(f"'{name}' cannot be the name of a unit: its folder is called so.")
    return name


def _manifest(path: Path) -> list[tuple[int, dict[str, str]]] | None:
    """Return the rows of a manifest with their line numbers; None if it is no manifest."""
    if path.suffix.lower() != '.csv' or not path.is_file():
        return None
    try:
        with path.open(encoding='utf-8-sig', newline='') as file:
            first = file.readline(_LONGEST_HEAD)
            mark = max(',;\t', key=first.count)
            head = [cell.strip().strip('"').lower() for cell in first.split(mark)]
            if not {'unit', 'log'} <= set(head) <= _MANIFEST:
                return None
            rows = list(csv.reader(file, delimiter=mark))
    except OSError as error:
        raise RecordingError(path, f'cannot be read ({reason(error)})') from None
    except (ValueError, csv.Error):
        return None
    told = [
        (k, dict(zip(head, (c.strip() for c in row), strict=False)))
        for k, row in enumerate(rows, 2)
        if any(c.strip() for c in row)
    ]
    for line, row in told:
        if len(row) < len(head) and 'log' not in row:
            raise InputError(f'{path}, line {line}: a unit and its log are wanted.')
    if not told:
        raise RecordingError(path, 'is a manifest without a row')
    return told


def _logs_at(place: Path, skipped: Path | None) -> list[Path]:
    """Return the logs for a name: the log itself, those in a folder, or those of a glob."""
    if place.is_dir() and not _is_bag(place):
        found = []
        for entry in sorted(place.iterdir(), key=_in_order):
            if entry.name.startswith('.') or entry.resolve() == skipped:
                continue
            if entry.is_dir():
                found += _logs_at(entry, skipped)
            elif entry.suffix.lower() in SUFFIXES:
                if _manifest(entry) is not None:
                    raise InputError(f'{entry} is a manifest: name it instead of {place}.')
                found.append(entry)
        return found
    if place.exists():
        return [place]
    matched = [Path(p) for p in glob.glob(str(place), recursive=True)]
    if not matched:
        raise RecordingError(place, 'cannot be opened (no such file or directory)')
    return [log for p in sorted(matched, key=_in_order) for log in _logs_at(p, skipped)]


def _is_bag(folder: Path) -> bool:
    """Return True if a folder is one split recording, and not a folder of recordings.

    A `metadata.yaml` is not enough: `simulate` and `import` write one for single files too.
    """
    path = folder / 'metadata.yaml'
    if not path.is_file():
        return False
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
        named = {str(n) for n in content['rosbag2_bagfile_information']['relative_file_paths']}
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError):
        return True  # the reader reports the error later
    logs = {p.name for p in folder.iterdir() if p.suffix.lower() in SUFFIXES}
    return not (logs - named) and all(_SPLIT.search(name) for name in named)


def _in_order(path: Path) -> list[list[Any]]:
    """Return a sort key that compares numbers by value: 2026-2 comes before 2026-10."""
    return [
        [int(part) if part.isdecimal() else part for part in re.split(r'(\d+)', name)]
        for name in path.parts
    ]
