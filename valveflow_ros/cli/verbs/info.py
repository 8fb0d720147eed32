# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow info``: describe the content of a log."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valveflow_ros.cli import command

if TYPE_CHECKING:
    from valveflow_ros.interface.logs import Log
    from valveflow_ros.parameters import Settings
    from valveflow_ros.records import Readings, Signal

_GAP_STEPS = 3.5  # a pause of more than this many usual steps is a gap

_OTHER_NS = 60 * 10**9  # beyond it, times of messages and of their values differ
USAGE = 'LOG [options]'
DESCRIPTION = """\
Show what a log contains before working with it: its time span, topics and rates, the range of
each signal, gaps, values that will be rejected and why, attachments, and whether anything is
damaged.

example:
  valveflow info plant.mcap"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('log', metavar='LOG', type=Path, help='the log to show')
    command.add_mapping(parser)


def run(options: Namespace, console: command.Console) -> command.VerbResult:
    """Read the log and describe it."""
    mapping = command.mapping_of(options)
    console(0.1, 'reading')
    from valveflow_ros.interface.logs import open_log, steps_of
    from valveflow_ros.interface.plausibility import limits
    from valveflow_ros.interface.settings import settings_for
    from valveflow_ros.records import SIGNALS, Signal

    log = open_log(options.log, mapping, progress=console)
    parts = log.recorded.by_signal()
    steps = steps_of(parts)
    compression = log.compression
    # A value of a compressed log may be valid for long, without a gap or a jump of the clock.
    stands_s = (
        compression.longest_s if compression is not None and log.updates is not None else 0.0
    )
    jump = {'clock_jump': min(2.0 * stands_s, 3600.0)} if stands_s > 0.0 else {}
    settings, _ = settings_for(steps, 0.0, log.parameters(jump)[0])
    counts = _fates(log.recorded, parts, settings)
    contents = log.contents
    start, end = contents.start_ns, contents.end_ns
    times = log.recorded.time_ns
    data_ns = (int(times.min()), int(times.max())) if len(times) else (None, None)
    seconds = 0.0 if start is None or end is None else (end - start) / 1e9
    signals = {
        SIGNALS[s].topic: _facts(log, s, parts[s], steps.get(s, float('nan')), stands_s)
        for s in sorted({*contents.signals, *log.constants})
        if s in parts
    }
    data = {
        'log': contents.path,
        'start_ns': None if end is None else start,
        'end_ns': None if start is None else end,
        'duration_s': seconds,
        'data_start_ns': data_ns[0],
        'data_end_ns': data_ns[1],
        'topics': [
            {
                'name': t.name,
                'type': t.type,
                'messages': t.count,
                'rate_hz': t.count / seconds if seconds else None,
            }
            for t in contents.topics.values()
        ],
        'signals': {
            topic: {
                **facts,
                'gaps': len(facts['gaps']),
                'longest_gap_s': facts['gaps'][0].seconds if facts['gaps'] else 0.0,
            }
            for topic, facts in signals.items()
        },
        'readings': counts,
        'attachments': {name: len(data) for name, data in contents.attachments.items()},
        'metadata': {k: v for k, v in contents.metadata.items() if k != 'rosbag2'},
        'damaged_chunks': contents.damaged_chunks,
        'warnings': list(log.notes),
    }
    ranges = {}
    for signal in parts:
        low, high = limits(Signal(signal), settings)
        topic = SIGNALS[signal].topic
        ranges[topic] = f'{low:g} to {high:g} {signals[topic]["unit"]}'
    name = contents.path if options.log.name not in ('', '..') else log.name
    return command.VerbResult(_text(str(name), data, signals, ranges), data)


def _text(
    name: str, data: dict[str, Any], signals: dict[str, dict[str, Any]], ranges: dict[str, str]
) -> str:
    from valveflow_ros.records import SIGNALS
    from valveflow_ros.report.words import count, counted, duration, moment, plain

    span = ''
    if data['start_ns'] is not None:
        span = f'  {moment(data["start_ns"])} to {moment(data["end_ns"])} '
        span += f'({duration(data["duration_s"])})'
    # In a replay the messages have times of their own besides those of the values.
    ends = ((data[f'data_{end}'], data[end]) for end in ('start_ns', 'end_ns'))
    if any(None not in pair and abs(pair[0] - pair[1]) > _OTHER_NS for pair in ends):
        first, last = data['data_start_ns'], data['data_end_ns']
        span = command.lines(
            f'  data: {moment(first)} to {moment(last)} ({duration((last - first) / 1e9)})',
            f'  recorded: {span.strip()}' if span else '',
        )
    topics = [
        [
            t['name'], t['type'], count(t['messages']),
            '' if t['rate_hz'] is None else f'{plain(t["rate_hz"], 3)} Hz',
        ]
        for t in data['topics']
    ]  # fmt: skip
    rows = [
        [
            topic, s['source'], count(s['readings']), duration(s['step_s']), plain(s['low']),
            plain(s['median']), plain(s['high']), s['unit'],
        ]
        for topic, s in signals.items()
    ]  # fmt: skip
    head = ['signal', 'from', 'readings', 'step', 'lowest', 'median', 'highest', 'unit']
    absent = [i.topic for i in SIGNALS if i.required and i.topic not in signals]
    found = {
        topic: f'{counted(len(gaps), "gap")}, the longest {duration(gaps[0].seconds)} '
        f'from {moment(gaps[0].start_ns)}.'
        for topic, s in signals.items()
        if (gaps := s['gaps'])
    }
    recorded = [topic for topic, s in signals.items() if s['source'] != 'constant']
    if list(found) == recorded and len({*found.values()}) == 1:
        found = {'every signal': next(iter(found.values()))}
    attached = ', '.join(
        f'{name} ({count(size)} bytes)' for name, size in data['attachments'].items()
    )
    damaged = data['damaged_chunks'] and counted(data['damaged_chunks'], 'place')
    return command.lines(
        name,
        span,
        command.table(['topic', 'type', 'messages', 'rate'], topics),
        command.table(head, rows),
        f'Not in the log: {", ".join(absent)}.' if absent else '',
        command.rejected_words(data['readings'], ranges),
        *(f'{which}: {gaps}' for which, gaps in found.items()),
        'No gaps.' if signals and not found else '',
        f'Attached: {attached}.' if attached else '',
        f'Damaged: {damaged}; "valveflow recover" makes a whole file of the rest.'
        if damaged
        else '',
    )


def _fates(
    readings: Readings, parts: dict[int, Readings], settings: Settings
) -> dict[str, dict[str, int]]:
    """Return how many readings of each signal are accepted or rejected, by reason.

    If a quick check finds no problem, the engine is not loaded.
    """
    from valveflow_ros.records import SIGNALS

    if _in_order(readings, parts, settings):
        return {
            info.topic: {'accepted': len(parts[info.signal]) if info.signal in parts else 0}
            for info in SIGNALS
        }
    from valveflow_ros.signals.align import align_whole

    _, _, counts = align_whole(readings, settings)
    return {
        topic: {reason: n for reason, n in by_reason.items() if reason != 'late'}
        for topic, by_reason in counts.items()
    }


def _in_order(readings: Readings, parts: dict[int, Readings], settings: Settings) -> bool:
    """Return True if every reading is plausible and in order, so that none can be rejected."""
    import numpy as np

    from valveflow_ros.interface.plausibility import limits
    from valveflow_ros.records import NS_PER_S, Quality, Signal

    if not len(readings):
        return True
    step = np.diff(readings.time_ns)
    longest = round(settings.real('clock_jump') * NS_PER_S)
    if step.min(initial=0) < 0 or step.max(initial=0) > longest:
        return False
    if not (readings.quality < Quality.BAD).all():
        return False
    for signal, part in parts.items():
        low, high = limits(Signal(signal), settings)
        # Comparisons with NaN are false, so NaN counts as out of order.
        plausible = part.value.min() >= low and part.value.max() <= high
        if not (plausible and (np.diff(part.time_ns) > 0).all()):
            return False
    return True


def _facts(
    log: Log, signal: Signal, part: Readings, step_s: float, stands_s: float
) -> dict[str, Any]:
    """Return the description of one signal, in the unit of the engine."""
    import numpy as np

    from valveflow_ros.report.data import gaps
    from valveflow_ros.signals.units import engine_unit

    values, times = part.value, part.time_ns
    usual_s = max(step_s, 1.1 * stands_s / _GAP_STEPS)
    if (times[1:] < times[:-1]).any():
        times = np.sort(times)
    finite = np.isfinite(values)
    known = values if finite.all() else values[finite]
    low, middle, high = (
        (known.min(), np.median(known), known.max()) if len(known) else (np.nan,) * 3
    )
    return {
        'source': 'constant' if signal in log.constants else log.name_of(signal),
        'unit': engine_unit(signal, log.units.get(signal, '')),
        'readings': len(values),
        'step_s': step_s,
        'low': float(low),
        'median': float(middle),
        'high': float(high),
        'gaps': gaps(times, round(usual_s * 1e9), _GAP_STEPS) if np.isfinite(step_s) else [],
    }
