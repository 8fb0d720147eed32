"""Read logs for verbs that hold a model against data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from valveflow_ros.cli import engine
from valveflow_ros.cli.console import Console
from valveflow_ros.cli.first_run import SENTENCE, is_first_run
from valveflow_ros.cli.log_input import LogInput, open_input, steps_of
from valveflow_ros.cli.options import LogMapping as Columns
from valveflow_ros.cli.options import settings_for
from valveflow_ros.diagnosis.corrector import corrector_of
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.errors import DataError
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, Readings
from valveflow_ros.segments.window import WindowContents

LEARN_SHARE = 2.0 / 3.0


@dataclass(frozen=True, slots=True)
class Seen:
    """A log, or a part of one, after the engine saw it.

    Attributes
    ----------
    source : str
        Its name.
    settings : Settings
    watched : engine.Watched
    notes : tuple of str
        Sentences about how it was read.
    """

    source: str
    settings: Settings
    watched: engine.Watched
    notes: tuple[str, ...]

    @property
    def contents(self) -> WindowContents:
        """Return rows and special segments."""
        return self.watched.task.contents


def read(path: Path, columns: Columns, console: Console) -> LogInput:
    """Open a log; raises like `open_input`."""
    log = open_input(path, columns, console)
    if not len(log.readings):
        raise DataError(f'{path}: there is not one reading in it.')
    return log


def see(
    log: LogInput, source: str, given: Mapping[str, Any], console: Console,
    progress: Callable[[float, str], None], extended: ExtendedModel | None = None,
) -> Seen:  # fmt: skip
    """Run the engine over a log and find its special segments.

    With an ``extended`` model the rows are freed of its causes.

    Raises
    ------
    DataError
        There are none; the sentence says what is missing.
    """
    times = log.readings.time_ns
    span_s = float(times.max() - times.min()) / 1e9
    settings, notes = settings_for(steps_of(log.readings), span_s, given)
    for sentence in notes:
        console.say(sentence)
    if is_first_run():
        console.say(SENTENCE)
    step_s = settings.real('sample_period')
    corrector = None if extended is None else corrector_of(extended, step_s)
    try:
        watched = engine.watch(log.readings, settings, progress, corrector)
    except DataError as error:
        raise DataError(f'{source}: {error}') from None
    told = (*log.contents.warnings, *(d.sentence for d in log.doubts), *notes)
    if watched.clock_resets:
        back = f'{source}: the clock went back; where it stayed, what it had passed is out.'
        console.warn(back)
        told = (*told, back)
    return Seen(source, settings, watched, told)


def cut_in_two(log: LogInput, block_s: float) -> tuple[LogInput, LogInput]:
    """Return the first two thirds of a log and the last, cut at the border of a block.

    Parameters
    ----------
    log : LogInput
    block_s : float
        Length of the segmenter's blocks.
    """
    times = log.readings.time_ns
    first, last = int(times.min()), int(times.max())
    block = max(1, round(block_s * NS_PER_S))
    cut = first + int(LEARN_SHARE * (last - first)) // block * block
    early = times < cut
    return _only(log, early), _only(log, ~early)


def _only(log: LogInput, mask: Any) -> LogInput:
    r = log.readings
    part = Readings(r.time_ns[mask], r.signal[mask], r.value[mask], r.quality[mask])
    return replace(log, readings=part)
