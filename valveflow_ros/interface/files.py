# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Output files, written completely or not at all, and results: files, report, main picture."""

from __future__ import annotations

import errno
import json
import os
import re
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from valveflow_ros.errors import InputError, RecordingError

if TYPE_CHECKING:
    from valveflow_ros.logs import LogContents
    from valveflow_ros.records import SampleTable
    from valveflow_ros.report.page import Page

TABLES = ('.csv', '.parquet')
REPORT = 'report.html'
FIGURES_FOLDER, TABLES_FOLDER = 'figures', 'tables'
# Every verb that reads a monitor's recording draws these pictures; they are equal for one log.
_DRAWN_BY_SEVERAL = ('history', 'alarms')

# These patterns tell which verb wrote a result file. The first _HEAD bytes of our files contain
# all that the patterns need.
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
    'monitor': 'monitor',
    'loop': 'loop',
}
_TABLES = {
    'compare': re.compile(
        rb'\A(segment,kind,(\S*,)?proposed\.|method,piece,slope,intercept,|u,(\w+,)*proposed\b)'
    ),
    'validate': re.compile(rb'\Asegment,kind,(\S*,)?curve\.'),
}
# Marks the backup of a file of another program or of a version that did not name its verb.
_UNKNOWN = 'before'


def reason(error: OSError) -> str:
    """Return the message of the operating system, to be used within a sentence."""
    return (error.strerror or str(error)).lower()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path``, which is renamed to it on success."""
    # The suffix must stay last because writers choose the format by it.
    draft = path.with_name(f'.{path.stem}.{os.getpid()}.draft{path.suffix}')
    try:
        yield draft
        os.replace(draft, path)
    except OSError as error:
        raise RecordingError(path, f'cannot be written ({reason(error)})') from None
    finally:
        draft.unlink(missing_ok=True)


def write_texts(folder: Path, texts: Mapping[str, str] | Mapping[str, bytes]) -> dict[str, Path]:
    """Write files into a folder, created if absent; if one fails, no file is replaced."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(folder, f'cannot be made ({reason(error)})') from None
    drafts = {name: folder / f'.{name}.{os.getpid()}.draft' for name in texts}
    try:
        for name, text in texts.items():
            drafts[name].write_bytes(text if isinstance(text, bytes) else text.encode())
            if (folder / name).is_dir():
                raise IsADirectoryError(errno.EISDIR, f'{name} is a folder')
        for name, draft in drafts.items():
            os.replace(draft, folder / name)
    except OSError as error:
        raise RecordingError(folder, f'cannot be written into ({reason(error)})') from None
    finally:
        for draft in drafts.values():
            draft.unlink(missing_ok=True)
    return {name: folder / name for name in texts}


def write_log(table: SampleTable, path: Path, overwrite: bool = False) -> Path:
    """Write rows as CSV, Parquet, MCAP or a recording's folder, by the suffix; return the path."""
    from valveflow_ros.logs import write_samples, write_table

    if path.suffix.lower() in TABLES:
        with whole_file(path) as draft:
            write_table(table, draft)
        return path
    return write_samples(table, path, overwrite=overwrite or is_empty(path)).path


def write_outputs(log: LogContents, path: Path, overwrite: bool = False) -> dict[Path, int]:
    """Write the outputs of a recorded monitor, one table per kind; return the row count by file.

    ``out.csv`` gives ``out_curves.csv``, ``out_alarms.csv``, ... Raises `DataError` if there is no
    output of a monitor, `RecordingError` if a table cannot be written, or exists already.
    """
    from valveflow_ros.logs import outputs_in
    from valveflow_ros.logs import write_outputs as write_kind

    places = {kind: path.with_stem(f'{path.stem}_{kind}') for kind in outputs_in(log)}
    for place in places.values():
        check_output(place, TABLES, overwrite=overwrite)
    found = {}
    for kind, place in places.items():
        with whole_file(place) as draft:
            found[place] = write_kind(log, kind, draft)
    return found


def as_text(content: Mapping[str, Any], indent: int = 2) -> str:
    """Return the text of a JSON file."""
    return json.dumps(content, indent=indent, allow_nan=False) + '\n'


def is_empty(path: Path) -> bool:
    """Return True if the file exists and contains nothing that could be lost."""
    return path.is_file() and path.stat().st_size == 0


