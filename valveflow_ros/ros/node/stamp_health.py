"""How the stamps of the inputs stand against the rows and against this machine's clock."""

from __future__ import annotations

from collections.abc import Iterable

from valveflow_ros.records import NS_PER_S, SIGNALS
from valveflow_ros.report.numbers import duration
from valveflow_ros.ros.inputs import Row

_NONE = -(2**63)


class StampHealth:
    """Remembers the stamps of each signal from one look to the next.

    Parameters
    ----------
    clock_jump_s : float
        By how much a stamp may be off.
    by_host : bool
        Whether this machine's clock tells the time of the plant; false with a /clock.
    """

    def __init__(self, clock_jump_s: float, by_host: bool = True) -> None:
        self._jump_ns = round(clock_jump_s * NS_PER_S)
        self._by_host = by_host
        # By the signals' numbers: this is done for every message.
        self._last_ns = [0] * len(SIGNALS)
        self._lead_ns = [_NONE] * len(SIGNALS)

    def note(self, rows: Iterable[Row], host_ns: int) -> None:
        """Take the readings of a message and what this machine's clock shows."""
        for time_ns, number, _, _ in rows:
            self._last_ns[number] = time_ns
            lead_ns = time_ns - host_ns
            if lead_ns > self._lead_ns[number]:
                self._lead_ns[number] = lead_ns

    def look(self, number: int) -> tuple[str, str]:
        """Return what is wrong with the stamps since the last look, and what is only odd.

        A stamp that is behind may be that of a recording which is played; none can be ahead.
        Both are empty where this machine's clock agrees.
        """
        lead_ns, self._lead_ns[number] = self._lead_ns[number], _NONE
        if not self._by_host or lead_ns == _NONE or abs(lead_ns) <= self._jump_ns:
            return '', ''
        if lead_ns < 0:
            off = duration(-lead_ns / NS_PER_S)
            return '', f"stamps are {off} behind this machine's clock"
        most = duration(lead_ns / NS_PER_S)
        return (
            f"Stamps are up to {most} ahead of this machine's clock; set both by one server.",
            '',
        )

    def far(self, number: int, newest_ns: int) -> str:
        """Return how far the last stamp is from the newest that counts; empty if it is near."""
        off_ns = self._last_ns[number] - newest_ns
        if abs(off_ns) <= self._jump_ns:
            return ''
        off = duration(abs(off_ns) / NS_PER_S)
        if off_ns > 0:
            return f'The last stamp is {off} ahead of the newest one used.'
        return f'The last stamp is {off} behind the newest one used.'
