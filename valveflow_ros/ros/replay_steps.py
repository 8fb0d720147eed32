"""A log as steps to be played: recordings as the bytes that were received, tables as Float64."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator

from valveflow_ros.errors import DataError
from valveflow_ros.logs import LogContents
from valveflow_ros.records import SIGNALS
from valveflow_ros.ros.inputs import INPUT_BY_NAME, PLANT_SAMPLE, header_time_ns
from valveflow_ros.ros.node.recording import TOPICS
from valveflow_ros.ros.outputs import float64_bytes
from valveflow_ros.ros.playing import Step


def input_topics(log: LogContents) -> dict[str, str]:
    """Return the topics of a recording to play, each with the input it stands for.

    A recording of the monitor says itself which of its topics were inputs; in
    any other one they go by their names.
    """
    try:
        told = json.loads(log.attachments[TOPICS])['inputs']
        known = {str(topic): str(name) for name, topic in told.items() if name in INPUT_BY_NAME}
    except (KeyError, ValueError, TypeError, AttributeError):
        known = {topic: SIGNALS[signal].topic for signal, topic in log.signals.items()}
        for topic, info in log.topics.items():
            if info.type == INPUT_BY_NAME[PLANT_SAMPLE].type_name:
                known[topic] = PLANT_SAMPLE
    return {
        topic: name
        for topic, name in known.items()
        if topic in log.topics
        and log.topics[topic].count
        and log.topics[topic].type == INPUT_BY_NAME[name].type_name
    }


def steps_of(log: LogContents) -> tuple[list[str], Iterator[Step]]:
    """Return the inputs that will be published, and the steps.

    Raises
    ------
    DataError
        There is nothing to play.
    """
    if not log.topics:
        names = [SIGNALS[signal].topic for signal in sorted(log.signals)]
        messages = _table_messages(log)
    else:
        topics = input_topics(log)
        names = list(dict.fromkeys(topics.values()))
        messages = _recorded_messages(log, topics)
    if not names:
        raise DataError(f'{log.path}: there is nothing to play, no input of the monitor is in it.')
    return names, _in_steps(messages)


def _recorded_messages(
    log: LogContents, topics: dict[str, str]
) -> Iterator[tuple[int, str, bytes]]:
    for message in log.iter_messages(list(topics)):
        name = topics[message.topic]
        time_ns = message.publish_time_ns
        if name == PLANT_SAMPLE:
            time_ns = header_time_ns(message.data)
        yield time_ns, name, message.data


def _table_messages(log: LogContents) -> Iterator[tuple[int, str, bytes]]:
    readings = log.readings
    for time_ns, signal, value in zip(
        readings.time_ns.tolist(), readings.signal.tolist(), readings.value.tolist(), strict=True
    ):
        yield time_ns, SIGNALS[signal].topic, float64_bytes(value)


def _in_steps(messages: Iterable[tuple[int, str, bytes]]) -> Iterator[Step]:
    """Group messages that follow each other and belong to one instant."""
    step: Step | None = None
    for time_ns, name, data in messages:
        if step is None or step.time_ns != time_ns:
            if step is not None:
                yield step
            step = Step(time_ns, [])
        step.messages.append((name, data))
    if step is not None:
        yield step
