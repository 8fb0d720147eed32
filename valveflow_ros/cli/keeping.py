"""Results of another verb in the same folder: kept under names that say whose they are."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from valveflow_ros.cli.files import write_texts

REPORT = 'report.html'
# Several verbs write a file of that name; every other name belongs to one of them.
_SEGMENTS, _EXTENDED = 'segments.csv', 'extended_model.json'
_SHARED = REPORT, _SEGMENTS, _EXTENDED
_MADE_BY = re.compile(rb'<meta name="generator" content="valveflow ([a-z]+) ')
_COLUMNS = {'compare': b',proposed.', 'validate': b',curve.'}
# The head of our pages and the columns of our tables stand well within.
_HEAD = 4096
# A page that is not ours, or of a version that did not say.
_UNKNOWN = 'before'


@dataclass(frozen=True, slots=True)
class Kept:
    """What another verb had written, and where it stands now.

    Attributes
    ----------
    names : mapping of str to str
        Old names to new ones.
    verb : str
        Whose report was kept, empty if none was or that cannot be told.
    old : str
        An earlier report of the verb at work that stands beside the new one, or empty.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    verb: str = ''
    old: str = ''

    def words(self) -> str:
        """Return one line for a person; empty if there is nothing to say."""
        told = []
        for name, new in self.names.items():
            report = f'report of valveflow {self.verb}' if self.verb else 'report'
            what = f'The {report}' if name == REPORT else f'The {name}'
            told.append(f'{what} that was there is now {new}.')
        if self.old:
            told.append(f'{self.old} is of an earlier run; the new one is {REPORT}.')
        return ' '.join(told)


def keep_others(folder: Path, verb: str, names: Collection[str]) -> Kept:
    """Copy what another verb wrote under names that ``verb`` is about to take.

    Parameters
    ----------
    folder : Path
        The folder of results; it need not exist.
    verb : str
        Whose results are to be written.
    names : collection of str
        Of the files to be written.

    Raises
    ------
    RecordingError
        A copy cannot be written; nothing has been replaced then.
    """
    kept: dict[str, str] = {}
    for name in (n for n in _SHARED if n in names and (folder / n).is_file()):
        writer = _writer(folder, name)
        if writer == verb or (not writer and name != REPORT):
            continue
        kept[name] = renamed(name, writer) if writer else _free(folder)
        write_texts(folder, {kept[name]: (folder / name).read_bytes()})
    own = renamed(REPORT, verb)
    old = own if (folder / own).is_file() else ''
    return Kept(kept, _writer(folder, REPORT) if REPORT in kept else '', old)


def renamed(name: str, mark: str) -> str:
    """Return ``report_identify.html`` for ``report.html``."""
    path = Path(name)
    return f'{path.stem}_{mark}{path.suffix}'


def _writer(folder: Path, name: str) -> str:
    """Return the verb that wrote a file of ours, empty if that cannot be told."""
    if name == _EXTENDED:
        return 'diagnose' if _writer(folder, REPORT) == 'diagnose' else ''
    try:
        with (folder / name).open('rb') as file:
            head = file.read(_HEAD)
    except OSError:
        return ''
    if name == REPORT:
        found = _MADE_BY.search(head)
        return found[1].decode() if found else ''
    first = head.partition(b'\n')[0]
    return next((verb for verb, mark in _COLUMNS.items() if mark in first), '')


def _free(folder: Path) -> str:
    """Return a name under which no report stands yet."""
    name, number = renamed(REPORT, _UNKNOWN), 1
    while (folder / name).exists():
        number += 1
        name = renamed(REPORT, f'{_UNKNOWN}_{number}')
    return name