def check_readable(path: Path, what: str) -> None:
    """Raise `RecordingError` if a file does not exist; ``what`` names the impossible action."""
    try:
        path.stat()
    except OSError as error:
        raise RecordingError(path, f'{what} ({reason(error)})') from None
    except ValueError:  # a zero byte in the name
        raise RecordingError(path, 'is not a name of a file') from None


def check_writable(path: Path) -> None:
    """Raise `RecordingError` if a file could not be written."""
    folder = path.absolute().parent
    _check_place(path)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise RecordingError(path, f'cannot be written ({os.strerror(errno.EACCES).lower()})')
    _try_folder(folder, 'choose another place for it')


def _check_place(path: Path) -> None:
    if path.is_dir():
        raise RecordingError(path, 'is a folder; name a file')
    if not path.absolute().parent.is_dir():
        raise RecordingError(path, f"cannot be written: there is no folder '{path.parent}'")


def check_folder(folder: Path) -> None:
    """Raise `RecordingError` if a path cannot be used as a folder of results."""
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise RecordingError(place, 'is not a folder; choose another -o DIR')
    if not os.access(place, os.W_OK | os.X_OK):
        raise RecordingError(place, 'may not be written into; choose another -o DIR')
    _try_folder(folder, 'choose another -o DIR')


def check_output(
    path: Path, suffixes: tuple[str, ...], *, source: Path | None = None, overwrite: bool = False
) -> None:
    """Raise `RecordingError` if an output file cannot be written or must not be replaced."""
    if path.suffix.lower() not in suffixes:
        raise RecordingError(path, f'must end in {" or ".join(suffixes)}')
    if path.suffix.lower() == '.parquet':
        from valveflow_ros.logs.tables.binary import check_parquet

        check_parquet(path)
    _check_place(path)
    _try_folder(path.absolute().parent, 'choose another place for the output')
    if not path.exists():
        return
    if source is not None and source.exists() and path.samefile(source):
        raise RecordingError(path, 'is the log that is read; choose another name for the output')
    if not overwrite and not is_empty(path):
        raise RecordingError(path, 'exists already; add --overwrite to replace it')


def check_log(path: Path, *, source: Path | None = None, overwrite: bool = False) -> None:
    """Check the path of a log with `check_output`; a name without a suffix is a folder."""
    if path.suffix:
        check_output(path, ('.mcap', *TABLES), source=source, overwrite=overwrite)
    elif path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise RecordingError(path, 'exists already and is not empty; choose another folder')
    else:
        _try_folder(path, 'choose another place for the output')


def _try_folder(folder: Path, advice: str) -> None:
    """Write a byte into a folder, created if absent, and remove both again.

    To check the permissions is not enough: the disk may be full, and some places do not
    accept files even from root.
    """
    absent = [place for place in (folder, *folder.parents) if not place.exists()]
    what = 'made' if absent else 'written into'
    try:
        folder.mkdir(parents=True, exist_ok=True)
        what = 'written into'
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(b'x')
    except OSError as error:
        raise RecordingError(folder, f'cannot be {what} ({reason(error)}); {advice}') from None
    finally:
        for place in absent:
            with suppress(OSError):
                place.rmdir()


