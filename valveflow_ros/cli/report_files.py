"""The files beside a report that are written when asked for: pictures and tables."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from valveflow_ros.cli.console import Outcome

if TYPE_CHECKING:
    from valveflow_ros.report.page import Page

FIGURES, TABLES = 'figures', 'tables'


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


def write_report_files(options: Namespace, page: Page) -> dict[str, Path]:
    """Write pictures and tables as asked for; return where by their names."""
    from valveflow_ros.cli.files import write_texts
    from valveflow_ros.report.picture_data import figure_csv

    written: dict[str, Path] = {}
    if options.table:
        tables = {f'{f.name}.csv': figure_csv(f) for f in page.figures}
        written |= write_texts(options.output / TABLES, tables)
    if options.figures:
        from valveflow_ros.report.drawing import figure_files

        drawn = {k: v for f in page.figures for k, v in figure_files(f).items()}
        written |= write_texts(options.output / FIGURES, drawn)
    return written


def with_report_files(done: Outcome, options: Namespace, page: Page) -> Outcome:
    """Write pictures and tables as asked for, and say so at the end."""
    written = write_report_files(options, page)
    if not written:
        return done
    asked = ' and '.join(
        f'{what} in {options.output / folder}'
        for what, folder, wanted in (
            ('tables', TABLES, options.table), ('pictures', FIGURES, options.figures),
        )
        if wanted
    )  # fmt: skip
    files = {**done.data['files'], **{name: str(path) for name, path in written.items()}}
    return Outcome(f'{done.text}\nWrote {asked}.', {**done.data, 'files': files})
