# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One task of a fleet: identify, diagnose and monitor one log of a unit."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros import __version__
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.curve.shift import Shift, ShiftLimits, judge_shift
from valveflow_ros.errors import DataError, RecordingError, ValveflowError
from valveflow_ros.interface.diagnose import DiagnosisResult, diagnose
from valveflow_ros.interface.files import reason, write_texts
from valveflow_ros.interface.fleets.unit_logs import UnitLog
from valveflow_ros.interface.identify import Identification, identify
from valveflow_ros.interface.logs import Log, open_log
from valveflow_ros.interface.models import load_characteristic
from valveflow_ros.interface.monitor import MonitorResult, monitor
from valveflow_ros.records import NS_PER_S, finite
from valveflow_ros.report.answer import explained
from valveflow_ros.report.data import rejected
from valveflow_ros.report.fleet import UNITS
from valveflow_ros.report.words import duration
from valveflow_ros.signals.units import in_unit

LIBRARIES = ('numpy', 'numba', 'scipy')
_ROW, _CURVE = 'row.json', 'characteristic.json'
_BLOCK = 1 << 20
DAY_NS = 86400 * NS_PER_S
Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class FleetTask:
    """The task that a worker receives."""

    of: UnitLog
    folder: Path  # the folder of results, which all workers must see
    # before, first: file names in ``folder`` of the previous log's curve and of the unit's first
    # curve, empty if there is none
    before: str
    first: str
    version: str = __version__  # version of the package that created the task

    @property
    def place(self) -> Path:
        """Return the folder of the task's results."""
        return self.folder / UNITS / self.of.unit / self.of.name


def unit_month(task: FleetTask) -> Row:
    """Do one task on a worker, unless it was done before and is unchanged; return its row.

    The verbs write into ``identify``, ``diagnose`` and ``monitor`` in the folder of the task.
    The row is written last, with the hash of all its inputs. No exception is raised: an error
    becomes a sentence of the row. The row is not kept after an error that may be temporary
    (full disk, no memory).
    """
    begun = time.perf_counter()
    try:
        if task.version != __version__:
            raise ValveflowError(
                f'The worker {platform.node()} has version {__version__} of valveflow and not '
                f'{task.version}; install the same version.'
            )
        if not task.folder.is_dir():
            raise RecordingError(
                task.folder,
                f'is not there on {platform.node()}; DIR and logs must be on a disk that all '
                'workers share',
            )
        key = key_of(task)
        kept = _kept(task.place / _ROW, key)
        if kept is not None:
            return {**kept, 'anew': False}
        for verb in ('identify', 'diagnose', 'monitor'):
            shutil.rmtree(task.place / verb, ignore_errors=True)
        row = _judged(task)
        row['task_s'] = time.perf_counter() - begun
        text = json.dumps(finite({'key': key, 'row': row}), allow_nan=False)
        write_texts(task.place, {_ROW: text + '\n'})
        # Return the same types as a row that was read from its file.
        return {**json.loads(text)['row'], 'anew': True}
    except ValveflowError as error:
        sentence = str(error)
    except MemoryError:
        sentence = 'There is not enough memory for this log on the worker.'
    except Exception as error:  # noqa: BLE001 - one log must not stop the others
        about = ' '.join(f'{type(error).__name__}: {error}'.split())[:200]
        sentence = f'This should not have happened ({about}); please report it.'
    return failed_row(task, sentence)


def failed_row(task: FleetTask, sentence: str) -> Row:
    """Return the row of a failed task; the next run tries the task again."""
    return {**_base(task), 'status': 'failed', 'sentences': [sentence], 'anew': True}


def _base(task: FleetTask) -> Row:
    versions = {'valveflow': __version__, 'python': platform.python_version()}
    versions |= {name: installed_version(name) for name in LIBRARIES}
    return {
        'unit': task.of.unit,
        'log': task.of.name,
        'source': str(task.of.log),
        'reference': task.before or None,
        'versions': versions,
    }


