"""Health items and the messages they become (REP 107)."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from valveflow_ros.ros.conversions import to_time


class Level(enum.IntEnum):
    """How well something is; the numbers of DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Item:
    """One line of the health: what, how well, a sentence, and the numbers behind it.

    The unit of a number stands in its key.
    """

    name: str
    level: Level
    sentence: str
    values: dict[str, object] = field(default_factory=dict)


def array(items: Iterable[Item], tag: str, now_ns: int) -> DiagnosticArray:
    """Return the message that says all items."""
    message = DiagnosticArray()
    message.header.stamp = to_time(now_ns)
    message.header.frame_id = tag
    message.status = [
        DiagnosticStatus(
            level=bytes([item.level]),
            name=f'valveflow: {tag} {item.name}',
            message=item.sentence,
            hardware_id=tag,
            values=[KeyValue(key=key, value=_text(value)) for key, value in item.values.items()],
        )
        for item in items
    ]
    return message


def _text(value: object) -> str:
    if value is None:
        return 'unknown'
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    return f'{value:.6g}' if isinstance(value, float) else str(value)


class Changes:
    """Picks the items worth a line in the log: those whose level has changed.

    Parameters
    ----------
    quiet_s : float
        An item that changes back and forth is heard no more often than this.
    """

    def __init__(self, quiet_s: float = 30.0) -> None:
        self._quiet_s = quiet_s
        self._levels: dict[str, Level] = {}
        self._said_s: dict[str, float] = {}

    def pick(self, items: Iterable[Item], now_s: float) -> list[Item]:
        """Return the items whose level differs from the last one said."""
        picked = []
        for item in items:
            before = self._levels.get(item.name, Level.OK)
            recent = now_s - self._said_s.get(item.name, -self._quiet_s) < self._quiet_s
            # A failure is told at once; that it went and came again is not, for that long.
            worse = item.level == Level.ERROR
            if item.level == before or (recent and not worse):
                continue
            self._levels[item.name] = item.level
            self._said_s[item.name] = now_s
            picked.append(item)
        return picked
