"""Reads a recording of one or several MCAP files into `LogContents`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from valveflow_ros.errors import RecordingError, counted
from valveflow_ros.logs.contents import LogContents, TopicInfo
from valveflow_ros.logs.limits import DEFAULT_LIMITS, Limits
from valveflow_ros.logs.mcap.found import FileContents, Rows
from valveflow_ros.logs.mcap.gather import gather
from valveflow_ros.logs.mcap.journal import Journal
from valveflow_ros.logs.mcap.scan import Findings
from valveflow_ros.logs.mcap.warnings import scan_warnings
from valveflow_ros.logs.names import PLANT_SAMPLE_TOPIC, TopicChoice, misfits
from valveflow_ros.logs.source import Source
from valveflow_ros.records import IntArray, Readings, Signal


def read_recording(
    paths: list[Path],
    name: str,
    columns: Mapping[str, str],
    unchecked: bool = False,
    limits: Limits = DEFAULT_LIMITS,
) -> LogContents:
    """Return what the files, in this order, hold together.

    Raises
    ------
    RecordingError
        If no message can be read.
    InputError
        If the choice of topics is not clear.
    """
    choice = TopicChoice(columns)
    files: list[FileContents] = []
    warnings: list[str] = []
    for path in paths:
        try:
            files.append(_read_file(path, choice, unchecked, limits))
        except RecordingError as error:
            if len(paths) == 1:
                raise
            warnings.append(str(error))
    if not files:
        raise RecordingError(name, f'none of its files can be read ({warnings[0]})')
    types = _types(files, name)
    chosen = choice.signals(types, name)
    stamped = choice.plant_sample(types, name)
    for file in files:
        what = 'file' if len(paths) == 1 else f'file {Path(file.path).name}'
        warnings += [*scan_warnings(file.findings, what), *_file_warnings(file, what)]
    warnings += _choice_warnings(types, chosen, stamped, name)
    found, told = _timed(_readings(files, chosen))
    return _contents(name, files, types, chosen, stamped, found, warnings + told, unchecked)


def _contents(
    name: str,
    files: list[FileContents],
    types: dict[str, str],
    chosen: dict[str, Signal],
    stamped: str | None,
    found: tuple[Readings, IntArray],
    warnings: list[str],
    unchecked: bool,
) -> LogContents:
    groups = [group for file in files for group in file.groups]
    signals = {signal: topic for topic, signal in chosen.items()}
    if stamped is not None:
        for number in np.unique(found[0].signal).tolist():
            signals.setdefault(Signal(number), stamped)
    attachments: dict[str, bytes] = {}
    metadata: dict[str, dict[str, str]] = {}
    for file in files:
        attachments |= {key: item.data for key, item in file.findings.attachments.items()}
        metadata |= file.findings.metadata
    return LogContents(
        name,
        *found,
        _topics(files, types, chosen),
        signals,
        tuple(warnings),
        attachments,
        metadata,
        min(group.first_ns for group in groups),
        max(group.last_ns for group in groups),
        sum(file.findings.damaged for file in files),
        Journal(files, unchecked),
    )


def _read_file(path: Path, choice: TopicChoice, unchecked: bool, limits: Limits) -> FileContents:
    with Source.open(path) as source:
        contents = gather(source, choice, limits, unchecked)
        if not contents.messages:
            raise RecordingError(path, _why_empty(contents.findings))
    return contents


def _why_empty(findings: Findings) -> str:
    if findings.unchecked:
        return (
            'was written without checksums, so damage in it could not be seen; '
            'record with checksums, or ask for it to be read unchecked'
        )
    if findings.over_budget:
        return 'unpacks to far more than its size justifies and was not read'
    if findings.bare_messages:
        return (
            'was written without chunks, so damage in it could not be seen; '
            "rewrite it with 'ros2 bag convert' to the preset zstd_small"
        )
    if not findings.begins_well and not findings.damaged:
        return 'is not an MCAP file'
    if findings.damaged:
        return f'holds no intact chunk of messages ({findings.reasons[0]})'
    if findings.cut_off_at is not None:
        return 'is cut off before its first message'
    return 'holds no messages'


def _types(files: list[FileContents], name: str) -> dict[str, str]:
    types: dict[str, str] = {}
    for file in files:
        for channel in file.table.channels.values():
            kind = file.table.type_of(channel)
            if types.setdefault(channel.topic, kind) != kind:
                both = f'{types[channel.topic]} and {kind}'
                raise RecordingError(name, f"its topic '{channel.topic}' has two types, {both}")
    return types


def _topics(
    files: list[FileContents], types: dict[str, str], chosen: dict[str, Signal]
) -> dict[str, TopicInfo]:
    counts = dict.fromkeys(types, 0)
    definitions = dict.fromkeys(types, '')
    hashes = dict.fromkeys(types, '')
    for file in files:
        for number, channel in file.table.channels.items():
            counts[channel.topic] += file.counts.get(number, 0)
            definitions[channel.topic] = file.table.definition_of(channel)
            hashes[channel.topic] = channel.metadata.get('topic_type_hash', '')
    return {
        topic: TopicInfo(
            topic, kind, counts[topic], chosen.get(topic), definitions[topic], hashes[topic]
        )
        for topic, kind in types.items()
    }


def _file_warnings(file: FileContents, what: str) -> list[str]:
    sentences = []
    if file.announced is not None and file.announced > file.messages:
        missing = file.announced - file.messages
        sentences.append(
            f'The {what} was written with {counted(file.announced, "message")}, '
            f'{missing} of them {"is" if missing == 1 else "are"} lost.'
        )
    if file.orphans:
        many = 'is on a topic' if file.orphans == 1 else 'are on topics'
        sentences.append(
            f'{counted(file.orphans, "message")} of the {what} {many} that it does not name any '
            'more.'
        )
    for channel, count in file.misfits.items():
        topic = file.table.channels[channel].topic
        fit = 'does not fit its type and was' if count == 1 else 'do not fit their type and were'
        sentences.append(f"{counted(count, 'message')} on '{topic}' {fit} left out.")
    return sentences


def _choice_warnings(
    types: dict[str, str], chosen: dict[str, Signal], stamped: str | None, name: str
) -> list[str]:
    wrong = misfits(types)
    if not chosen and stamped is None:
        if wrong:
            raise RecordingError(name, wrong[0])
        return [
            'None of its topics is an input of the monitor; '
            'name one with --column valve_opening=TOPIC.'
        ]
    sentences = [f'{clause[0].upper()}{clause[1:]}; it was left out.' for clause in wrong]
    if chosen and stamped is not None:
        both = ', '.join(f"'{topic}'" for topic in chosen)
        sentences.append(
            f"Values stand both in '{stamped}' ({PLANT_SAMPLE_TOPIC}) and in {both}; "
            'all of them were read.'
        )
    return sentences


def _timed(found: tuple[Readings, IntArray]) -> tuple[tuple[Readings, IntArray], list[str]]:
    """Leave out values that never got a time, which a monitor records and does not use either.

    Where none has one, whoever wrote the file gives none, and that is another matter.
    """
    readings, log_time = found
    if not len(readings) or readings.time_ns.min() > 0 or readings.time_ns.max() <= 0:
        return found, []
    timed = readings.time_ns > 0
    kept = Readings(
        readings.time_ns[timed], readings.signal[timed], readings.value[timed],
        readings.quality[timed],
    )  # fmt: skip
    lost = counted(len(readings) - len(kept), 'value')
    told = f'{lost} recorded without a time, as before the first /clock, left out.'
    return (kept, log_time[timed]), [told]


def _readings(files: list[FileContents], chosen: dict[str, Signal]) -> tuple[Readings, IntArray]:
    parts: list[tuple[Rows, np.ndarray[tuple[int], np.dtype[np.int8]]]] = []
    for file in files:
        lookup = np.full(1 << 16, -1, dtype=np.int8)
        for number, channel in file.table.channels.items():
            if channel.topic in chosen:
                lookup[number] = chosen[channel.topic]
        for rows in file.rows:
            signal = np.where(rows.signal >= 0, rows.signal, lookup[rows.channel])
            parts.append((rows, signal))
    if not parts:
        return Readings.of([]), np.empty(0, dtype=np.int64)
    signal = np.concatenate([signal for _, signal in parts])
    log_time = np.concatenate([rows.log_time for rows, _ in parts])
    keep = signal >= 0
    whole = bool(keep.all())
    # Almost always the order of the file is the order of the log times already.
    sorted_already = bool((log_time[1:] >= log_time[:-1]).all())
    order = (
        None
        if sorted_already
        else np.argsort(log_time if whole else log_time[keep], kind='stable')
    )
    columns = [
        np.concatenate([getattr(rows, field) for rows, _ in parts])
        for field in ('time_ns', 'value', 'quality')
    ]
    everything = (columns[0], signal, columns[1], columns[2], log_time)
    # Picking all of some million values takes as long as reading them.
    picked = [column if whole else column[keep] for column in everything]
    if order is not None:
        picked = [column[order] for column in picked]
    return Readings(*picked[:4]), picked[4]