def key_of(task: FleetTask) -> str:
    """Return the hash of all inputs of a task."""
    found = hashlib.sha256(f'{__version__}\n{task.of.options.text}\n'.encode())
    curves = [task.folder / c for c in (task.before, task.first) if c]
    log = task.of.log
    inside = sorted(p for p in log.rglob('*') if p.is_file()) if log.is_dir() else [log]
    for path in [*curves, *inside]:
        try:
            with path.open('rb') as file:
                # The lengths ensure that two different sets of files never give the same bytes.
                found.update(f'{path.name} {os.fstat(file.fileno()).st_size}\n'.encode())
                while block := file.read(_BLOCK):
                    found.update(block)
        except OSError as error:
            raise RecordingError(path, f'cannot be opened ({reason(error)})') from None
    return found.hexdigest()


def _kept(path: Path, key: str) -> Row | None:
    """Return the row of an earlier run if its inputs were the same."""
    try:
        content = json.loads(path.read_text(encoding='utf-8'))
        return dict(content['row']) if content['key'] == key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _judged(task: FleetTask) -> Row:
    """Run the three verbs over a log and write their files; return the row."""
    of, row, sentences = task.of, _base(task), []
    begun = time.perf_counter()
    try:
        log = open_log(of.log, of.options.mapping)
        before = load_characteristic(task.folder / task.before) if task.before else None
        _check_order(log, before, task.before)
    except ValveflowError as error:
        return {**row, 'status': 'failed', 'sentences': [str(error)]}
    row['read_s'] = time.perf_counter() - begun
    given, zone = of.options.parameters, of.options.mapping.table.time_zone
    # With a curve without dynamics every ramp would look like a fault.
    model = before if before is not None and before.dynamics else None
    verbs: dict[str, tuple[Callable[[], Any], Callable[[Any], Row]]] = {
        'identify': (
            lambda: identify(log, parameters=given, reference=before),
            lambda found: _curve_facts(found, task),
        ),
        'diagnose': (lambda: diagnose(log, parameters=given, model=model), _diagnosis_facts),
        'monitor': (
            lambda: monitor(
                log, parameters=given, reference=before, diagnose=of.options.diagnosis
            ),
            _monitor_facts,
        ),
    }
    for verb, (call, facts) in verbs.items():
        begun = time.perf_counter()
        try:
            found = call()
        except ValveflowError as error:
            sentences.append(f'{verb}: {error}')
        else:
            found.write(task.place / verb, time_zone=zone)
            row |= facts(found)
        row[f'{verb}_s'] = time.perf_counter() - begun
    status = ('done', 'partly done', 'partly done', 'failed')[len(sentences)]
    return {**row, 'status': status, 'sentences': sentences}


def _check_order(log: Log, before: Characteristic | None, name: str) -> None:
    """Raise `DataError` if a log begins before the end of the log of its reference curve.

    The last row of a log may be the first row of the next.
    """
    if before is None or not len(log.readings):
        return
    begin_ns, source = int(log.readings.time_ns.min()), before.source
    earlier = Path(name).parent.parent.name
    if begin_ns < source.window_start_ns:
        raise DataError(
            f"The log begins before '{earlier}', which stands before it: name the logs of a unit "
            'in the order of time.'
        )
    if begin_ns < source.window_end_ns:
        raise DataError(
            f'The log begins {duration((source.window_end_ns - begin_ns) / 1e9)} before the end '
            f"of '{earlier}', which stands before it: cut one, so that no row counts twice."
        )