class Result:
    """The result of a verb: all verbs show, draw and write their results in the same way."""

    verb: ClassVar[str]

    def __repr__(self) -> str:
        """Return what was found; all the data would fill pages of a notebook."""
        from valveflow_ros.signals.units import in_unit

        return f'<{type(self).__name__}: {in_unit(self._sentence(), self.output_unit)}>'

    def _sentence(self) -> str:
        """Return the main result in words."""
        raise NotImplementedError

    @property
    def output_unit(self) -> str:
        """Return the unit of the output: MW, or that of a flow."""
        return 'MW'

    def page(self) -> Page:
        """Return the report."""
        raise NotImplementedError

    def texts(self) -> dict[str, str]:
        """Return the files for programs as texts by name; the first is the result's JSON."""
        raise NotImplementedError

    def to_json(self) -> dict[str, Any]:
        """Return the result as a dict, equal to the content of its JSON file."""
        content: dict[str, Any] = json.loads(next(iter(self._told().values())))
        return content

    def _replaced(self, folder: Path) -> str:
        """Return a sentence about an earlier result that is lost by writing; empty if none."""
        del folder
        return ''

    def _told(self) -> dict[str, str]:
        """Return the files with their sentences in the unit of the output; models have none."""
        from valveflow_ros.signals.units import in_unit

        return {
            name: content if name.endswith('_model.json') else in_unit(content, self.output_unit)
            for name, content in self.texts().items()
        }

    def plot(self, name: str = '') -> Any:
        """Return a picture of the report as a plotly figure.

        Parameters
        ----------
        name : str
            Name of a picture of the report; the main one by default.

        Returns
        -------
        plotly.graph_objects.Figure

        Raises
        ------
        InputError
            The report has no picture of that name.
        """
        from valveflow_ros.report.page import plotly_script

        plotly_script()  # raises a clear message if plotly is missing
        import plotly.graph_objects as go

        from valveflow_ros.report.drawing import palette

        drawn = {f.name: f for f in self.page().in_unit(self.output_unit).figures}
        if (name and name not in drawn) or not drawn:
            there = ', '.join(drawn) or 'none'
            raise InputError(f"The report has no picture '{name}'; it has: {there}.")
        figure = drawn[name] if name else next(iter(drawn.values()))
        colours = palette()
        content = _painted(json.loads(figure.to_json()), colours)
        base = {
            'template': 'plotly_white',
            'paper_bgcolor': colours['paper'],
            'plot_bgcolor': colours['paper'],
            'legend': {'orientation': 'h', 'x': 0, 'y': 1.02, 'yanchor': 'bottom'},
        }
        return go.Figure(content['data'], {**base, **content['layout']})

    def write(
        self, folder: str | Path, *, figures: bool = False, tables: bool = False,
        time_zone: str = '',
    ) -> WrittenFiles:  # fmt: skip
        """Write the files of the result, and pictures and tables on request.

        Parameters
        ----------
        folder : str or Path
            Created if absent. Files of the same names that another verb wrote are kept under
            new names.
        figures : bool
            Also write each picture of the report as PNG and SVG, into ``figures``.
        tables : bool
            Also write the data of each picture as CSV, into ``tables``.
        time_zone : str
            Time zone of the report: ``Europe/Berlin``, ``+01:00``; UTC by default. Files
            for programs always use UTC.

        Raises
        ------
        RecordingError
            The folder or a file cannot be written; then no file of the result is replaced.
        InputError
            plotly is not installed; or pictures are requested without matplotlib; or unknown zone.
        """
        from valveflow_ros.records import zone_of
        from valveflow_ros.report.words import in_zone

        folder, zone = Path(folder), zone_of(time_zone)
        check_results(folder, figures, tables)
        page = self.page().in_unit(self.output_unit)
        local = page.in_zone(zone)
        content = {**self._told(), REPORT: local.to_html()}
        backup, lost = back_up(folder, self.verb, content), in_zone(self._replaced(folder), zone)
        files = write_texts(folder, content)
        *most, last = [str(files[REPORT]), *(name for name in content if name != REPORT)]
        lines = [f'Wrote {", ".join(most)} and {last}.']
        beside, replaced = {}, []
        if tables:
            from valveflow_ros.report.figure import figure_csv

            made = {f'{f.name}.csv': figure_csv(f).encode() for f in page.figures}
            beside['tables'] = folder / TABLES_FOLDER, made
        if figures:
            from valveflow_ros.report.drawing import figure_files

            made = {k: v for f in local.figures for k, v in figure_files(f).items()}
            beside['pictures'] = folder / FIGURES_FOLDER, made
        for place, made in beside.values():
            replaced += [
                f'{place.name}/{name}'
                for name, new in made.items()
                if Path(name).stem in _DRAWN_BY_SEVERAL and _differs(place / name, new)
            ]
            written = write_texts(place, made)
            files |= {f'{place.name}/{name}': path for name, path in written.items()}
        if beside:
            told = ' and '.join(f'{what} in {place}' for what, (place, _) in beside.items())
            lines.append(f'Wrote {told}.')
        lines += [backup.words(), lost]
        if replaced and REPORT in backup.names:
            lines.append(
                f'{", ".join(replaced)}: what was there showed something else and is replaced.'
            )
        return WrittenFiles(files, backup.names, tuple(line for line in lines if line))


