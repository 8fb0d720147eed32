# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is tried: steady rates, more than that, a stall, refits meanwhile, a flood, and hours."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil

from benchmarks.load.trial import REQUIRED, Case, Run

CASES = ('rates', 'headroom', 'stall', 'refit', 'flood')
# Takes hours, so it is run when it is asked for by name only.
SOAK = 'soak'
_REFIT_EVERY_S = 5.0
_SOAK_REFIT_S = 60.0
_FLOODED = 'valve_opening'
_CPU = {1.0: 3.0, 100.0: 6.0, 1000.0: 20.0}
_LOOK_S, _HOUR_S = 60.0, 3600.0
_SHARED = Path('/dev/shm')
_LATE = {'latency_p99_ms': 25.0, 'latency_max_ms': 100.0}


# Where the two qualities of service differ most; the others are run with both if there is time.
BOTH = ('headroom', 'stall')


def cases(name: str, full: bool, reliable: bool, hours: float) -> Iterator[Case]:
    """Yield the cases of a name; short ones unless ``full``, and the soak for so many hours."""
    if name == SOAK:
        yield _soak(hours, reliable)
        return
    makers = {'rates': _rates, 'headroom': _headroom, 'stall': _stall, 'refit': _refit,
              'flood': _flood}  # fmt: skip
    for case in makers[name](full):
        case.reliable = reliable
        yield case


def _even(rate_hz: float) -> dict[str, float]:
    return dict.fromkeys(REQUIRED, rate_hz)


def _rates(full: bool) -> Iterator[Case]:
    for rate_hz, percent in _CPU.items():
        yield Case(
            f'rates_{rate_hz:g}_hz', f'4 topics at {rate_hz:g} Hz, recorded, with refits',
            _even(rate_hz), 60.0 if full else 10.0, curve=True, meanwhile=_Refits(_REFIT_EVERY_S),
            limits={**_LATE, 'cpu_percent': percent},
        )  # fmt: skip


def _headroom(full: bool) -> Iterator[Case]:
    seconds = 30.0 if full else 8.0
    yield Case('headroom_2_khz', '4 topics at 2 kHz', _even(2000.0), seconds)
    yield Case(
        'headroom_8_khz', '4 topics at 8 kHz: lost or not, all is accounted for', _even(8000.0),
        seconds, lossless=(),
    )  # fmt: skip


def _stall(full: bool) -> Iterator[Case]:
    del full
    for stopped_s in (0.8, 3.0):
        yield Case(
            f'stall_{stopped_s:g}_s', f'the monitor is stopped for {stopped_s:g} s at 4 x 1 kHz',
            _even(1000.0), 5.0 + stopped_s, meanwhile=_Stop(2.0, stopped_s),
            slack=0 if stopped_s < 1.0 else 1,
            lossless=REQUIRED if stopped_s < 1.0 else (), needs_room=True,
        )  # fmt: skip


def _refit(full: bool) -> Iterator[Case]:
    for pinned in (False, True):
        yield Case(
            'refit_pinned' if pinned else 'refit',
            '4 x 1 kHz while the worker fits without a pause'
            + (', all on one core' if pinned else ''),
            _even(1000.0), 30.0 if full else 10.0, curve=True,
            meanwhile=_Refits(0.2, pinned=pinned), limits={'latency_p99_ms': 25.0},
        )  # fmt: skip


def _flood(full: bool) -> Iterator[Case]:
    others = tuple(topic for topic in REQUIRED if topic != _FLOODED)
    yield Case(
        'flood', f'50,000 messages a second on {_FLOODED}, 100 on the others, and an alarm',
        {**dict.fromkeys(others, 100.0), _FLOODED: 50_000.0}, 30.0 if full else 12.0, curve=True,
        parameters={'alarm_limit': 20.0, 'alarm_average': 1.0}, meanwhile=_hear_alarms,
        step_by=80.0, lossless=others, needs_room=True,
        limits={'memory_growth_mib': 20.0, 'alarm_s': 1.0},
    )  # fmt: skip


def _soak(hours: float, reliable: bool) -> Case:
    """One long run: what it holds at its end must be what it held after its first tenth."""
    return Case(
        SOAK, f'4 topics at 100 Hz for {hours:g} hours, recorded, with a state and refits',
        _even(100.0), 3600.0 * hours, curve=True, reliable=reliable,
        meanwhile=_Steadiness(_Refits(_SOAK_REFIT_S), 360.0 * hours),
        parameters={'keep_state': True},
        limits={
            'cpu_percent': 6.0, 'latency_p99_ms': 25.0, 'memory_mib': 250.0,
            'memory_mib_per_hour': 1.0, 'more_descriptors': 0.0, 'more_threads': 0.0,
            'more_shared_memory_files': 0.0,
        },
    )  # fmt: skip


class _Refits:
    """Ask for a fit every so often; count the processor time of the worker."""

    def __init__(self, every_s: float, pinned: bool = False) -> None:
        self._every_s, self._pinned = every_s, pinned
        self._next_s = 0.0
        self._used_s: float | None = None

    def __call__(self, run: Run, at_s: float) -> None:
        """Do what is due."""
        workers = run.monitor.workers()
        used_s = sum(sum(w.cpu_times()[:2]) for w in workers)
        if self._used_s is None:
            self._used_s = used_s
            if self._pinned:
                core = psutil.Process().cpu_affinity()[0]
                for process in (run.monitor.process, *workers):
                    _pin(process, core)
                run.notes['pinned_to_core'] = core
        run.notes['worker_s'] = round(used_s - self._used_s, 1)
        if at_s >= self._next_s:
            self._next_s = at_s + self._every_s
            run.ears.ask_for_refit()


def _pin(process: psutil.Process, core: int) -> None:
    """Keep every thread of a process on one core."""
    for thread in process.threads():
        psutil.Process(thread.id).cpu_affinity([core])


class _Stop:
    """Stop the monitor at a moment for a while, as a hanging machine would."""

    def __init__(self, at_s: float, for_s: float) -> None:
        self._at_s, self._for_s, self._stopped_s = at_s, for_s, -1.0
        self._over = False

    def __call__(self, run: Run, at_s: float) -> None:
        """Do what is due."""
        if self._stopped_s < 0.0 and at_s >= self._at_s:
            run.monitor.process.suspend()
            self._stopped_s = at_s
        elif not self._over and 0.0 <= self._stopped_s <= at_s - self._for_s:
            run.monitor.process.resume()
            self._over = True
            run.notes['stopped_s'] = round(at_s - self._stopped_s, 2)


def _hear_alarms(run: Run, _at_s: float) -> None:
    """Note the longest time from an alarm's row to its message."""
    for delay_s in run.ears.alarm_delays_s():
        run.notes['alarm_messages'] = run.notes.get('alarm_messages', 0) + 1
        run.measured['alarm_s'] = max(run.measured.get('alarm_s', 0.0), delay_s)


class _Steadiness:
    """Look once a minute at what the monitor holds.

    Before ``settled_s`` nothing is judged: caches fill, the first files are opened. ``also`` is
    what else happens meanwhile.
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
        self._next_s = at_s + _LOOK_S
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