def _curve_facts(found: Identification, task: FleetTask) -> Row:
    c, data = found.characteristic, found.data
    content, times = to_json(c), data.table.time_ns
    first = load_characteristic(task.folder / task.first) if task.first else None
    row = {
        'start': int(times[0]),
        'end': int(times[-1]),
        'rows': len(times),
        'curve': f'{UNITS}/{task.of.unit}/{task.of.name}/identify/{_CURVE}',
        **{name: content[name] for name in (
            'model_id', 'output_unit', 'axis', 'pressure_exponent', 'pressure_scale_exponent',
            'offset_mw', 'reference_pressure_mpa', 'pieces', 'dynamics',
        )},
        'u': c.breakpoints.tolist(),
        'power_mw': c.values().tolist(),
        'breakpoint_low': [low for low, _ in c.breakpoint_intervals],
        'breakpoint_high': [high for _, high in c.breakpoint_intervals],
        'rmse_mw': c.residuals.rmse_mw,
        'explained': explained(data),
        **content['segments'],
        'temperature_flag': c.source.temperature_flag,
        'rejected': [{'reason': r, 'count': n} for r, n in rejected(data.counts).items()],
        'notes': [in_unit(n, c.output_unit) for n in found.notes],
        **_shift_facts('shift', data.shift, c.output_unit),
    }  # fmt: skip
    if first is None:
        return row
    settings = data.settings
    limits = ShiftLimits(settings.real('shift_confidence'), settings.real('shift_least'))
    try:
        # A compressed log dates nothing, as in `identify`.
        segments = () if found.log.compression else found.segments
        change = judge_shift(first, c, segments, limits)
    except DataError as error:
        row['notes'].append(f'Against the first curve of the unit: {error}')
        return row
    return {
        **row,
        **_shift_facts('change', change, c.output_unit),
        'change_mean_mw': _mean_difference(first, c),
    }


def _shift_facts(name: str, shift: Shift | None, unit: str) -> Row:
    if shift is None:
        return {}
    worst = shift.largest
    size = {'mw': 'shift_mw', 'u_from': 'u_from', 'u_to': 'u_to', 'p_value': 'p_value'}
    return {
        f'{name}_moved': shift.moved,
        **{f'{name}_{k}': worst and getattr(worst, of) for k, of in size.items()},
        f'{name}_since': shift.since_ns or None,
        f'{name}_since_low': shift.since_low_ns or None,
        f'{name}_since_high': shift.since_high_ns or None,
        f'{name}_sentence': in_unit(shift.sentence, unit),
    }


def _mean_difference(first: Characteristic, now: Characteristic) -> float:
    """Return the mean of this curve minus the first curve in MW, over their common range."""
    pressure = first.shown_at_mpa
    a, b = first.at_pressure(pressure), now.at_pressure(pressure)
    low, high = max(a.breakpoints[0], b.breakpoints[0]), min(a.breakpoints[-1], b.breakpoints[-1])
    u = np.unique(np.clip(np.concatenate([a.breakpoints, b.breakpoints]), low, high))
    gap = np.interp(u, b.breakpoints, b.values()) - np.interp(u, a.breakpoints, a.values())
    return float(np.sum(0.5 * (gap[1:] + gap[:-1]) * np.diff(u)) / (high - low))


def _diagnosis_facts(found: DiagnosisResult) -> Row:
    content = found.to_json()
    causes = [
        {
            **{name: cause[name] for name in ('name', 'sentence', 'meaning', 'to_do')},
            'parameters': [
                {'name': name, **{k: p[k] for k in ('value', 'low', 'high', 'unit')}}
                for name, p in cause['parameters'].items()
            ],
            **cause['gain'],
            **_onset(cause['parameters'].values()),
        }
        for cause in content['causes']
    ]
    names = ('verdict', 'not_told_apart', 'unexplained_by', 'rmse_simulation', 'rmse_extended',
             'rmse_noise_floor')  # fmt: skip
    return {**{name: content[name] for name in names}, 'causes': causes}


def _onset(parameters: Iterable[Mapping[str, Any]]) -> Row:
    """Return the onset of a cause and its interval in ns; None for a cause without a date."""
    dated = next((p for p in parameters if 'origin_ns' in p), {})

    def time_ns(days: float | None) -> int | None:
        return None if days is None else int(dated['origin_ns']) + round(days * DAY_NS)

    ends = {'onset': 'value', 'onset_low': 'low', 'onset_high': 'high'}
    return {name: time_ns(dated.get(of)) for name, of in ends.items()}


def _monitor_facts(found: MonitorResult) -> Row:
    content = found.to_json()
    wear = content['wear'] or {}
    return {
        'alarms': content['alarms'],
        'monitor_curves': len(content['curves']),
        'monitor_diagnoses': [{**d, 'causes': list(d['causes'])} for d in content['diagnoses']],
        'wear_mw_per_month': wear.get('mw_per_month'),
    }
