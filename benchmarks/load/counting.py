# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The account of a run: every message that was sent stands in exactly one column."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.load.monitor import Ears
from benchmarks.load.sender import Stream
from valveflow_ros.logs import open_log
from valveflow_ros.signals.align import REASONS

_VALUE_AT = 4  # bytes before the value of a Float64


@dataclass(frozen=True, slots=True)
class Account:
    """What became of the messages of one topic.

    Attributes
    ----------
    sent : int
        By the sender.
    recorded, repeated, disordered : int
        Messages in the file, by the numbers that they carry; those that stand there twice, and
        those that stand behind a later one.
    missing : int
        Numbers that are not in the file.
    received, lost, missed_at_start, irregular, unreadable : int
        By the monitor's /diagnostics.
    dropped : int
        By the recorder's own account in the file.
    fed : int
        Readings that the engine has judged, whatever it said of them.
    """

    sent: int
    recorded: int
    repeated: int
    disordered: int
    missing: int
    received: int
    lost: int
    missed_at_start: int
    irregular: int
    unreadable: int
    dropped: int
    fed: int

    @property
    def gone(self) -> int:
        """Return what the monitor says it did not get."""
        return self.lost + self.missed_at_start

    def faults(self, topic: str, slack: int = 0) -> list[str]:
        """Return what does not add up; so many may be unaccounted for."""
        equations = (
            ('sent', self.sent, 'recorded + dropped + lost', self.kept + self.gone, slack),
            ('received', self.received, 'recorded + dropped', self.kept, 0),
            ('received', self.received, 'fed + unreadable', self.fed + self.unreadable, 0),
            ('missing in the file', self.missing, 'dropped + lost', self.dropped + self.gone,
             slack),
            ('recorded twice', self.repeated, 'none', 0, 0),
            ('recorded out of order', self.disordered, 'none', 0, 0),
        )  # fmt: skip
        return [
            f'{topic}: {left} is {a}, and {right} is {b}'
            for left, a, right, b, most in equations
            if abs(a - b) > most
        ]

    @property
    def kept(self) -> int:
        """Return what the recorder was given."""
        return self.recorded + self.dropped


def fed(ears: Ears, topic: str) -> int:
    """Return how many readings of a signal the engine has judged; late ones are accepted too."""
    kinds = (reason.replace('_', ' ') for reason in REASONS if reason != 'late')
    return sum(ears.number(f'input {topic}', f'Readings {kind} in all runs') for kind in kinds)


def account(
    ears: Ears,
    recordings: Path,
    streams: list[Stream],
    sent: Mapping[str, int],
    fed_before: Mapping[str, int],
) -> dict[str, Account]:
    """Count a run that is over.

    Parameters
    ----------
    ears : Ears
        With the last health of the monitor.
    recordings : Path
    streams : list of Stream
    sent, fed_before : mapping of str to int
        By topic: messages of the sender, and what the engine had judged before.
    """
    (folder,) = (p for p in recordings.iterdir() if p.is_dir())
    log = open_log(folder)
    counters = log.metadata.get('valveflow_recorder', {})
    found = {}
    for stream in streams:
        topic = f'/{stream.topic}'
        data = b''.join(m.data[_VALUE_AT:] for m in log.iter_messages([topic]))
        numbers = stream.numbers(np.frombuffer(data, '<f8'))
        different = len(np.unique(numbers))
        item = f'input {stream.topic}'
        found[stream.topic] = Account(
            sent=sent[stream.topic],
            recorded=len(numbers),
            repeated=len(numbers) - different,
            disordered=int(np.sum(np.diff(numbers) < 0)),
            missing=sent[stream.topic] - different,
            received=ears.number(item, 'Messages received'),
            lost=ears.number(item, 'Messages lost on the way'),
            missed_at_start=ears.number(item, 'Messages sent before the first received'),
            irregular=ears.number(item, 'Messages with irregular numbers'),
            unreadable=ears.number(item, 'Messages that cannot be read')
            + ears.number(item, 'Messages without a time'),
            dropped=int(counters.get(f'dropped {topic}', 0)),
            fed=fed(ears, stream.topic) - fed_before[stream.topic],
        )
    return found
