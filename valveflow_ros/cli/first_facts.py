"""What a large recording says of itself, before it is read."""

from __future__ import annotations

from pathlib import Path

from valveflow_ros.errors import RecordingError

_LARGE_BYTES = 20_000_000  # less than this is read before anybody has to wait


def first_facts(path: Path) -> str:
    """Return a sentence from the summary of a large finished recording, else nothing."""
    from valveflow_ros.logs.mcap.records import read_summary
    from valveflow_ros.logs.source import Source
    from valveflow_ros.report.words import count, duration, moment

    if path.suffix.lower() != '.mcap':
        return ''
    try:
        with Source.open(path) as source:
            summary = read_summary(source) if source.size >= _LARGE_BYTES else None
    except RecordingError:
        # Whoever reads the file will say what is wrong with it.
        return ''
    if summary is None or not summary.messages:
        return ''
    length = duration((summary.end_ns - summary.start_ns) / 1e9)
    topics = sorted(c.topic for n, c in summary.table.channels.items() if summary.counts.get(n))
    return (
        f'{path}: {count(summary.messages)} messages in {length} from {moment(summary.start_ns)}, '
        f'on {", ".join(topics)}. Every value is now looked at.'
    )
