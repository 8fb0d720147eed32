"""Small files that a parameter names: read whole, or refused for what they are."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json
from valveflow_ros.diagnosis import result
from valveflow_ros.diagnosis.corrector import corrector_of
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.errors import DataError, ParameterError
from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SampleTable, Signal

_MOST_BYTES = 10_000_000


def given_path(name: str) -> str:
    """Return the path a parameter names; raises `ValueError` if its `~` means nobody."""
    try:
        return str(Path(name).expanduser())
    except RuntimeError:
        raise ValueError(f"'{name.partition('/')[0]}' is nobody's home") from None


def read_given(path: str, what: str) -> str:
    """Return the text of a file.

    Neither a device, which may have no end, nor a pipe, which may never begin, is read.

    Parameters
    ----------
    path : str
    what : str
        What it should be, for the sentence.

    Raises
    ------
    OSError
        It cannot be read.
    ValueError
        It is no file, no text, or too large.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, 'rb') as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError('it is no file')
        # It may still grow, so its size is not asked for.
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise ValueError(f'it is too large to be {what}')
    return content.decode()


# The extended model whose causes the monitor takes out of its rows.


PARAMETER = 'model_file'
ATTACHMENT = 'extended_model.json'
_FEW = 32


def extended_of(settings: Settings) -> ExtendedModel | None:
    """Read the file the parameter names; None without one.

    Raises
    ------
    ParameterError
        It cannot be read, is no extended model, or one of another input u.
    """
    name = settings.text(PARAMETER)
    if not name:
        return None
    path = name
    try:
        path = given_path(name)
        given = result.model_from_json(json.loads(read_given(path, 'a model')))
        corrector_of(given, settings.real('sample_period'))
    except (OSError, ValueError, RecursionError, DataError) as error:
        reason = (error.strerror or '').lower() if isinstance(error, OSError) else str(error)
        raise ParameterError(
            PARAMETER, f"names '{path}', which cannot be used: {reason.rstrip('.')}"
        ) from None
    exponent = settings.real('pressure_exponent')
    if given.pressure_exponent != exponent:
        raise ParameterError(
            PARAMETER,
            f"names '{path}' with the pressure exponent {given.pressure_exponent:g}, the "
            f'monitor has {exponent:g}',
        )
    return given


def ready(given: ExtendedModel | None, settings: Settings) -> Corrector | None:
    """Return what corrects rows, compiled; None without a model."""
    if given is None:
        return None
    corrector = corrector_of(given, settings.real('sample_period'))
    period_ns = round(settings.real('sample_period') * NS_PER_S)
    rows = SampleTable.from_columns(
        given.start_ns + period_ns * np.arange(_FEW, dtype=np.int64),
        {
            Signal.VALVE_OPENING: np.full(_FEW, 50.0),
            Signal.MAIN_STEAM_PRESSURE: np.full(_FEW, 16.0),
            Signal.MAIN_STEAM_TEMPERATURE: np.full(_FEW, 540.0),
            Signal.GENERATED_POWER: np.full(_FEW, 200.0),
        },
    )
    # Loads or compiles the loops now, so that no sample of the plant waits for them.
    corrector.correct(rows)
    corrector.restart()
    return corrector


def attached(given: ExtendedModel | None) -> dict[str, bytes]:
    """Return what a recording keeps of the model, so that a replay takes out the same."""
    if given is None:
        return {}
    return {ATTACHMENT: json.dumps(result.model_to_json(given), indent=2).encode()}


# The reference that is given at the start.


_PARAMETER = 'reference_file'


def reference_of(settings: Settings) -> Characteristic | None:
    """Read the file the parameter names; None without one.

    Raises
    ------
    ParameterError
        It cannot be read, is no characteristic, or one of another input u.
    """
    name = settings.text(_PARAMETER)
    if not name:
        return None
    path = name
    try:
        path = given_path(name)
        curve = from_json(json.loads(read_given(path, 'a curve')))
    except (OSError, ValueError, RecursionError, DataError) as error:
        reason = error.strerror.lower() if isinstance(error, OSError) else str(error)
        raise ParameterError(
            _PARAMETER, f"names '{path}', which cannot be used: {str(reason).rstrip('.')}"
        ) from None
    exponent = settings.real('pressure_exponent')
    if curve.pressure_exponent != exponent:
        raise ParameterError(
            _PARAMETER,
            f"names '{path}' with the pressure exponent {curve.pressure_exponent:g}, the "
            f'monitor has {exponent:g}',
        )
    return curve
