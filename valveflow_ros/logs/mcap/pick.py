"""Takes out of followed batches what a view needs: the last messages, and the readings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.cdr import Decoder
from valveflow_ros.logs.mcap.follow import Batch
from valveflow_ros.logs.mcap.found import Rows, float_rows, sample_rows
from valveflow_ros.logs.mcap.layout import LayoutError
from valveflow_ros.logs.mcap.plant_sample import PlantSampleReader
from valveflow_ros.logs.names import FLOAT64, PLANT_SAMPLE, last_part, signal_of
from valveflow_ros.records import SIGNALS, Signal

_INPUTS = {info.topic for info in SIGNALS}


class Raw(NamedTuple):
    """A message before it is decoded; most are never looked at."""

    decoder: Decoder
    data: bytes

    @property
    def type(self) -> str:
        """Return the name of its type."""
        return self.decoder.type_name


class Picker:
    """Decodes messages by the definitions that stand in the recording.

    Attributes
    ----------
    misfits : int
        Messages that did not fit their own definition.
    """

    def __init__(self) -> None:
        self.misfits = 0
        self._decoders: dict[tuple[str, str], Decoder | None] = {}
        self._readers: dict[str, PlantSampleReader | None] = {}

    def last(self, batch: Batch, wanted: dict[str, int]) -> Iterator[Raw]:
        """Yield messages, not decoded yet, in the order of the file.

        Parameters
        ----------
        batch : Batch
        wanted : dict of str to int
            The types, and how many messages of each topic are enough.
        """
        picked: list[tuple[int, Decoder]] = []
        for channel, type_name, definition in _channels(batch):
            if type_name not in wanted:
                continue
            decoder = self._decoder(type_name, definition)
            mine = np.flatnonzero(batch.messages.channel == channel)[-wanted[type_name] :]
            if decoder is not None:
                picked += [(row, decoder) for row in mine.tolist()]
        for row, decoder in sorted(picked, key=lambda item: item[0]):
            yield Raw(decoder, batch.messages.payload(batch.content, row))

    def fields(self, raw: Raw) -> dict[str, Any] | None:
        """Decode a message; None, and counted, where it does not fit its definition."""
        try:
            return raw.decoder.decode(raw.data)
        except RecordingError:
            self.misfits += 1
            return None

    def readings(self, batch: Batch) -> Iterator[tuple[Signal, str, Rows]]:
        """Yield the readings of the inputs: the signal, its topic, its rows in their order."""
        messages = batch.messages
        for channel, type_name, definition in _channels(batch):
            topic = batch.topics.channels[channel].topic
            mine = np.flatnonzero(messages.channel == channel)
            if type_name == FLOAT64 and last_part(topic) in _INPUTS:
                (_, found), wrong = float_rows(batch.content, messages, mine)
                self.misfits += len(wrong)
                yield signal_of(last_part(topic)), topic, found
            elif type_name == PLANT_SAMPLE and (reader := self._reader(definition)) is not None:
                samples = reader.read(batch.content, messages, mine)
                self.misfits += int((~samples.good).sum())
                _, found = sample_rows(messages, mine, samples)
                for number in np.unique(found.signal).tolist():
                    keep = found.signal == number
                    columns = (getattr(found, name)[keep] for name in Rows.__dataclass_fields__)
                    yield Signal(number), topic, Rows(*columns)

    def _decoder(self, type_name: str, definition: str) -> Decoder | None:
        key = type_name, definition
        if key not in self._decoders:
            try:
                self._decoders[key] = Decoder(type_name, definition)
            except RecordingError:
                self._decoders[key] = None
        return self._decoders[key]

    def _reader(self, definition: str) -> PlantSampleReader | None:
        if definition not in self._readers:
            try:
                self._readers[definition] = PlantSampleReader(definition)
            except LayoutError:
                self._readers[definition] = None
        return self._readers[definition]


def _channels(batch: Batch) -> Iterator[tuple[int, str, str]]:
    """Yield the channels that occur and are known: id, type, definition."""
    for number in np.unique(batch.messages.channel).tolist():
        channel = batch.topics.channels.get(number)
        if channel is not None and channel.encoding == 'cdr':
            definition = batch.topics.definition_of(channel)
            yield number, batch.topics.type_of(channel), definition
