# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads and checks the files named by the parameters `model_file` and `reference_file`."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable
from dataclasses import replace
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
from valveflow_ros.signals.covariates import entries_of

MODEL_FILE = 'model_file'
ATTACHMENT = 'extended_model.json'
_MAX_BYTES = 10_000_000
_FEW = 32


def given_model(settings: Settings) -> ExtendedModel | None:
    """Read the extended model that corrects the rows; None if none is given.

    Raises
    ------
    ParameterError
        If the file cannot be read, is no extended model, or has another input u.
    """

    def parse(content: Any) -> ExtendedModel:
        given = result.model_from_json(content)
        corrector_of(given, settings.real('sample_period'), entries_of(settings))
        return given

    model: ExtendedModel | None = _given(settings, MODEL_FILE, 'a model', parse)
    return model


def given_reference(settings: Settings) -> Characteristic | None:
    """Read the curve with which later ones are compared; None if none is given.

    Raises
    ------
    ParameterError
        If the file cannot be read, is no characteristic, or has another input u.
    """
    curve: Characteristic | None = _given(settings, 'reference_file', 'a curve', from_json)
    return curve


def corrector_for(given: ExtendedModel | None, settings: Settings) -> Corrector | None:
    """Return the compiled corrector of a model, None without a model; also used in a replay."""
    if given is None:
        return None
    corrector = corrector_of(given, settings.real('sample_period'), entries_of(settings))
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
    beside = np.zeros((_FEW, len(entries_of(settings))))
    rows = replace(rows, covariates=beside)
    # Compile the loops or load them from the cache now, so that no sample waits for them.
    corrector.correct(rows)
    corrector.restart()
    return corrector


def model_attachment(given: ExtendedModel | None) -> dict[str, bytes]:
    """Return the attachment with the model, so that a replay makes the same corrections."""
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
    """Return the text of a regular file; devices and pipes, which may be endless, are refused.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If it is no regular file, no text, or too large.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, 'rb') as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError('it is no file')
        # The size is checked after reading, because the file may still grow.
        content = file.read(_MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise ValueError(f'it is too large to be {what}')
    return content.decode()
