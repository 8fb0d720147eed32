"""Outputs that are either whole or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

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
