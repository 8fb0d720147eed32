"""Read a ``characteristic.json``."""

from __future__ import annotations

import json
from pathlib import Path

from valveflow_ros.core.characteristic import Characteristic
from valveflow_ros.core.characteristic_json import from_json
from valveflow_ros.errors import DataError, RecordingError

_MOST_BYTES = 50_000_000


def read_model(path: Path) -> Characteristic:
    """Return the characteristic in a file.

    Raises
    ------
    RecordingError
        It cannot be read, or is no characteristic this version can read.
    """
    if path.is_dir() and (path / 'characteristic.json').is_file():
        path = path / 'characteristic.json'
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise RecordingError(path, 'is too large to be a flow characteristic')
        return from_json(json.loads(path.read_text(encoding='utf-8')))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(path, f'cannot be read ({reason})') from None
    except (ValueError, RecursionError):
        raise RecordingError(path, 'is no flow characteristic: it holds no JSON') from None
    except DataError as error:
        raise RecordingError(path, f'cannot be used. {str(error).rstrip(".")}') from None
