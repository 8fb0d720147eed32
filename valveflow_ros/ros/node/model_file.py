"""The extended model whose causes the monitor takes out of its rows."""

from __future__ import annotations

import json

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.diagnosis import model_json
from valveflow_ros.diagnosis.corrector import corrector_of
from valveflow_ros.diagnosis.extended_model import ExtendedModel
from valveflow_ros.errors import DataError, ParameterError
from valveflow_ros.monitoring.corrector import Corrector
from valveflow_ros.records import NS_PER_S, SampleTable, Signal
from valveflow_ros.ros.node.given_file import given_path, read_given

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
        given = model_json.from_json(json.loads(read_given(path, 'a model')))
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
    return {ATTACHMENT: json.dumps(model_json.to_json(given), indent=2).encode()}
