# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read ``characteristic.json``, ``extended_model.json`` and the truth of a simulated plant."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from valveflow_ros.baselines.truth import Truth, read_truth
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import FORMAT, from_json
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.diagnosis.result import is_model, model_from_json
from valveflow_ros.errors import DataError, RecordingError, UsageError
from valveflow_ros.interface.files import Result, reason

Model = Characteristic | ExtendedModel
Read = TypeVar('Read', bound=Model)
_MOST_BYTES = 50_000_000
_CURVE, _EXTENDED = 'characteristic.json', 'extended_model.json'


def load_characteristic(path: str | Path) -> Characteristic:
    """Return the flow characteristic in a file.

    Parameters
    ----------
    path : str or Path
        A ``characteristic.json``, or the folder that contains one.

    Raises
    ------
    RecordingError
        It cannot be read, or is no characteristic that this version supports.
    """
    model = load_model(path)
    if not isinstance(model, Characteristic):
        raise RecordingError(path, 'is an extended model; here a characteristic.json is wanted')
    return model


def load_extended(path: str | Path) -> ExtendedModel:
    """Return the extended model in a file or folder; raises as `load_characteristic`."""
    model = load_model(path, (_EXTENDED,))
    if isinstance(model, Characteristic):
        raise RecordingError(path, 'is a characteristic; here an extended_model.json is wanted')
    return model


def load_model(path: str | Path, names: tuple[str, ...] = (_CURVE, _EXTENDED)) -> Model:
    """Return the characteristic or the extended model in a file; raises as `load_characteristic`.

    In a folder it is the first of ``names``.
    """
    path = model_path(Path(path).expanduser(), names)
    raw = _read_json(path, 'a flow characteristic', 'flow characteristic')
    try:
        extended = isinstance(raw, dict) and raw.get('format') != FORMAT and is_model(raw)
        return model_from_json(raw) if extended else from_json(raw)
    except DataError as error:
        raise RecordingError(path, f'cannot be used. {str(error).rstrip(".")}') from None
    except (ValueError, RecursionError):
        raise RecordingError(path, 'is no flow characteristic: it holds no JSON') from None


def model_path(path: Path, names: tuple[str, ...] = (_CURVE, _EXTENDED)) -> Path:
    """Return the path of the file; for a folder, the first of ``names`` in it."""
    if not path.is_dir():
        return path
    return next((path / name for name in names if (path / name).is_file()), path)


def taken_model(
    model: Read | str | Path | None,
    parameters: Mapping[str, Any] | None,
    load: Callable[[str | Path], Read],
) -> tuple[Read | None, dict[str, Any]]:
    """Return a model, read if a path is given, and the parameters with its pressure exponent.

    Raises
    ------
    RecordingError
        The file cannot be read.
    UsageError
        It is no model; or the parameters give another exponent. A curve over the opening has none.
    """
    given = dict(parameters or {})
    if model is None:
        return None, given
    name = model if isinstance(model, str | Path) else 'The model'
    kinds = (ExtendedModel,) if load is load_extended else (Characteristic, ExtendedModel)
    read = _taken(model, load, kinds)
    exponent = read.pressure_exponent
    if exponent == 0.0:
        return read, given
    wanted = given.get('pressure_exponent')
    if wanted is not None and abs(float(wanted) - exponent) > 1e-9:
        raise UsageError(
            f'{name} is a curve over V p^{exponent:g}, but the parameter pressure_exponent is set '
            f'to {float(wanted):g}: leave it out, the model decides.'
        )
    return read, {**given, 'pressure_exponent': exponent}


def taken_curve(curve: Characteristic | str | Path | None) -> Characteristic | None:
    """Return a curve, read if a path is given; raises as `load_characteristic`."""
    return None if curve is None else _taken(curve, load_characteristic, (Characteristic,))


def _taken(given: Any, load: Callable[[str | Path], Read], kinds: tuple[type[Any], ...]) -> Read:
    """Return a model that is given as itself, as the result that has it, or as a path."""
    if isinstance(given, str | Path):
        return load(given)
    names = ('extended_model', 'characteristic') if isinstance(given, Result) else ()
    found: Any = next((getattr(given, n) for n in names if hasattr(given, n)), given)
    if not isinstance(found, kinds):
        wanted, not_it = ' or '.join(k.__name__ for k in kinds), type(given).__name__
        raise UsageError(f'The model must be {wanted}, or the path of one; it is {not_it}.')
    read: Read = found
    return read


def check_output(unit: str, **models: Model | None) -> None:
    """Raise `UsageError` if the output of a model has another unit than that of the log.

    The models are given by the last word of their name in the message: ``model`` is 'The model'.
    """
    for name, model in models.items():
        if model is not None and model.output_unit != unit:
            raise UsageError(
                f'The {name.replace("_", " ")} is a curve of an output in {model.output_unit}, '
                f'and that of the log is in {unit}: name its unit with --column '
                f'generated_power=THEIRS:{model.output_unit}, or leave the curve out.'
            )


def load_truth(path: str | Path) -> Truth:
    """Return the truth in a file that ``simulate --truth`` wrote, or in a characteristic.

    Raises
    ------
    RecordingError
        It cannot be read, or is neither.
    """
    path = Path(path)
    try:
        return read_truth(_read_json(path, 'the truth of a plant', 'truth of a plant'))
    except DataError as error:
        raise RecordingError(path, f'cannot be used. {str(error).rstrip(".")}') from None


def _read_json(path: Path, large: str, none: str) -> Any:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise RecordingError(path, f'is too large to be {large}')
        return json.loads(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise RecordingError(path, f'cannot be read ({reason(error)})') from None
    except (ValueError, RecursionError):
        raise RecordingError(path, f'is no {none}: it holds no JSON') from None
