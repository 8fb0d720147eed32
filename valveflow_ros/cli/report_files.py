"""A report and the files beside it: pictures and tables where they are asked for."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from valveflow_ros.cli.console import Outcome

if TYPE_CHECKING:
    from valveflow_ros.report.page import Page

FIGURES, TABLES = 'figures', 'tables'
_ABOUT = {FIGURES: 'pictures', TABLES: 'tables'}
# What a monitor recorded is shown by each verb that reads its log.
_OF_ANY_VERB = ('history', 'alarms')


def add_report_files(parser: ArgumentParser) -> None:
    """Add ``--figures`` and ``--table``."""
    parser.add_argument(
        '--figures', action='store_true',
        help=f'also write each picture of the report as PNG and SVG: DIR/{FIGURES}',
    )  # fmt: skip
    parser.add_argument(
        '--table', action='store_true',
        help=f'also write what each picture shows as CSV: DIR/{TABLES}',
    )  # fmt: skip


def check_report_files(options: Namespace) -> None:
    """Refuse before the long work what cannot be written after it.

    Raises
    ------
    InputError
        Pictures are wanted and matplotlib is not installed.
    RecordingError
        A folder for them may not be written into.
    """
    from valveflow_ros.cli.files import check_folder

    if options.figures:
        from valveflow_ros.report.drawing import check_drawing

        check_drawing()
        check_folder(options.output / FIGURES)
    if options.table:
        check_folder(options.output / TABLES)


def with_report(
    options: Namespace,
    texts: Mapping[str, str],
    page: Page,
    told: Callable[[Mapping[str, Path]], Outcome],
) -> Outcome:
    """Write the files of a result, its report, and pictures and tables as asked for.

    What another verb wrote under one of their names is kept under another, and said.

    Parameters
    ----------
    texts : mapping of str to str
        What the verb writes beside its report, by name.
    page : Page
    told : callable
        Makes the words of the end from where the files are.

    Raises
    ------
    RecordingError
        They cannot be written.
    """
    from valveflow_ros.cli.files import REPORT, keep_others, write_texts

    content = {**texts, REPORT: page.to_html()}
    beside = _pictures_and_tables(options, page)
    kept = keep_others(options.output, page.verb, content)
    replaced = _others_pictures(options.output, beside) if REPORT in kept.names else ''
    done = told(write_texts(options.output, content))
    files = dict(done.data['files'])
    for folder, made in beside.items():
        written = write_texts(options.output / folder, made)
        files |= {f'{folder}/{name}': str(path) for name, path in written.items()}
    data = {**done.data, 'files': files, **({'kept': dict(kept.names)} if kept.names else {})}
    asked = ' and '.join(f'{_ABOUT[f]} in {options.output / f}' for f in beside)
    lines = [done.text, f'Wrote {asked}.' if asked else '', kept.words(), replaced]
    return Outcome('\n'.join(line for line in lines if line), data)


def _others_pictures(
    folder: Path, beside: Mapping[str, Mapping[str, str] | Mapping[str, bytes]]
) -> str:
    """Return a line on what several verbs draw, if it was drawn of something else.

    Of one log all verbs draw them alike.
    """
    other = [
        f'{part}/{name}'
        for part, made in beside.items()
        for name, content in made.items()
        if Path(name).stem in _OF_ANY_VERB and _differs(folder / part / name, content)
    ]
    if not other:
        return ''
    return f'{", ".join(other)}: what was there showed something else and is replaced.'


def _differs(path: Path, content: str | bytes) -> bool:
    new = content if isinstance(content, bytes) else content.encode()
    try:
        return path.read_bytes() != new
    except OSError:
        return False


def _pictures_and_tables(
    options: Namespace, page: Page
) -> dict[str, Mapping[str, str] | Mapping[str, bytes]]:
    """Return what was asked for beside the report: by folder, then by name."""
    made: dict[str, Mapping[str, str] | Mapping[str, bytes]] = {}
    if options.table:
        from valveflow_ros.report.figure import figure_csv

        made[TABLES] = {f'{f.name}.csv': figure_csv(f) for f in page.figures}
    if options.figures:
        from valveflow_ros.report.drawing import figure_files

        made[FIGURES] = {k: v for f in page.figures for k, v in figure_files(f).items()}
    return made