@dataclass(frozen=True, slots=True)
class WrittenFiles:
    """The paths of the files of a result by name, and the same as sentences.

    ``kept`` has the new names of the files that existed before, by old name.
    """

    files: dict[str, Path]
    kept: Mapping[str, str]
    words: tuple[str, ...]


def check_results(folder: Path, figures: bool, tables: bool) -> None:
    """Check before a long calculation that its results can be written.

    Raises `RecordingError` if not, and `InputError` if plotly, or for pictures matplotlib, is not
    installed.
    """
    from valveflow_ros.report.page import plotly_script

    check_folder(folder)
    plotly_script()
    if figures:
        from valveflow_ros.report.drawing import check_drawing

        check_drawing()
        check_folder(folder / FIGURES_FOLDER)
    if tables:
        check_folder(folder / TABLES_FOLDER)


def signed(content: Mapping[str, Any], verb: str) -> dict[str, Any]:
    """Return the content of an extended model with the name of its verb near the beginning.

    Two verbs write extended models, and the format does not say which of them did.
    """
    return {'format': content['format'], 'written_by': verb, **content}


def writer(path: Path) -> str:
    """Return the verb that wrote a file, empty if unknown."""
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


@dataclass(frozen=True, slots=True)
class Backup:
    """Files that another verb or another program had written: their new names by old name.

    ``verb`` is the verb whose report was kept, empty if none was kept or the verb is unknown;
    ``old`` the name of an earlier report of the current verb beside the new one, or empty.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    verb: str = ''
    old: str = ''

    def words(self) -> str:
        """Return one line for the user; empty if no file was renamed."""
        told = []
        for name, new in self.names.items():
            report = f'report of valveflow {self.verb}' if self.verb else 'report'
            what = f'The {report}' if name == REPORT else f'The {name}'
            told.append(f'{what} that was there is now {new}.')
        if self.old:
            told.append(f'{self.old} is of an earlier run; the new one is {REPORT}.')
        return ' '.join(told)


def back_up(folder: Path, verb: str, names: Collection[str]) -> Backup:
    """Copy the files that ``verb`` will replace, unless ``verb`` certainly wrote them itself."""
    kept: dict[str, str] = {}
    # The message names the report first.
    for name in sorted(names, key=lambda n: n != REPORT):
        path = folder / name
        if not path.is_file() or (theirs := writer(path)) == verb:
            continue
        kept[name] = _free_name(folder, name, theirs, names)
        try:
            content = path.read_bytes()
        except OSError as error:
            raise RecordingError(
                path, f'cannot be read to keep it ({reason(error)}); choose another -o DIR'
            ) from None
        write_texts(folder, {kept[name]: content})
    own = _renamed(REPORT, verb)
    old = own if writer(folder / own) == verb else ''
    return Backup(kept, writer(folder / REPORT) if REPORT in kept else '', old)


def _free_name(folder: Path, name: str, verb: str, taken: Collection[str]) -> str:
    """Return a name for a copy: an unused one, or that of an older copy of the same verb."""
    mark = verb or _UNKNOWN
    new, number = _renamed(name, mark), 1

    def same(path: Path) -> bool:
        return bool(verb) and path.is_file() and writer(path) == verb

    while new in taken or (os.path.lexists(folder / new) and not same(folder / new)):
        number += 1
        new = _renamed(name, f'{mark}_{number}')
    return new


def _renamed(name: str, mark: str) -> str:
    """Return ``report_identify.html`` for ``report.html``."""
    path = Path(name)
    return f'{path.stem}_{mark}{path.suffix}'


def _painted(value: Any, colours: Mapping[str, str]) -> Any:
    """Return a part of a picture with each ``token:name`` replaced by its colour value."""
    if isinstance(value, str):
        return colours[value[6:]] if value.startswith('token:') else value
    if isinstance(value, list):
        return [_painted(v, colours) for v in value]
    if isinstance(value, dict):
        # The second, shorter title is used on narrow pages only.
        return {k: _painted(v, colours) for k, v in value.items() if k != 'short'}
    return value


def _differs(path: Path, content: bytes) -> bool:
    try:
        return path.read_bytes() != content
    except OSError:
        return False
