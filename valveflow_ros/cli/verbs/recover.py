# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow recover``: make a complete recording from the remains of a damaged one."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.command import Console, VerbResult, add_output

USAGE = 'BROKEN -o LOG [options]'
DESCRIPTION = """\
Repair a recording that a crash, a full disk or a bad sector has left: everything that is
intact is copied and gets a new index, what is damaged is left out and counted. Nothing is
guessed, and the broken file is not changed.

example:
  valveflow recover broken.mcap -o whole.mcap"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('broken', metavar='BROKEN', type=Path, help='an .mcap or .mcap.part file')
    add_output(parser, 'LOG', 'the whole .mcap file')


def run(options: Namespace, console: Console) -> VerbResult:
    """Recover the recording and report what was kept."""
    from valveflow_ros.interface.files import check_output
    from valveflow_ros.logs.mcap.recover import recover
    from valveflow_ros.report.words import count, counted

    check_output(options.output, ('.mcap',), source=options.broken)
    console(0.0, 'recovering')
    report = recover(
        options.broken, options.output,
        progress=lambda done, total: console(done / max(total, 1), 'recovering'),
    )  # fmt: skip
    for sentence in report.warnings:
        console.warn(sentence)
    lost = (
        f'{counted(report.damaged_chunks, "place")} damaged and left out'
        if report.damaged_chunks
        else f'no {"other " if report.warnings else ""}chunk is damaged'
    )
    text = (
        f'Kept {counted(report.messages, "message")} in {counted(report.chunks, "chunk")}; '
        f'{lost}. '
        'Index and summary were written anew.'
        f'\nRead {count(report.bytes_read)} bytes, wrote {count(report.bytes_written)} '
        f'to {report.out}.'
    )
    data = {
        'source': str(report.source),
        'log': str(report.out),
        'messages': report.messages,
        'messages_outside_of_chunks': report.bare_messages,
        'chunks': report.chunks,
        'damaged_chunks': report.damaged_chunks,
        'bytes_read': report.bytes_read,
        'bytes_written': report.bytes_written,
        'warnings': list(report.warnings),
    }
    return VerbResult(text, data)
