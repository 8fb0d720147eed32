"""Says in sentences what a scan met."""

from __future__ import annotations

from valveflow_ros.errors import counted
from valveflow_ros.logs.mcap.scan import Findings


def scan_warnings(findings: Findings, what: str) -> tuple[str, ...]:
    """Return one sentence for each thing a reader of the file should know; none if all is well."""
    sentences = []
    if findings.cut_off_at is not None:
        sentences.append(
            f'The {what} was not finished and ends at byte {findings.cut_off_at}; '
            'everything before it was read.'
        )
    elif not findings.finished:
        sentences.append(f'The {what} was not finished; all of its chunks were read.')
    if findings.damaged:
        places = 'place' if findings.damaged == 1 else 'places'
        sentences.append(
            f'The {what} is damaged in {findings.damaged} {places}, what stood there was left out '
            f'({"; ".join(findings.reasons)}).'
        )
    if findings.over_budget:
        sentences.append(
            f'The {what} unpacks to far more than its size justifies; the rest of it was not read.'
        )
    if findings.unchecked:
        sentences.append(
            f'{counted(findings.unchecked, "chunk")} of the {what} '
            f'{"was" if findings.unchecked == 1 else "were"} written without a checksum, '
            'so damage in it cannot be seen.'
        )
    return tuple(sentences)
