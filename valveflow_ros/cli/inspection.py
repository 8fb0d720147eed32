"""Describe a log: span, topics, signals, gaps, what will be rejected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from valveflow_ros.cli.log_input import LogInput, limits, steps_of_each
from valveflow_ros.cli.options import settings_for
from valveflow_ros.cli.report_words import columns, rejected_words
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SIGNALS, Quality, Readings, Signal
from valveflow_ros.report.data import Gap, gaps
from valveflow_ros.report.words import count, counted, duration, moment, plain

_GAP_STEPS = 3.5  # a pause of more than this many usual steps is a gap


@dataclass(frozen=True, slots=True)
class SignalFacts:
    """One signal of a log, in the engine's unit."""

    topic: str
    source: str
    unit: str
    readings: int
    step_s: float
    low: float
    median: float
    high: float
    gaps: list[Gap]


@dataclass(frozen=True, slots=True)
class Inspected:
    """What was seen."""

    log: LogInput
    signals: list[SignalFacts]
    counts: dict[str, dict[str, int]]

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last time of anything in the log."""
        contents = self.log.contents
        if contents.start_ns is None or contents.end_ns is None:
            return None
        return contents.start_ns, contents.end_ns

    def data(self) -> dict[str, Any]:
        """Return it for a program."""
        contents, span = self.log.contents, self.span_ns
        seconds = (span[1] - span[0]) / 1e9 if span else 0.0
        return {
            'log': contents.path,
            'start_ns': span[0] if span else None,
            'end_ns': span[1] if span else None,
            'duration_s': seconds,
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
                s.topic: {
                    'source': s.source,
                    'unit': s.unit,
                    'readings': s.readings,
                    'step_s': s.step_s,
                    'low': s.low,
                    'median': s.median,
                    'high': s.high,
                    'gaps': len(s.gaps),
                    'longest_gap_s': s.gaps[0].seconds if s.gaps else 0.0,
                }
                for s in self.signals
            },
            'readings': self.counts,
            'attachments': {name: len(data) for name, data in contents.attachments.items()},
            'metadata': {k: v for k, v in contents.metadata.items() if k != 'rosbag2'},
            'damaged_chunks': contents.damaged_chunks,
            'warnings': [*contents.warnings, *(d.sentence for d in self.log.doubts)],
        }

    def text(self) -> str:
        """Return it for a person."""
        contents, span = self.log.contents, self.span_ns
        lines = [contents.path]
        if span:
            length = duration((span[1] - span[0]) / 1e9)
            lines.append(f'  {moment(span[0])} to {moment(span[1])} ({length})')
        lines += self._topics()
        lines += self._signals()
        lines.append(rejected_words(self.counts))
        lines += self._gaps()
        if contents.attachments:
            told = ', '.join(
                f'{name} ({count(len(data))} bytes)' for name, data in contents.attachments.items()
            )
            lines.append(f'Attached: {told}.')
        if contents.damaged_chunks:
            lines.append(
                f'Damaged: {counted(contents.damaged_chunks, "place")}; "valveflow recover" makes '
                'a whole file of the rest.'
            )
        return '\n'.join(lines)

    def _topics(self) -> list[str]:
        span = self.span_ns
        seconds = (span[1] - span[0]) / 1e9 if span else 0.0
        rows = [
            [
                t.name,
                t.type,
                count(t.count),
                f'{plain(t.count / seconds, 3)} Hz' if seconds else '',
            ]
            for t in self.log.contents.topics.values()
        ]
        return [columns(rows, ['topic', 'type', 'messages', 'rate'])] if rows else []

    def _signals(self) -> list[str]:
        rows = [
            [
                s.topic,
                s.source,
                count(s.readings),
                duration(s.step_s),
                plain(s.low),
                plain(s.median),
                plain(s.high),
                s.unit,
            ]
            for s in self.signals
        ]
        head = ['signal', 'from', 'readings', 'step', 'lowest', 'median', 'highest', 'unit']
        absent = [
            i.topic
            for i in SIGNALS
            if i.required and i.topic not in {s.topic for s in self.signals}
        ]
        lines = [columns(rows, head)] if rows else []
        if absent:
            lines.append(f'Not in the log: {", ".join(absent)}.')
        return lines

    def _gaps(self) -> list[str]:
        lines = []
        for s in self.signals:
            if s.gaps:
                longest = s.gaps[0]
                lines.append(
                    f'{s.topic}: {counted(len(s.gaps), "gap")}, the longest '
                    f'{duration(longest.seconds)} from {moment(longest.start_ns)}.'
                )
        return lines or (['No gaps.'] if self.signals else [])


def inspect(log: LogInput) -> Inspected:
    """Look through a log that was read."""
    parts = log.readings.by_signal()
    steps = steps_of_each(parts)
    settings, _ = settings_for(steps, 0.0, {})
    counts = fates(log.readings, parts, settings)
    facts = [
        _facts(log, signal, parts[signal], steps.get(signal, float('nan')))
        for signal in sorted({*log.contents.signals, *log.constants})
        if signal in parts
    ]
    return Inspected(log, facts, counts)


def fates(
    readings: Readings, parts: dict[int, Readings], settings: Settings
) -> dict[str, dict[str, int]]:
    """Return how many readings of each signal are accepted or rejected, by reason.

    Where it can be seen at once that nothing is wrong, the engine need not be asked.
    """
    if _in_order(readings, parts, settings):
        return {
            info.topic: {'accepted': len(parts[info.signal]) if info.signal in parts else 0}
            for info in SIGNALS
        }
    from valveflow_ros.cli.alignment import align

    _, _, counts = align(readings, settings)
    return {
        topic: {reason: n for reason, n in by_reason.items() if reason != 'late'}
        for topic, by_reason in counts.items()
    }


def _in_order(readings: Readings, parts: dict[int, Readings], settings: Settings) -> bool:
    """Tell whether every reading is plausible and in order, so that none can be rejected."""
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
        # Comparisons with NaN are false, so NaN is out of order too.
        plausible = part.value.min() >= low and part.value.max() <= high
        if not (plausible and (np.diff(part.time_ns) > 0).all()):
            return False
    return True


def _facts(log: LogInput, signal: Signal, part: Readings, step_s: float) -> SignalFacts:
    info = SIGNALS[signal]
    values, times = part.value, part.time_ns
    if (times[1:] < times[:-1]).any():
        times = np.sort(times)
    finite = np.isfinite(values)
    known = values if finite.all() else values[finite]
    low, middle, high = (
        (known.min(), np.median(known), known.max()) if len(known) else (np.nan,) * 3
    )
    found = gaps(times, round(step_s * 1e9), _GAP_STEPS) if np.isfinite(step_s) else []
    return SignalFacts(
        info.topic,
        'constant' if signal in log.constants else log.name_of(signal),
        info.unit,
        len(values),
        step_s,
        float(low),
        float(middle),
        float(high),
        found,
    )
