# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the monitor estimated from a log of the plant, and the parameter file."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from valveflow_ros import __version__
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import DataError, ParameterError
from valveflow_ros.fit.fit import fit
from valveflow_ros.interface import SILENT, Progress
from valveflow_ros.interface.logs import Log, as_log
from valveflow_ros.interface.settings import ONE_FIT, fitting
from valveflow_ros.monitoring.events import FitRequested
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_aligned
from valveflow_ros.parameters import PARAMETERS, TABLE, Settings, Value, as_yaml
from valveflow_ros.records import SIGNALS
from valveflow_ros.report.terminal.text import clean
from valveflow_ros.report.words import duration
from valveflow_ros.signals.align import Aligner, aligned_blocks
from valveflow_ros.signals.units import DIFFERENCES, unit_of

# Too short a transient makes segments wrong, too long a one only makes them fewer: a small
# excess raises the parameter, only a large one lowers it.
_MORE, _LESS = 0.05, 0.2
_SURE = 2.0  # standard errors
_OF_STEP = ('sample_period', 'hold_limit', 'lateness', 'block', 'longest_segment', 'alarm_block',
            'alarm_average')  # fmt: skip


@dataclass(frozen=True, slots=True)
class FittedValue:
    """A parameter estimated from the data, and the basis of the estimate."""

    name: str
    value: Value
    ground: str

    @property
    def shown(self) -> str:
        """Return the value with its unit."""
        unit = PARAMETERS[self.name].unit
        text = f'{self.value:g}' if isinstance(self.value, float) else str(self.value)
        return f'{text} {unit}'.strip()


class Fitted(dict[str, FittedValue]):
    """Fitted parameters by name; ``left`` has one sentence for each that could not be fitted."""

    def __init__(self) -> None:
        super().__init__()
        self.left: list[str] = []

    def put(self, name: str, value: Value, ground: str) -> None:
        """Add a parameter."""
        self[name] = FittedValue(name, PARAMETERS[name].check(value), clean(ground))

    def changes(self) -> dict[str, Value]:
        """Return the values by name."""
        return {name: one.value for name, one in self.items()}


def fit_parameters(log: Any, unit_tag: str = '', *, progress: Progress = SILENT) -> Fitted:
    """Return the parameters of the monitor that can be estimated from a log.

    The log is the result of `open_log`, or anything that it opens. Raises `DataError` if it has
    no readings.
    """
    log = as_log(log, progress)
    if not len(log.readings):
        raise DataError(f'{log.contents.path} holds no readings of the inputs.')
    found = Fitted()
    if unit_tag:
        found.put('unit_tag', unit_tag, 'as you said')
    elif recorded := _recorded_tag(log):
        found.put('unit_tag', recorded, 'the monitor that made the recording had this tag')
    _units(log, found)
    _steps(log, found)
    changes = found.changes()
    # A window for the whole log; that of the monitor is not changed.
    adapted = fitting(log.steps(), log.span_s, changes)
    window = {name: value for name, value in adapted.items() if name == 'window_days'}
    settings = Settings({**changes, **window, **ONE_FIT})
    monitor = Monitor(settings)
    for aligned in aligned_blocks(Aligner(settings), log.readings, progress, 'finding segments'):
        feed_aligned(monitor, aligned)
    _noise(monitor, found)
    _dynamics(monitor, found, progress)
    return found


def _recorded_tag(log: Log) -> str:
    """Return the tag in the parameters of a recording; empty if it has none or the default."""
    try:
        tag = json.loads(log.contents.attachments['parameters.json'])['unit_tag']
        tag = str(PARAMETERS['unit_tag'].check(tag))
    except (KeyError, ValueError, TypeError, ParameterError):
        return ''
    return '' if tag == PARAMETERS['unit_tag'].default else tag


