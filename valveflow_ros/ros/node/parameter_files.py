# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The files that `model_file` and `reference_file` name: read whole, or refused with a reason."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

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

MODEL_FILE = 'model_file'
ATTACHMENT = 'extended_model.json'
_MAX_BYTES = 10_000_000
_FEW = 32


def given_model(settings: Settings) -> ExtendedModel | None:
    """Read the extended model whose causes are taken out of the rows; None without one.

    Raises
    ------
    ParameterError
        The file cannot be read, is no extended model, or one of another input u.
    """

    def parse(content: Any) -> ExtendedModel:
        given = result.model_from_json(content)
        corrector_of(given, settings.real('sample_period'))
        return given

    model: ExtendedModel | None = _given(settings, MODEL_FILE, 'a model', parse)
    return model


def given_reference(settings: Settings) -> Characteristic | None:
    """Read the curve that later ones are judged against; None without one.

    Raises
    ------
    ParameterError
        The file cannot be read, is no characteristic, or one of another input u.
    """
    curve: Characteristic | None = _given(settings, 'reference_file', 'a curve', from_json)
    return curve


def corrector_for(given: ExtendedModel | None, settings: Settings) -> Corrector | None:
    """Return what corrects rows, compiled; None without a model. Live and in a replay."""
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


def model_attachment(given: ExtendedModel | None) -> dict[str, bytes]:
    """Return what a recording keeps of the model, so that a replay takes out the same."""
    if given is None:
        return {}
    return {ATTACHMENT: json.dumps(result.model_to_json(given), indent=2).encode()}


def _given(
    settings: Settings, parameter: str, what: str, parse: Callable[[Any], Any]
) -> Any | None:
    path = settings.text(parameter)
    if not path:
        return None
    try:
        try:
            path = str(Path(path).expanduser())
        except RuntimeError:
            raise ValueError(f"'{path.partition('/')[0]}' is nobody's home") from None
        given = parse(json.loads(_read(path, what)))
    except (OSError, ValueError, RecursionError, DataError) as error:
        reason = (error.strerror or '').lower() if isinstance(error, OSError) else str(error)
        raise ParameterError(
            parameter, f"names '{path}', which cannot be used: {reason.rstrip('.')}"
        ) from None
    return given


def _read(path: str, what: str) -> str:
    """Return the text of a file; neither a device nor a pipe is read, which may have no end.

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
        content = file.read(_MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise ValueError(f'it is too large to be {what}')
    return content.decode()
