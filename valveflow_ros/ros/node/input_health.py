"""How the inputs are: an item for each signal, with the numbers behind the sentence."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SIGNALS, SignalInfo
from valveflow_ros.report.words import duration
from valveflow_ros.ros.diagnostics import Item, Level
from valveflow_ros.ros.inputs import PLANT_SAMPLE, Row, plausible_range, plausible_units
from valveflow_ros.ros.node.intake import Tally
from valveflow_ros.signals.align import REASONS
from valveflow_ros.signals.units import unit_of

# How the stamps of the inputs stand against the rows and against this machine's clock.


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


# Who publishes an input, seen in the ROS graph: a wrong type makes no noise of its own.


@dataclass(frozen=True, slots=True)
class Publishers:
    """The publishers of one topic.

    Attributes
    ----------
    right : int
        Publishers of the type we listen for.
    wrong_types : tuple of str
        Other types somebody publishes on the same topic.
    best_effort : bool
        Whether one of the right ones offers best effort only.
    """

    right: int = 0
    wrong_types: tuple[str, ...] = ()
    best_effort: bool = False


def publishers(node: Node, topics: Mapping[str, tuple[str, str]]) -> dict[str, Publishers]:
    """Look the publishers of some topics up.

    Parameters
    ----------
    topics : mapping
        Name to (full topic name, type we listen for).
    """
    return {
        name: _publishers(node, topic, type_name) for name, (topic, type_name) in topics.items()
    }


def _publishers(node: Node, topic: str, type_name: str) -> Publishers:
    found = node.get_publishers_info_by_topic(topic)
    right = [info for info in found if info.topic_type == type_name]
    wrong = sorted({info.topic_type for info in found} - {type_name})
    weak = ReliabilityPolicy.BEST_EFFORT
    return Publishers(
        len(right), tuple(wrong), any(info.qos_profile.reliability == weak for info in right)
    )


_REJECTED = tuple(reason for reason in REASONS if reason not in ('accepted', 'late'))
_PATIENCE_S = 5.0
# Rejected for so long, an input is as good as silent.
_BLIND_S = 10.0


@dataclass(slots=True)
class InputHealth:
    """Judges the inputs, from one look to the next.

    Attributes
    ----------
    topics : mapping of str to str
        Contract name to full topic name.
    mismatched : set of str
        Contract names on which a publisher's quality of service did not match.
    by_host : bool
        Whether this machine's clock tells the time of the plant; false with a /clock.
    """

    settings: Settings
    topics: Mapping[str, str]
    mismatched: set[str] = field(default_factory=set)
    by_host: bool = True
    _impossible: dict[str, tuple[str, float]] = field(default_factory=dict)
    _ranges: list[tuple[float, float]] = field(default_factory=list)
    _rejected: dict[str, int] = field(default_factory=dict)
    _lost: dict[str, int] = field(default_factory=dict)
    _usable: dict[str, tuple[int, float]] = field(default_factory=dict)
    _outliers: dict[str, int] = field(default_factory=dict)
    _stamps: StampHealth = field(init=False)
    _newest_ns: int = 0

    def __post_init__(self) -> None:
        """Look the ranges up once; they are not live."""
        self._ranges = [plausible_range(info.signal, self.settings) for info in SIGNALS]
        self._stamps = StampHealth(self.settings.real('clock_jump'), self.by_host)

    def note(self, name: str, rows: Sequence[Row]) -> None:
        """Remember the stamps, and the last impossible value of each signal, to name it."""
        self._stamps.note(rows, time.time_ns())
        for _, number, value, _ in rows:
            low, high = self._ranges[number]
            if not low <= value <= high and math.isfinite(value):
                self._impossible[SIGNALS[number].topic] = (name, value)

    def items(
        self,
        tallies: Mapping[str, Tally],
        counts: Mapping[str, Mapping[str, int]],
        publishers: Mapping[str, Publishers],
        now_s: float,
        listening_s: float,
        newest_ns: int = 0,
    ) -> list[Item]:
        """Return an item for each signal.

        Parameters
        ----------
        tallies : mapping
            By the contract's names of the topics.
        counts : mapping
            What became of the readings, by signal and reason.
        publishers : mapping
            What the graph says, by the contract's names of the topics.
        now_s, listening_s : float
            Time by a clock that never goes back, and for how long we have listened.
        newest_ns : int
            The newest stamp that is used.
        """
        self._newest_ns = newest_ns
        return [
            self._item(info, tallies, counts[info.topic], publishers, now_s, listening_s)
            for info in SIGNALS
        ]

    def _item(
        self,
        info: SignalInfo,
        tallies: Mapping[str, Tally],
        counts: Mapping[str, int],
        publishers: Mapping[str, Publishers],
        now_s: float,
        listening_s: float,
    ) -> Item:
        name = _speaking(info.topic, tallies, publishers)
        tally, seen = tallies[name], publishers.get(name, Publishers())
        level, sentence = self._judge(info, name, tally, seen, counts, now_s, listening_s)
        if level <= Level.WARN and info.required and self._twice(info.topic, publishers, tallies):
            both = f'{self.topics[info.topic]} and {self.topics[PLANT_SAMPLE]}'
            level = Level.WARN
            sentence = f'{both} are both published; their values are mixed. Stop one of them.'
        values: dict[str, object] = {
            'Topic': self.topics[name],
            'Actual frequency (Hz)': tally.rate_hz(),
            'Age of the newest message (s)': tally.age_s(now_s),
            'Publishers': seen.right,
            'Messages received': tally.received,
            'Messages lost on the way': tally.lost,
            'Messages sent before the first received': tally.missed_at_start,
            'Messages with irregular numbers': tally.irregular,
            'Messages that cannot be read': tally.malformed,
            'Messages without a time': tally.without_time,
            'Messages sent before the first /clock': tally.before_clock,
            'Messages that wait for the first /clock': tally.waiting,
        }
        values |= {f'Readings {reason.replace("_", " ")}': counts[reason] for reason in REASONS}
        return Item(f'input {info.topic}', level, sentence, values)

    def _judge(
        self,
        info: SignalInfo,
        name: str,
        tally: Tally,
        seen: Publishers,
        counts: Mapping[str, int],
        now_s: float,
        listening_s: float,
    ) -> tuple[Level, str]:
        topic = self.topics[name]
        rejected = self._new(self._rejected, info.topic, _rejected(counts))
        lost = self._new(self._lost, info.topic, tally.lost)
        ahead, behind = self._stamps.look(info.signal)
        if seen.wrong_types:
            kinds = ' and '.join(seen.wrong_types)
            return Level.ERROR, f'{topic} is published as {kinds}, which the monitor cannot take.'
        if tally.received == 0:
            return self._silent(info, name, seen, listening_s)
        if tally.stale(now_s):
            return Level.STALE, f'{topic} has been silent for {tally.age_s(now_s):.1f} s.'
        if seen.right > 1:
            return Level.WARN, (
                f'{topic} has {seen.right} publishers; their values are mixed. Stop all but one.'
            )
        if rejected:
            why = self._why(info, counts)
            blind_s = now_s - self._used(info.topic, counts['accepted'], now_s)
            if blind_s > _BLIND_S:
                return Level.ERROR, f'Nothing usable has come for {blind_s:.0f} s. {why}'
            return Level.WARN, f'{rejected} new readings were rejected. {why}'
        self._used(info.topic, counts['accepted'], now_s)
        if tally.without_time + tally.waiting == tally.received:
            return Level.ERROR, f'{topic} comes without a time; is /clock published?'
        if ahead:
            return Level.WARN, ahead
        if lost:
            return Level.WARN, f'{lost} messages of {topic} were lost on the way.'
        rate = _hertz(tally.rate_hz())
        return Level.OK, f'{rate}; {behind}.' if behind else f'{rate}.'

    def _silent(
        self, info: SignalInfo, name: str, seen: Publishers, listening_s: float
    ) -> tuple[Level, str]:
        topic = self.topics[name]
        if name in self.mismatched:
            return Level.ERROR, (
                f'{topic} is published as best effort and asked for as reliable, so nothing '
                'comes: set input_reliability to best_effort.'
            )
        if not info.required and not seen.right:
            return Level.OK, f'{topic} is not sent; it is optional.'
        if listening_s < _PATIENCE_S:
            return Level.OK, f'Waiting for {topic}.'
        if seen.right:
            return Level.STALE, f'{topic} has a publisher, but nothing has come from it yet.'
        return Level.STALE, f'Nobody publishes {topic}; remap it, or start the gateway.'

    def _why(self, info: SignalInfo, counts: Mapping[str, int]) -> str:
        found = self._impossible.pop(info.topic, None)
        if found is None:
            far = self._stamps.far(info.signal, self._newest_ns)
            if self._new(self._outliers, info.topic, counts['time_outlier']) and far:
                return far
            reasons = [f'{r.replace("_", " ")} {counts[r]}' for r in _REJECTED if counts[r]]
            return f'So far: {", ".join(reasons)}.'
        name, value = found
        low, high = plausible_range(info.signal, self.settings)
        believed = f'believed: {low:g} to {high:g} {info.unit}'
        if name == PLANT_SAMPLE:
            return f'The last one, {value:g} {info.unit}, is impossible ({believed}).'
        named = self.settings.text(f'{info.topic}_unit')
        unit = unit_of(info.signal, named)
        sent = (value - unit.offset) / unit.scale
        text = f'The last one, {sent:g} {named}, is impossible ({believed}).'
        fitting = [u for u in plausible_units(info.signal, self.settings, sent) if u != named]
        if fitting:
            text += f' Is {info.topic}_unit {" or ".join(fitting)} rather than {named}?'
        return text

    def _used(self, key: str, count: int, now_s: float) -> float:
        """Return when a reading was used last, as far as that is known."""
        before, since_s = self._usable.get(key, (-1, now_s))
        if count != before:
            since_s = now_s
        self._usable[key] = (count, since_s)
        return since_s

    @staticmethod
    def _twice(
        topic: str, publishers: Mapping[str, Publishers], tallies: Mapping[str, Tally]
    ) -> bool:
        """Tell whether a signal has come on its own topic and on the stamped one."""
        both = (topic, PLANT_SAMPLE)
        return all(publishers.get(n, Publishers()).right and tallies[n].received for n in both)

    @staticmethod
    def _new(before: dict[str, int], key: str, count: int) -> int:
        last, before[key] = before.get(key, 0), count
        return max(0, count - last)


def _speaking(
    topic: str, tallies: Mapping[str, Tally], publishers: Mapping[str, Publishers]
) -> str:
    """Return the topic that feeds a signal: the one heard last, or the one that somebody has."""
    own, stamped = tallies[topic].last_s, tallies[PLANT_SAMPLE].last_s
    if own is None and stamped is None:
        nobody = publishers.get(topic, Publishers()) == Publishers()
        somebody = publishers.get(PLANT_SAMPLE, Publishers()) != Publishers()
        return PLANT_SAMPLE if nobody and somebody else topic
    if stamped is not None and (own is None or stamped > own):
        return PLANT_SAMPLE
    return topic


def _rejected(counts: Mapping[str, int]) -> int:
    return sum(counts[reason] for reason in _REJECTED)


def _hertz(rate: float) -> str:
    return f'{rate:.0f} Hz' if rate >= 100.0 else f'{rate:.3g} Hz'