def _units(log: Log, found: Fitted) -> None:
    for signal, unit in log.units.items():
        name = f'{SIGNALS[signal].topic}_unit'
        usual = unit_of(signal, str(PARAMETERS[name].default))
        if signal in log.constants or unit_of(signal, unit) == usual:
            continue
        said = f"'{log.name_of(signal)}' of the log is in {unit}"
        unit = unit.removesuffix('d') if unit in DIFFERENCES else unit
        if unit in PARAMETERS[name].choices:
            found.put(name, unit, said)
            continue
        choices = ', '.join(PARAMETERS[name].choices)
        found.left.append(f'{name}: {clean(said)}; let the gateway send one of {choices}.')
    for name, value in log.parameters({})[0].items():
        if name not in found:
            found.put(name, value, 'the fluid of the log, and the size of its output')


def _steps(log: Log, found: Fitted) -> None:
    measured = {s: step for s, step in log.steps().items() if s not in log.constants}
    adapted = fitting(measured, 0.0, {})
    if not measured:
        return
    quickest, slowest = min(measured.values()), max(measured.values())
    for name in _OF_STEP:
        if name in adapted:
            step = slowest if name == 'hold_limit' else quickest
            found.put(name, adapted[name], f'the log has a value every {duration(step)}')


def _noise(monitor: Monitor, found: Fitted) -> None:
    level = monitor.noise()
    if not level.learnt:
        found.left.append(
            'input_noise and power_noise: the log is too short to learn the noise; the monitor '
            'learns it while it runs.'
        )
        return
    ground = 'sd of block means about a line in the log; 0 would learn it anew at each start'
    for name, value in (('input_noise', level.input), ('power_noise', level.power_mw)):
        if value > 0.0:
            found.put(name, float(f'{value:.3g}'), ground)


def _dynamics(monitor: Monitor, found: Fitted, progress: Progress) -> None:
    kept = 'time_constant and delay: kept at their defaults, because '
    if not monitor.segments:
        found.left.append(f'{kept}the log shows no steady state or ramp to learn them from.')
        return
    task = next(e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
    try:
        curve = fit(task, lambda what: progress(0.6, what))
    except DataError as error:
        found.left.append(f'{kept}no curve could be fitted ({clean(str(error)).rstrip(".")}).')
        return
    if not curve.dynamics:
        found.left.append(f'{kept}the log does not tell the dynamics.')
        return
    _largest(curve, found)


def _largest(curve: Characteristic, found: Fitted) -> None:
    for name in ('time_constant', 'delay'):
        what = name.replace('_', ' ')
        pairs = [(getattr(d, f'{name}_s'), getattr(d, f'{name}_stderr_s')) for d in curve.dynamics]
        known = [pair for pair in pairs if not pair[1] > pair[0]]
        if not known:
            found.left.append(f'{name} is left as it is: the {what} is not known from the log.')
            continue
        value, error = max(known)
        error = error if math.isfinite(error) else 0.0
        default = float(PARAMETERS[name].default)
        wanted = float(max(1, math.ceil(value + _SURE * error)))
        if wanted > (1.0 + _MORE) * default or wanted < (1.0 - _LESS) * default:
            ground = f'the largest {what} found in the log is {value:.3g} s'
            if error:
                ground += f' (standard error {error:.2g} s)'
            found.put(name, wanted, ground)


def parameter_file(source: str, found: Fitted) -> str:
    """Return the text of a ROS 2 parameter file that is valid for any node name.

    ``source`` is the name of the log. Raises `ParameterError` if values contradict each other.
    """
    values = found.changes()
    Settings(values)
    # Names of files and columns are not trusted: a line break in a name would end the comment.
    lines = [
        f'# Parameters of the monitor, fitted to {clean(source)} by valveflow {__version__}.',
        "# Lines marked 'fitted' follow from the data; all others are the defaults.",
        *(f'# {clean(sentence)}' for sentence in found.left),
        *as_yaml([], {}).splitlines(),
    ]
    for row in TABLE:
        about, value = as_yaml([row], values).splitlines()[2:]
        lines.append(about)
        if row.name in found:
            lines.append(f'    # fitted: {clean(found[row.name].ground)}.')
        lines.append(value)
    return '\n'.join(lines) + '\n'
