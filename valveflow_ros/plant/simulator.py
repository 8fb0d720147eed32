"""Simulate a unit for some days and return what its instruments would have written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from valveflow_ros.errors import InputError
from valveflow_ros.plant.hooks import DAY_S, Hooks, clock_at_ns
from valveflow_ros.plant.plant import Plant
from valveflow_ros.plant.programme import LoadProgramme
from valveflow_ros.plant.recorder import Recorder, SimulatedLog
from valveflow_ros.plant.spec import EffectSpec, install
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import NS_PER_S

__all__ = ['DEFAULT_START_NS', 'WARM_UP_S', 'SimulatedLog', 'simulate', 'simulate_parts']

WARM_UP_S = 3600.0
LONGEST_DAYS = 400.0
DEFAULT_START_NS = 1_700_006_400 * NS_PER_S  # 2023-11-15 00:00:00 UTC, a midnight


def simulate(
    days: float,
    seed: int,
    unit: UnitDescription | None = None,
    start_ns: int = DEFAULT_START_NS,
    effects: Sequence[EffectSpec] = (),
) -> SimulatedLog:
    """Simulate ``days`` of operation.

    Parameters
    ----------
    days : float
        Length, more than 0 and at most 400.
    seed : int
        Every random number follows from it. The same numbers are used whatever
        effects are on, and a longer run begins with the shorter one.
    unit : UnitDescription, optional
        Defaults to the unit of the paper's simulation study.
    start_ns : int
        Time of the first row; it decides the time of day, taken as UTC.
    effects : sequence of EffectSpec
        What to switch on; their order makes no difference.

    Raises
    ------
    InputError
        ``days``, ``seed`` or ``start_ns`` out of range, or effects that
        cannot act in this run or not together.

    Notes
    -----
    A row takes about 90 bytes, twice that while the parts are joined: ten days
    at 1 s 160 MB, a year 6 GB. For long runs use `simulate_parts`.
    """
    return SimulatedLog.joined(list(simulate_parts(days, seed, unit, start_ns, effects)))


def simulate_parts(
    days: float,
    seed: int,
    unit: UnitDescription | None = None,
    start_ns: int = DEFAULT_START_NS,
    effects: Sequence[EffectSpec] = (),
    part_s: float = DAY_S,
) -> Iterator[SimulatedLog]:
    """Simulate as `simulate` does and yield the run in consecutive parts of ``part_s``.

    The state goes on from part to part: joined, the parts are what `simulate`
    returns, bit for bit, for any ``part_s``. Memory holds one part.

    Raises
    ------
    InputError
        At the call, before anything runs; see `simulate`.
    """
    unit = unit or UnitDescription()
    if not 0.0 < days <= LONGEST_DAYS:
        raise InputError(
            f'A simulation must last more than 0 and at most {LONGEST_DAYS:g} days, not {days}.'
        )
    h = unit.sample_period_s
    if not part_s >= h:
        raise InputError(f'A part must last one sample period or longer, not {part_s} s.')
    rows = max(1, round(days * DAY_S / h))
    hooks = Hooks.of(unit, rows * h)
    recorder = prepare(hooks, seed, start_ns, effects)
    warm_up = round(WARM_UP_S / h)
    length_s = (warm_up + rows + recorder.ahead) * h
    clock_s = clock_at_ns(start_ns)
    drive = LoadProgramme(unit, seed, length_s, clock_s - warm_up * h)
    plant = Plant(hooks, drive, seed, -warm_up, clock_s)
    return recorder.parts(plant, warm_up, rows, max(1, round(min(part_s, rows * h) / h)))


def prepare(hooks: Hooks, seed: int, start_ns: int, effects: Sequence[EffectSpec]) -> Recorder:
    """Check what every run is given, put the effects on the hooks, return the recorder.

    Raises
    ------
    InputError
        See `simulate`.
    """
    if seed < 0:
        raise InputError(f'The seed must be 0 or more, not {seed}.')
    end_ns = start_ns + round(hooks.length_s * NS_PER_S)
    if start_ns < 0 or end_ns >= 2**63:
        raise InputError('A simulation must lie between the years 1970 and 2262.')
    install(effects, hooks)
    return Recorder(hooks, start_ns, tuple(effects))
