# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a long run holds: memory, descriptors, threads, files; at its end as near its beginning."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.load.trial import Run

_EVERY_S = 60.0
_SHARED = Path('/dev/shm')
_HOUR_S = 3600.0


class Steadiness:
    """Look once a minute at what the monitor holds.

    Parameters
    ----------
    also : callable
        What else happens meanwhile.
    settled_s : float
        What is held before that is not judged: caches fill, the first files are opened.
    """

    def __init__(self, also: Callable[[Run, float], None], settled_s: float) -> None:
        self._also, self._settled_s = also, settled_s
        self._looks: list[tuple[float, ...]] = []
        self._next_s = 0.0

    def __call__(self, run: Run, at_s: float) -> None:
        """Do what is due."""
        self._also(run, at_s)
        if at_s < self._next_s:
            return
        self._next_s = at_s + _EVERY_S
        process = run.monitor.process
        with process.oneshot():
            held = (run.monitor.memory_mib(), process.num_fds(), process.num_threads())
        self._looks.append((at_s, *held, sum(1 for _ in _SHARED.iterdir())))
        looks = np.array(self._looks)
        looks = looks[looks[:, 0] >= self._settled_s]
        if len(looks) < 2:
            return
        hours = looks[:, 0] / _HOUR_S
        run.measured['memory_mib_per_hour'] = float(np.polyfit(hours, looks[:, 1], 1)[0])
        # The first third against the last: a descriptor that is open for a moment is no leak.
        third = max(1, len(looks) // 3)
        for name, column in (('descriptors', 2), ('threads', 3), ('shared_memory_files', 4)):
            least, now = looks[:third, column].min(), looks[-third:, column].min()
            run.measured[f'more_{name}'] = float(now - least)
        run.notes['looks'] = len(self._looks)
        run.notes['memory_mib_by_tenth'] = [
            round(float(part.mean()), 1) for part in np.array_split(looks[:, 1], 10) if len(part)
        ]
        run.notes['descriptors'], run.notes['threads'] = map(int, looks[-1, 2:4])
