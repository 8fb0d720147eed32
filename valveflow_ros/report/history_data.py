"""What a monitor published while it recorded: its curves, its alarms, its diagnoses."""

from __future__ import annotations

from dataclasses import dataclass

from valveflow_ros.monitoring.alarm_records import AlarmState
from valveflow_ros.records import FloatArray


@dataclass(frozen=True, slots=True)
class CurveMoment:
    """A curve, and when it came into force.

    Attributes
    ----------
    time_ns : int
        When it was published.
    model_id : str
    exponent : float
        Of the pressure in u.
    u, power_mw : float64 (J + 1,)
        Ends of the pieces and the power there.
    low, high : float64 (J - 1,)
        Where the inner ends lie with 95 % confidence; NaN if not known.
    rmse_mw : float
    """

    time_ns: int
    model_id: str
    exponent: float
    u: FloatArray
    power_mw: FloatArray
    low: FloatArray
    high: FloatArray
    rmse_mw: float


@dataclass(frozen=True, slots=True)
class AlarmMoment:
    """A change of one alarm's state."""

    time_ns: int
    name: str
    state: AlarmState
    sentence: str


@dataclass(frozen=True, slots=True)
class DiagnosisMoment:
    """A diagnosis, and what it said."""

    time_ns: int
    sentence: str


@dataclass(frozen=True, slots=True)
class History:
    """What a monitor published, each part in order of time.

    Attributes
    ----------
    start_ns, end_ns : int
        First and last moment of the recording, in the plant's time.
    curves : tuple of CurveMoment
        Each curve once, when it first came.
    alarms : tuple of AlarmMoment
    diagnoses : tuple of DiagnosisMoment
    notes : tuple of str
        What could not be read, as sentences.
    """

    start_ns: int
    end_ns: int
    curves: tuple[CurveMoment, ...] = ()
    alarms: tuple[AlarmMoment, ...] = ()
    diagnoses: tuple[DiagnosisMoment, ...] = ()
    notes: tuple[str, ...] = ()
