# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Assigns topics and columns to signals by name."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

import numpy as np

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.records import SIGNALS, ByteArray, Quality, Signal

FLOAT64 = 'std_msgs/msg/Float64'
PLANT_SAMPLE = 'valveflow_msgs/msg/PlantSample'
PLANT_SAMPLE_TOPIC = 'plant_sample'
# The attachment in which a monitor names its topics: {"inputs": {name of the input: topic}, ...}.
TOPICS = 'topics.json'
# Quality codes 0 to 3 of a PlantSample; 0 means that the sender did not set the code.
_CODES = (Quality.BAD, Quality.GOOD, Quality.UNCERTAIN, Quality.BAD)
# Codes 0 to 2 in older recordings, which had no code for an unset quality.
_EARLIER = (Quality.GOOD, Quality.UNCERTAIN, Quality.BAD)
_EARLIER_GOOD = re.compile(r'QUALITY_GOOD\s*=\s*0\b')

_BY_NAME = {info.topic: info.signal for info in SIGNALS} | {
    info.column: info.signal for info in SIGNALS
}
_TOPICS = {info.topic for info in SIGNALS}


def signal_of(name: str) -> Signal:
    """Return the signal of a contract name, written as topic or as column.

    Raises `InputError` if there is no such name.
    """
    if name not in _BY_NAME:
        known = ', '.join(info.column for info in SIGNALS)
        raise InputError(f"There is no signal '{name}'; there are {known}.")
    return _BY_NAME[name]


def last_part(topic: str) -> str:
    """Return the part of a topic after its last slash."""
    return topic.rsplit('/', 1)[-1]


def told_inputs(attachments: Mapping[str, bytes]) -> dict[str, str]:
    """Return the topic of each input that the monitor of a recording names, by input name.

    It is empty for other recordings. A covariate is an input too.
    """
    try:
        told = json.loads(attachments[TOPICS])['inputs'].items()
    except (KeyError, ValueError, TypeError, AttributeError):
        return {}
    return {name: str(topic) for name, topic in told}


def is_input(name: str) -> bool:
    """Return True for the topic name of a signal or of a PlantSample."""
    return name in _TOPICS or name == PLANT_SAMPLE_TOPIC


def has_earlier_codes(definition: str) -> bool:
    """Return True if code 0 means a good value in this ros2msg text of a PlantSample."""
    return _EARLIER_GOOD.search(definition) is not None


def qualities(definition: str = '') -> ByteArray:
    """Return the `Quality` of each quality code of a PlantSample, shape (256,).

    ``definition`` is the ros2msg text in the recording; empty for the current definition.
    """
    # Unknown codes count as bad.
    found = np.full(256, int(Quality.BAD), dtype=np.uint8)
    codes = _EARLIER if has_earlier_codes(definition) else _CODES
    found[: len(codes)] = codes
    return found


class TopicChoice:
    """Selects the topics of a recording that are read as inputs.

    ``wanted`` gives the topic to use for a contract name (or ``plant_sample``). Raises
    `InputError` if a contract name is unknown.
    """

    def __init__(self, wanted: Mapping[str, str]) -> None:
        by_name = dict(wanted)
        self._wanted_topics = {_rooted(topic) for topic in by_name.values()}
        self._stamped = by_name.pop(PLANT_SAMPLE_TOPIC, None)
        self._wanted = {signal_of(name): topic for name, topic in by_name.items()}

    def may_matter(self, topic: str, type_name: str) -> bool:
        """Return True if `signals` or `plant_sample` may select the topic."""
        names = {FLOAT64: _TOPICS, PLANT_SAMPLE: {PLANT_SAMPLE_TOPIC}}.get(type_name)
        if names is None:
            return False
        return last_part(topic) in names or _rooted(topic) in self._wanted_topics

    def signals(self, types: Mapping[str, str], path: str) -> dict[str, Signal]:
        """Return the Float64 topics to read and the signal of each.

        ``types`` gives the type of every topic of the recording, ``path`` is for error messages.
        Raises `InputError` if several topics match a signal, or a wanted topic is missing. Raises
        `RecordingError` if a wanted topic is of another type.
        """
        chosen: dict[str, Signal] = {}
        for info in SIGNALS:
            wanted = self._wanted.get(info.signal)
            if wanted is not None:
                chosen[_present(wanted, info.topic, FLOAT64, types, path)] = info.signal
            elif (topic := _only(info.topic, FLOAT64, types, path)) is not None:
                chosen.setdefault(topic, info.signal)
        return chosen

    def plant_sample(self, types: Mapping[str, str], path: str) -> str | None:
        """Return the topic of PlantSample messages, None if absent; raises like `signals`."""
        if self._stamped is not None:
            return _present(self._stamped, PLANT_SAMPLE_TOPIC, PLANT_SAMPLE, types, path)
        return _only(PLANT_SAMPLE_TOPIC, PLANT_SAMPLE, types, path)


def misfits(types: Mapping[str, str]) -> list[str]:
    """Return a clause for each topic that has the name of an input but not its type."""
    return [
        f"the topic '{topic}' is of type {type_name or 'unknown'} where {FLOAT64} is needed"
        for topic, type_name in types.items()
        if last_part(topic) in _TOPICS and type_name != FLOAT64
    ]


def _only(name: str, type_name: str, types: Mapping[str, str], path: str) -> str | None:
    found = [t for t, kind in types.items() if kind == type_name and last_part(t) == name]
    if len(found) > 1:
        both = ' and '.join(f"'{topic}'" for topic in found)
        raise InputError(
            f'{path}: the topics {both} could each be {name}; '
            f'choose with --column {name}={found[0]}.'
        )
    return found[0] if found else None


def _present(wanted: str, name: str, type_name: str, types: Mapping[str, str], path: str) -> str:
    for topic in (wanted, _rooted(wanted)):
        if topic not in types:
            continue
        if types[topic] != type_name:
            problem = f"the topic '{topic}' is of type {types[topic]} where {type_name} is needed"
            raise RecordingError(path, problem)
        return topic
    have = ', '.join(sorted(types)) or 'none'
    raise InputError(
        f"{path}: there is no topic '{wanted}' for {name}; the topics are: {have}. "
        f'Choose with --column {name}=TOPIC.'
    )


def _rooted(topic: str) -> str:
    return topic if topic.startswith('/') else f'/{topic}'
