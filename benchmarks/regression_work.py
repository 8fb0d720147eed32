# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is measured: the same small work for whichever tree Python finds first.

    python regression_work.py make FOLDER          make the inputs
    python regression_work.py FOLDER [NAME ...]    do the work, print the seconds of each as JSON

It uses only what earlier trees have, too.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

DAYS, SEED = 0.5, 11
MESSAGES = 30_000
REPEATS = 2
INPUT, LOG = 'table.npz', 'plant.mcap'


def make(folder: Path) -> None:
    """Write the inputs, so that both trees are given the same."""
    from valveflow_ros.logs import write_samples
    from valveflow_ros.plant.simulator import simulate

    table = simulate(DAYS, SEED).table
    np.savez(folder / INPUT, time_ns=table.time_ns, values=table.values, quality=table.quality)
    write_samples(table, folder / LOG)


class Work:
    """The pieces of work, each over inputs that stand ready."""

    def __init__(self, folder: Path) -> None:
        from valveflow_ros.logs import open_log
        from valveflow_ros.monitoring.events import FitRequested
        from valveflow_ros.monitoring.monitor import Monitor
        from valveflow_ros.parameters import Settings
        from valveflow_ros.records import SampleTable

        self.folder = folder
        with np.load(folder / INPUT) as kept:
            self.table = SampleTable(kept['time_ns'], kept['values'], kept['quality'])
        self.settings = Settings({'refit_segments': 0, 'refit_period': 0.0})
        self.readings = open_log(folder / LOG).readings
        monitor = Monitor(self.settings)
        monitor.feed(self.table)
        asked = monitor.request_fit()
        (self.task,) = (e.task for e in asked if isinstance(e, FitRequested))

    def rows(self) -> None:
        """Feed a day of rows to the engine, without a fit."""
        from valveflow_ros.monitoring.monitor import Monitor

        for _ in range(4):
            monitor, done = Monitor(self.settings), 0
            while done < len(self.table):
                done += monitor.feed(self.table.part(done, len(self.table))).rows

    def refit(self) -> None:
        """Fit the curve to a day."""
        from valveflow_ros.fit.fit import fit

        fit(self.task)

    def recorder(self) -> None:
        """Record messages, thread and disk included."""
        from valveflow_ros.logs import Recorder, RecorderSettings

        settings = RecorderSettings(free_floor_bytes=0, queue_limit=2 * MESSAGES)
        data = bytes(12)
        with tempfile.TemporaryDirectory(dir=self.folder) as place:
            recorder = Recorder(place, settings)
            for k in range(4):
                recorder.add_topic(f'/topic_{k}', 'std_msgs/msg/Float64')
            for k in range(MESSAGES):
                recorder.record(f'/topic_{k % 4}', data, k, k)
            if recorder.close(60.0).written != MESSAGES:
                raise SystemExit('not everything was recorded')

    def reader(self) -> None:
        """Read a day's recording."""
        from valveflow_ros.logs import open_log

        for _ in range(3):
            len(open_log(self.folder / LOG).readings)

    def aligner(self) -> None:
        """Put a day's readings into rows."""
        from valveflow_ros.signals.align import Aligner

        for _ in range(2):
            aligner = Aligner(self.settings)
            aligner.feed(self.readings)
            aligner.finish()


NAMES = ('rows', 'refit', 'recorder', 'reader', 'aligner')


def seconds(work: Callable[[], None]) -> float:
    """Return the processor's time of a work: the least of some, its kernels loaded."""
    work()
    found = []
    for _ in range(REPEATS):
        begun = time.process_time()
        work()
        found.append(time.process_time() - begun)
    return min(found)


def main() -> None:
    """Run it."""
    if sys.argv[1] == 'make':
        make(Path(sys.argv[2]))
        return
    work = Work(Path(sys.argv[1]))
    names = sys.argv[2:] or NAMES
    print(json.dumps({name: seconds(getattr(work, name)) for name in names}))


if __name__ == '__main__':
    main()
