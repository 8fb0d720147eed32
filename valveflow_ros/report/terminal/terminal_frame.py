"""What the terminal view shows at one moment, as plain records."""

from __future__ import annotations

import math
from dataclasses import dataclass

# The words of the messages' numbers, as a person says them.
CURVE_STATES = ('no curve yet', 'fresh', 'stale', 'refused')
SAMPLE_STATES = (
    'no curve to judge by',
    'plant in motion',
    'steady state',
    'on a long ramp',
    'outside the curve',
    'bad or missing data',
)
ALARM_STATES = (
    'normal',
    'ALARM, not acknowledged',
    'ALARM, acknowledged',
    'gone by itself, not acknowledged',
    'put aside for a time',
    'cannot be judged now',
    'out of service',
)
VERDICTS = ('not diagnosed yet', 'nothing is wrong', 'cause named', 'unexplained')
NORMAL, UNACKNOWLEDGED, ACKNOWLEDGED = 0, 1, 2
OUTSIDE, BAD_DATA = 4, 5
OK, WARN, ERROR, STALE = 0, 1, 2, 3


@dataclass(frozen=True, slots=True)
class CurveView:
    """The flow characteristic.

    Attributes
    ----------
    breakpoints, values : tuple of float
        u in % MPa^m and power in MW at the ends of the pieces; empty without a curve.
    state : int
        Place in `CURVE_STATES`.
    cause : str
        Why it is not fresh.
    model_id : str
    window : tuple of int
        First and last time of its data in ns; 0: none.
    samples : int
    rmse_mw : float
    shift : str
        The judgement against the reference; empty: none.
    exponent : float
        The m of u = V p^m; NaN: not told.
    """

    breakpoints: tuple[float, ...]
    values: tuple[float, ...]
    state: int
    cause: str
    model_id: str
    window: tuple[int, int]
    samples: int
    rmse_mw: float
    shift: str
    exponent: float = math.nan


@dataclass(frozen=True, slots=True)
class SampleView:
    """One sample beside what the curve says of it; NaN: not known.

    Attributes
    ----------
    time_ns : int
    state : int
        Place in `SAMPLE_STATES`.
    u, measured_mw, residual_mw, average_mw : float
    low_mw, high_mw : float
        Where the residual should lie, 95 times in a hundred.
    evidence : float
        Beyond 1 or -1 there is an alarm.
    """

    time_ns: int
    state: int
    u: float
    measured_mw: float
    residual_mw: float
    average_mw: float
    low_mw: float
    high_mw: float
    evidence: float


@dataclass(frozen=True, slots=True)
class AlarmView:
    """One alarm: its name, its place in `ALARM_STATES`, what it says, since when (0: never)."""

    name: str
    state: int
    sentence: str
    raised_ns: int

    @property
    def standing(self) -> bool:
        """Tell whether somebody has to know of it."""
        return self.state != NORMAL


@dataclass(frozen=True, slots=True)
class HealthView:
    """How an input, the recorder or anything else is: OK, WARN, ERROR or STALE, and why."""

    name: str
    level: int
    sentence: str


@dataclass(frozen=True, slots=True)
class DiagnosisView:
    """The last diagnosis: its place in `VERDICTS`, its sentence, names of causes, its end."""

    verdict: int
    sentence: str
    causes: tuple[str, ...]
    until_ns: int


@dataclass(frozen=True, slots=True)
class Frame:
    """Everything the view shows at one moment.

    Attributes
    ----------
    unit : str
        The unit's tag; empty: not known.
    source : str
        Where it comes from, for a person.
    now_ns : int
        The plant's time; 0: nothing has come yet.
    note : str
        A sentence that stands above all, such as what is waited for.
    """

    unit: str = ''
    source: str = ''
    now_ns: int = 0
    note: str = ''
    curve: CurveView | None = None
    last: SampleView | None = None
    samples: tuple[SampleView, ...] = ()
    alarms: tuple[AlarmView, ...] = ()
    inputs: tuple[HealthView, ...] = ()
    recorder: HealthView | None = None
    diagnosis: DiagnosisView | None = None


def word(words: tuple[str, ...], number: int) -> str:
    """Return the word for a number of a message; one of a later version is said as it is."""
    return words[number] if 0 <= number < len(words) else f'state {number}'
