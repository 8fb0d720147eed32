"""Read what is true of a plant."""

from __future__ import annotations

import json
from pathlib import Path

from valveflow_ros.baselines.truth import Truth, read_truth
from valveflow_ros.errors import DataError, RecordingError

_MOST_BYTES = 50_000_000


def read_truth_file(path: Path) -> Truth:
    """Return the truth in a file that ``simulate --truth`` wrote, or in a characteristic.

    Raises
    ------
    RecordingError
        It cannot be read, or is neither.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise RecordingError(path, 'is too large to be the truth of a plant')
        return read_truth(json.loads(path.read_text(encoding='utf-8')))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(path, f'cannot be read ({reason})') from None
    except (ValueError, RecursionError):
        raise RecordingError(path, 'is no truth of a plant: it holds no JSON') from None
    except DataError as error:
        raise RecordingError(path, f'cannot be used. {str(error).rstrip(".")}') from None
