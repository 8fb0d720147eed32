"""Read a ``characteristic.json`` or an ``extended_model.json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valveflow_ros.cli.usage import UsageError
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import FORMAT, from_json
from valveflow_ros.errors import DataError, RecordingError

if TYPE_CHECKING:
    from valveflow_ros.diagnosis.extended import ExtendedModel

_MOST_BYTES = 50_000_000
_CURVE, _EXTENDED = 'characteristic.json', 'extended_model.json'


def read_model(path: Path) -> Characteristic:
    """Return the characteristic in a file.

    Raises
    ------
    RecordingError
        It cannot be read, or is no characteristic this version can read.
    """
    model = read_either(path)
    if not isinstance(model, Characteristic):
        raise RecordingError(path, 'is an extended model; here a characteristic.json is wanted')
    return model


def read_extended(path: Path) -> ExtendedModel:
    """Return the extended model in a file.

    Raises
    ------
    RecordingError
        It cannot be read, or is no extended model this version can use.
    """
    model = read_either(path, (_EXTENDED,))
    if isinstance(model, Characteristic):
        raise RecordingError(path, 'is a characteristic; here an extended_model.json is wanted')
    return model


def read_either(
    path: Path, names: tuple[str, ...] = (_CURVE, _EXTENDED)
) -> Characteristic | ExtendedModel:
    """Return what a file holds, a characteristic or an extended model.

    Parameters
    ----------
    path : Path
        The file, or a folder with one of ``names`` in it.
    names : tuple of str

    Raises
    ------
    RecordingError
        It cannot be read, or is none this version can use.
    """
    path = model_path(path, names)
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise RecordingError(path, 'is too large to be a flow characteristic')
        raw = json.loads(path.read_text(encoding='utf-8'))
        return _of_json(raw)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(path, f'cannot be read ({reason})') from None
    except (ValueError, RecursionError):
        raise RecordingError(path, 'is no flow characteristic: it holds no JSON') from None
    except DataError as error:
        raise RecordingError(path, f'cannot be used. {str(error).rstrip(".")}') from None


def model_path(path: Path, names: tuple[str, ...] = (_CURVE, _EXTENDED)) -> Path:
    """Return the file that is meant: of a folder, the first of ``names`` in it."""
    if not path.is_dir():
        return path
    return next((path / name for name in names if (path / name).is_file()), path)


def _of_json(raw: object) -> Characteristic | ExtendedModel:
    if not isinstance(raw, dict) or raw.get('format') == FORMAT:
        return from_json(raw)
    from valveflow_ros.diagnosis import result

    return result.model_from_json(raw) if result.is_model(raw) else from_json(raw)


def check_exponent(
    model: Characteristic | ExtendedModel, path: Path, given: Mapping[str, Any]
) -> None:
    """Refuse a pressure exponent that is not the model's.

    Raises
    ------
    UsageError
    """
    wanted = given.get('pressure_exponent')
    if wanted is not None and abs(float(wanted) - model.pressure_exponent) > 1e-9:
        raise UsageError(
            f'{path} is a curve over V p^{model.pressure_exponent:g}, but the parameter '
            f'pressure_exponent is set to {float(wanted):g}: leave it out, the model decides.'
        )
