"""The simulated plant as steps to be played."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import datetime, timezone

from valveflow_msgs.msg import PlantSample

from valveflow_ros.errors import ParameterError
from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.simulator import DEFAULT_START_NS
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.records import N_SIGNALS, NS_PER_S, SIGNALS, SampleTable, Signal
from valveflow_ros.ros.conversions import encode, header
from valveflow_ros.ros.inputs import PLANT_SAMPLE
from valveflow_ros.ros.outputs import float64_bytes
from valveflow_ros.ros.playing import Step

TABLE: tuple[Parameter, ...] = (
    Parameter('days', 10.0, 'd', 'How long the plant is simulated.', 0.001, 400.0),
    Parameter('seed', 1, '', 'Seed of every random number.', 0, 2**31 - 1),
    Parameter('rate', 1.0, '', 'Simulated seconds in a second; 0: as fast as the monitor takes '
              'them.', 0.0, 1e6),
    Parameter('stamped', False, '', 'Publish one stamped plant_sample instead of plain values.'),
    Parameter('use_clock', False, '', 'Publish the simulated time on /clock.'),
    Parameter('command', False, '', 'Publish valve_command too.'),
    Parameter('unit_tag', 'unit', '', 'Tag of the unit; frame_id of stamped samples.'),
    Parameter('start', '', '', 'Time of the first sample, ISO 8601, UTC unless it says otherwise; '
              'empty: now in real time, 2023-11-15 otherwise.'),
    Parameter('wait', 180.0, 's', 'How long to wait for a subscriber.', 0.0, 86400.0),
)  # fmt: skip


def effects_of(texts: Iterable[str]) -> list[EffectSpec]:
    """Read effects; a text may hold several, with semicolons between them.

    Raises
    ------
    InputError
        An effect is unknown or its parameters cannot be used.
    """
    return [
        EffectSpec.parse(text)
        for together in texts
        for text in together.split(';')
        if text.strip()
    ]


def start_ns_of(text: str, rate: float, now_ns: int) -> int:
    """Return the time of the first sample.

    Raises
    ------
    ParameterError
        The text is no time.
    """
    if not text.strip():
        return now_ns - now_ns % NS_PER_S if rate == 1.0 else DEFAULT_START_NS
    try:
        moment = datetime.fromisoformat(text.strip().replace('Z', '+00:00'))
    except ValueError:
        raise ParameterError(
            'start', f"must be a time such as 2026-03-01T12:00:00Z, not '{text}'"
        ) from None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=timezone.utc)
    return round(moment.timestamp()) * NS_PER_S


def check_together(rate: float, stamped: bool, use_clock: bool) -> None:
    """Refuse plain values in another time than the machine's, with nothing that says so.

    Raises
    ------
    ParameterError
        The samples' times would be lost.
    """
    if rate != 1.0 and not stamped and not use_clock:
        raise ParameterError(
            'rate',
            f'is {rate:g}, and plain values carry no time: set use_clock (and use_sim_time at '
            'the monitor), or stamped',
        )


def plain_steps(parts: Iterable[SampleTable], command: bool) -> Iterator[Step]:
    """Yield a step of single values for each row."""
    # The optional signal first, as everywhere.
    signals = [Signal.VALVE_COMMAND] if command else []
    signals += [info.signal for info in SIGNALS if info.required]
    names = [SIGNALS[signal].topic for signal in signals]
    for table in parts:
        columns = [table.column(signal).tolist() for signal in signals]
        for time_ns, *values in zip(table.time_ns.tolist(), *columns, strict=True):
            yield Step(
                time_ns,
                [(name, float64_bytes(v)) for name, v in zip(names, values, strict=True)],
            )


def stamped_steps(parts: Iterable[SampleTable], command: bool, tag: str) -> Iterator[Step]:
    """Yield a step with one stamped sample for each row."""
    topics = [info.topic for info in SIGNALS]
    for table in parts:
        values, quality = table.values.copy(), table.quality.copy()
        if not command:
            values[:, Signal.VALVE_COMMAND] = float('nan')
            quality[:, Signal.VALVE_COMMAND] = PlantSample.QUALITY_BAD
        rows = zip(table.time_ns.tolist(), values.tolist(), quality.tolist(), strict=True)
        for time_ns, row, codes in rows:
            sample = PlantSample(header=header(time_ns, tag))
            for k in range(N_SIGNALS):
                setattr(sample, topics[k], row[k])
                setattr(sample, f'{topics[k]}_quality', codes[k])
            yield Step(time_ns, [(PLANT_SAMPLE, encode(sample))])
