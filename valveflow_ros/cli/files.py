"""Outputs that are either whole or not there."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from valveflow_ros.errors import RecordingError


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a name beside ``path`` to write to; it becomes ``path`` if all went well.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    # The suffix stays last: writers choose the format by it.
    draft = path.with_name(f'.{path.stem}.{os.getpid()}.draft{path.suffix}')
    try:
        yield draft
        os.replace(draft, path)
    except OSError as error:
        raise RecordingError(path, f'cannot be written ({_reason(error)})') from None
    finally:
        draft.unlink(missing_ok=True)


def write_texts(folder: Path, texts: Mapping[str, str] | Mapping[str, bytes]) -> dict[str, Path]:
    """Write files of a folder, made if absent: all of them, or none is replaced.

    Raises
    ------
    RecordingError
        The folder or a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(folder, f'cannot be made ({_reason(error)})') from None
    drafts = {name: folder / f'.{name}.{os.getpid()}.draft' for name in texts}
    try:
        for name, text in texts.items():
            drafts[name].write_bytes(text if isinstance(text, bytes) else text.encode())
        for name, draft in drafts.items():
            os.replace(draft, folder / name)
    except OSError as error:
        raise RecordingError(folder, f'cannot be written into ({_reason(error)})') from None
    finally:
        for draft in drafts.values():
            draft.unlink(missing_ok=True)
    return {name: folder / name for name in texts}


def check_folder(folder: Path) -> None:
    """Refuse early what cannot become a folder of results, before long work begins.

    Raises
    ------
    RecordingError
        It is a file, or may not be written.
    """
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise RecordingError(place, 'is not a folder; choose another -o DIR')
    if not os.access(place, os.W_OK | os.X_OK):
        raise RecordingError(place, 'may not be written into; choose another -o DIR')
    try_folder(folder, 'choose another -o DIR')


def try_folder(folder: Path, advice: str) -> None:
    """Write a byte into a folder, made if absent, and take both away again.

    Rights alone do not tell: a disk may be full, and not every place that root may write to
    takes files.

    Raises
    ------
    RecordingError
        It cannot be made or written into; the sentence ends with the ``advice``.
    """
    import tempfile

    absent = [place for place in (folder, *folder.parents) if not place.exists()]
    what = 'made' if absent else 'written into'
    try:
        folder.mkdir(parents=True, exist_ok=True)
        what = 'written into'
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(b'x')
    except OSError as error:
        raise RecordingError(folder, f'cannot be {what} ({_reason(error)}); {advice}') from None
    finally:
        for place in absent:
            with suppress(OSError):
                place.rmdir()


def check_output(
    path: Path, suffixes: tuple[str, ...], *, source: Path | None = None, overwrite: bool = False
) -> None:
    """Refuse early an output file that cannot be written or must not be replaced.

    A file that is there and empty holds nothing that could be lost.

    Raises
    ------
    RecordingError
        It is of an unknown kind, in no folder, equal to the input, or there already.
    """
    if path.suffix.lower() not in suffixes:
        raise RecordingError(path, f'must end in {" or ".join(suffixes)}')
    if path.suffix.lower() == '.parquet':
        from valveflow_ros.logs.tables.binary import check_parquet

        check_parquet(path)
    if path.is_dir():
        raise RecordingError(path, 'is a folder; name a file')
    if not path.absolute().parent.is_dir():
        raise RecordingError(path, f"cannot be written: there is no folder '{path.parent}'")
    try_folder(path.absolute().parent, 'choose another place for the output')
    if not path.exists():
        return
    if source is not None and source.exists() and path.samefile(source):
        raise RecordingError(path, 'is the log that is read; choose another name for the output')
    if not overwrite and path.stat().st_size:
        raise RecordingError(path, 'exists already; add --overwrite to replace it')


# By what a file of results tells which verb wrote it.


# The head of our pages and files, and the columns of our tables, stand well within.
_HEAD = 4096
_PAGE = re.compile(rb'<meta name="generator" content="valveflow ([a-z]+) ')
_FORMAT = re.compile(rb'\A\{\s*"format":\s*"valveflow/([a-z_]+)"')
_WRITTEN_BY = re.compile(
    rb'\A\{\s*"format":\s*"valveflow/extended_model",\s*"written_by":\s*"([a-z]+)"'
)
_FORMATS = {
    'characteristic': 'identify',
    'shift': 'identify',
    'diagnosis': 'diagnose',
    'comparison': 'compare',
    'validation': 'validate',
}
_TABLES = {
    'compare': re.compile(
        rb'\A(segment,kind,(\S*,)?proposed\.|method,piece,slope,intercept,|u,(\w+,)*proposed\b)'
    ),
    'validate': re.compile(rb'\Asegment,kind,(\S*,)?curve\.'),
}


def signed(content: Mapping[str, Any], verb: str) -> dict[str, Any]:
    """Return the content of an extended model with the verb that writes it, near its head.

    Two verbs write one, and its format alone does not tell which.
    """
    return {'format': content['format'], 'written_by': verb, **content}


def writer(path: Path) -> str:
    """Return the verb that wrote a file, empty if that is not sure."""
    try:
        with path.open('rb') as file:
            head = file.read(_HEAD)
    except OSError:
        return ''
    if path.suffix == '.html':
        found = _PAGE.search(head)
        return found[1].decode() if found else ''
    if path.suffix == '.json':
        if found := _WRITTEN_BY.match(head):
            return found[1].decode()
        found = _FORMAT.match(head)
        return _FORMATS.get(found[1].decode(), '') if found else ''
    first = head.partition(b'\n')[0]
    return next((verb for verb, columns in _TABLES.items() if columns.match(first)), '')


# What stands in a folder of results already: kept, unless the same verb wrote it.


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
