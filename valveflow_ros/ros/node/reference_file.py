"""The reference that is given at the start."""

from __future__ import annotations

import json

from valveflow_ros.config import Settings
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json
from valveflow_ros.errors import DataError, ParameterError
from valveflow_ros.ros.node.given_file import given_path, read_given

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
