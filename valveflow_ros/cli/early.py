"""What can be told before anything is loaded: files that are not there, places not to write to."""

from __future__ import annotations

import errno
import os
from argparse import Action, ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.files import check_folder, try_folder
from valveflow_ros.errors import RecordingError

# Files that a verb writes; every other FILE is read.
_WRITTEN = {('simulate', 'truth')}
_READ = ('LOG', 'LOG2', 'TABLE', 'BROKEN')
# It waits for what is not there yet, and says so itself.
_NOT_JUDGED = ('watch',)


def check_paths(verb: str, parser: ArgumentParser, options: Namespace) -> None:
    """Refuse options that name what cannot be read or written.

    What is wrong within a file is for the verb to say.

    Raises
    ------
    RecordingError
        The first of them, with the reason.
    """
    if verb in _NOT_JUDGED:
        return
    for action in parser._actions:
        path = getattr(options, action.dest, None)
        if isinstance(path, Path):
            _check(verb, action, path)


def _check(verb: str, action: Action, path: Path) -> None:
    if action.metavar == 'DIR':
        check_folder(path)
    elif (verb, action.dest) in _WRITTEN:
        _writable(path)
    elif action.metavar == 'FILE' and action.dest != 'output':
        _there(path.expanduser(), 'cannot be read')
    elif action.metavar in _READ and action.dest != 'output':
        _there(path, 'cannot be opened')


def _there(path: Path, what: str) -> None:
    try:
        path.stat()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(path, f'{what} ({reason})') from None
    except ValueError:  # a zero byte in the name
        raise RecordingError(path, 'is not a name of a file') from None


def _writable(path: Path) -> None:
    folder = path.absolute().parent
    if path.is_dir():
        raise RecordingError(path, 'is a folder; name a file')
    if not folder.is_dir():
        raise RecordingError(path, f"cannot be written: there is no folder '{path.parent}'")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise RecordingError(path, f'cannot be written ({os.strerror(errno.EACCES).lower()})')
    try_folder(folder, 'choose another place for it')
