"""Write a table as whatever kind of log a person named."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from valveflow_ros.cli.files import check_output, try_folder, whole_file
from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import write_samples, write_table
from valveflow_ros.records import SampleTable

TABLES = ('.csv', '.parquet')


def check_log(path: Path, *, source: Path | None = None, overwrite: bool = False) -> None:
    """Refuse early a log that cannot be written; without a suffix it is a folder.

    Raises
    ------
    RecordingError
    """
    if path.suffix:
        check_output(path, ('.mcap', *TABLES), source=source, overwrite=overwrite)
    elif path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise RecordingError(path, 'exists already and is not empty; choose another folder')
    else:
        try_folder(path, 'choose another place for the output')


def write_log(
    table: SampleTable,
    path: Path,
    *,
    overwrite: bool = False,
    attachments: Mapping[str, bytes] | None = None,
) -> Path:
    """Write a table as MCAP, folder, CSV or Parquet; return where."""
    if path.suffix.lower() in TABLES:
        with whole_file(path) as draft:
            write_table(table, draft)
        return path
    # An empty file is no obstacle, and the writer knows no third way.
    replace = overwrite or (path.is_file() and path.stat().st_size == 0)
    kept = dict(attachments or {})
    return write_samples(table, path, attachments=kept, overwrite=replace).path
