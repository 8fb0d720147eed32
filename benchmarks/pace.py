# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How long the parts of the long verbs take, which is what a progress bar's pace is made of.

    python -m benchmarks.pace [DAYS]

Prints for each verb where its parts begin, as shares of its time: the numbers of
``valveflow_ros/cli/command.py``.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import time
from pathlib import Path

from valveflow_ros.cli import command, main

VERBS = ('identify', 'diagnose', 'validate', 'compare')


def parts(words: list[str]) -> list[tuple[float, float, str]]:
    """Run a verb; return when each of its parts began, the share it told, and its name."""
    begun = time.perf_counter()
    seen: list[tuple[float, float, str]] = []

    def note(_console: object, share: float, what: str) -> None:
        if not seen or seen[-1][2] != what:
            seen.append((time.perf_counter() - begun, share, what))

    usual = command.Console.__call__
    command.Console.__call__ = note  # type: ignore[method-assign, assignment]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            status = main.main(words)
    finally:
        command.Console.__call__ = usual  # type: ignore[method-assign]
    if status:
        raise SystemExit(f'{words} ended with {status}')
    seen.append((time.perf_counter() - begun, 1.0, 'end'))
    return seen


def run(days: float, folder: Path) -> None:
    """Measure every verb on a simulated log."""
    log = str(folder / 'plant.mcap')
    main.main(['simulate', '--days', str(days), '--seed', '5', '-o', log, '--quiet'])
    for verb in VERBS:
        out = str(folder / verb)
        more = ['--model', str(folder / 'identify')] if verb == 'validate' else []
        found = parts([verb, log, '-o', out, *more])
        total = found[-1][0]
        print(f'{verb}, {days:g} days: {total:.1f} s')
        for seconds, share, what in found:
            print(f'  {seconds / total:5.3f}  told {share:5.3f}  {what}')


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as place:
        run(float(sys.argv[1]) if len(sys.argv) > 1 else 3.0, Path(place))
