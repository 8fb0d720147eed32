# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How long the parts of the long verbs take, which is what a progress bar's pace is made of.

    python -m benchmarks.pace [--days DAYS]

Prints for each verb where its parts begin, as shares of its time: the numbers of
``valveflow_ros/cli/command.py``.
"""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
import time
from unittest import mock

from benchmarks import study
from valveflow_ros.cli import command, main

VERBS = {'identify': (), 'diagnose': (), 'validate': ('--model', 'identify'), 'compare': ()}


def parts(words: list[str]) -> list[tuple[float, float, str]]:
    """Run a verb; return when each of its parts began, the share it told, and its name."""
    begun = time.perf_counter()
    seen: list[tuple[float, float, str]] = []

    def note(_console: object, share: float, what: str) -> None:
        if not seen or seen[-1][2] != what:
            seen.append((time.perf_counter() - begun, share, what))

    with (
        mock.patch.object(command.Console, '__call__', note),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        status = main.main(words)
    if status:
        raise SystemExit(f'{words} ended with {status}')
    return [*seen, (time.perf_counter() - begun, 1.0, 'end')]


if __name__ == '__main__':
    days = study.options(__doc__, days=3.0).parse_args().days
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        main.main(['simulate', '--days', str(days), '--seed', '5', '-o', 'log.mcap', '--quiet'])
        for verb, more in VERBS.items():
            found = parts([verb, 'log.mcap', '-o', verb, *more])
            total = found[-1][0]
            print(f'{verb}, {days:g} days: {total:.1f} s')
            for seconds, share, what in found:
                print(f'  {seconds / total:5.3f}  told {share:5.3f}  {what}')
