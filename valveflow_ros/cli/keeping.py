"""What stands in a folder of results already: kept, unless the same verb wrote it."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from valveflow_ros.cli.file_marks import writer
from valveflow_ros.cli.files import write_texts
from valveflow_ros.errors import RecordingError

REPORT = 'report.html'
# A file that is not ours, or of a version that did not say.
_UNKNOWN = 'before'


@dataclass(frozen=True, slots=True)
class Kept:
    """What another verb or somebody else had written, and where it stands now.

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
    """Copy what ``verb`` is about to replace and has not surely written itself.

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
        A copy cannot be made; nothing has been replaced then.
    """
    kept: dict[str, str] = {}
    # The report is named first.
    for name in sorted(names, key=lambda n: n != REPORT):
        if not (folder / name).is_file():
            continue
        theirs = writer(folder / name)
        if theirs == verb:
            continue
        kept[name] = _free(folder, name, theirs, names)
        write_texts(folder, {kept[name]: _content(folder / name)})
    own = renamed(REPORT, verb)
    old = own if writer(folder / own) == verb else ''
    return Kept(kept, writer(folder / REPORT) if REPORT in kept else '', old)


def renamed(name: str, mark: str) -> str:
    """Return ``report_identify.html`` for ``report.html``."""
    path = Path(name)
    return f'{path.stem}_{mark}{path.suffix}'


def _free(folder: Path, name: str, verb: str, taken: Collection[str]) -> str:
    """Return a name for a copy: one that is free, or holds an older copy of the same verb."""
    mark = verb or _UNKNOWN
    new, number = renamed(name, mark), 1
    while new in taken or (os.path.lexists(folder / new) and not _same(folder / new, verb)):
        number += 1
        new = renamed(name, f'{mark}_{number}')
    return new


def _same(path: Path, verb: str) -> bool:
    return bool(verb) and path.is_file() and writer(path) == verb


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(
            path, f'cannot be read to keep it ({reason}); choose another -o DIR'
        ) from None
