"""Signals that were not logged: what a person says of them stands beside every reading."""

from __future__ import annotations

import numpy as np

from valveflow_ros.cli.plausible import limits
from valveflow_ros.cli.usage import UsageError
from valveflow_ros.config import Settings
from valveflow_ros.errors import DataError
from valveflow_ros.records import SIGNALS, Quality, Readings, Signal
from valveflow_ros.signals.unit_table import UNITS


def check_constants(constants: dict[Signal, float]) -> None:
    """Refuse constants that the engine would reject at each row.

    Raises
    ------
    UsageError
    """
    settings = Settings()
    for signal, value in constants.items():
        low, high = limits(signal, settings)
        if not low <= value <= high:
            info = SIGNALS[signal]
            others = ', '.join(list(UNITS[signal])[1:])
            raise UsageError(
                f'--constant {info.topic}: {value:g} {info.unit} is impossible ({low:g} to '
                f'{high:g} {info.unit}); for another unit write {info.topic}=VALUE:UNIT with one '
                f'of {others}.'
            )


def with_constants(readings: Readings, constants: dict[Signal, float]) -> Readings:
    """Put each constant beside every reading of a measured signal.

    Raises
    ------
    DataError
        If no signal is measured.
    """
    if not constants:
        return readings
    kept = ~np.isin(readings.signal, [int(s) for s in constants])
    readings = Readings(
        readings.time_ns[kept], readings.signal[kept], readings.value[kept],
        readings.quality[kept],
    )  # fmt: skip
    measured = [i.signal for i in SIGNALS if i.required and i.signal not in constants]
    lead = next((s for s in measured if (readings.signal == s).any()), None)
    if lead is None:
        raise DataError('Every signal is a constant or missing; nothing is left to learn from.')
    beside = np.flatnonzero(readings.signal == lead)
    for signal, value in sorted(constants.items()):
        n = len(beside)
        readings = Readings(
            np.insert(readings.time_ns, beside, readings.time_ns[beside]),
            np.insert(readings.signal, beside, np.full(n, int(signal), dtype=np.int8)),
            np.insert(readings.value, beside, np.full(n, value)),
            np.insert(readings.quality, beside, np.full(n, int(Quality.GOOD), dtype=np.uint8)),
        )
        beside = beside + np.arange(1, n + 1)
    return readings
