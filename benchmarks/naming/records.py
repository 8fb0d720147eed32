# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The records of the benchmark and their truth, drawn from a seed."""

from __future__ import annotations

import gzip
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import valveflow_ros as vf
from benchmarks.diagnosis_cases import EFFECTS, Setting, drawn, hidden, null, outside, slow
from benchmarks.diagnosis_outside import OUTSIDE, SLOW, slowly
from benchmarks.diagnosis_study import simulated
from valveflow_ros.errors import RecordingError
from valveflow_ros.interface.simulate import Simulation
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.thermal_unit import KINDS
from valveflow_ros.plant.unit import UnitDescription

SEALED, PRACTICE = 96_001, 82_001  # first seeds of the two sets
SHA256 = {  # of truth.json
    SEALED: '80559fd4c5a4a2ce79aa3b52c2ad66c86c49941ae4ef1013f695ed957ec29b74',
    PRACTICE: 'b3965907b07965f3a83282e5576e2b0783b38829bb83b1102fdf87092142a65a',
}
DAYS = 5.0
NAMES = tuple(EFFECTS)  # what may be answered
TIMES = (2.0, 4.0)  # of the smallest effect that shows

# What is hidden, one effect a record. A mean over a minute hides what is faster than it, and a
# unit built from physics has no regions or pieces that an effect could change. No record has
# region_lag: it shows only against an earlier model.
HIDDEN = {
    ('paper', '1s'): (
        'backlash', 'stiction', 'rate_limit', 'reheater', 'clock', 'saturation', 'exponent',
        'choked', 'curve_shape', 'curve_step',
    ),
    ('paper', 'minute'): ('temperature', 'input_step', 'intervals', 'gain_drift'),
    ('physics', '1s'): ('backlash', 'rate_limit', 'clock', 'gain_step', 'input_drift'),
    ('physics', 'minute'): (
        'gain_step', 'output_offset_drift', 'diurnal', 'temperature', 'input_step',
    ),
}  # fmt: skip
_POWER_STEP_MW = {'paper': 0.01, 'physics': 0.02}
_HEALTHY = _OUTSIDE = 2  # records of each plant and recording
# An offset that switches has a name, intervals.
_SLOW = tuple(label for label in SLOW if label != 'switching offset')


@dataclass(frozen=True)
class Entry:
    """A record to be made; ``label`` is what is hidden in it, empty if healthy."""

    seed: int
    plant: str
    recording: str
    kind: str
    label: str = ''


def entries(first: int) -> list[Entry]:
    """Return the records of a set in an order that tells nothing."""
    found: list[tuple[str, str, str, str]] = []
    rng = np.random.default_rng([first, 1])
    for (plant, recording), names in HIDDEN.items():
        outer = (*OUTSIDE, *_SLOW) if (plant, recording) == ('paper', '1s') else _SLOW
        labels = rng.choice(np.array(outer), _OUTSIDE, replace=False).tolist()
        rest = [('healthy', '')] * _HEALTHY + [('outside', label) for label in labels]
        found += [(plant, recording, *what) for what in [('hidden', n) for n in names] + rest]
    ordered = [Entry(first + k, *what) for k, what in enumerate(found)]
    return [ordered[k] for k in rng.permutation(len(ordered))]


def kind_of(entry: Entry) -> str:
    """Draw the kind of the valves of a unit built from physics."""
    return str(np.random.default_rng([entry.seed, 2]).choice(np.array(list(KINDS))))


def record(entry: Entry, days: float) -> tuple[pd.DataFrame, tuple[EffectSpec, ...]]:
    """Return the rows of a record and the effects in it."""
    make = _paper if entry.plant == 'paper' else _physics
    simulation, effects = make(entry, days)
    frame = simulation.to_dataframe().set_index('time')
    # What was added after the simulation has the steps of the power meter, as all others have.
    step = _POWER_STEP_MW[entry.plant]
    frame['generated_power_mw'] = (frame['generated_power_mw'] / step).round() * step
    if entry.recording == 'minute':
        frame = frame.resample('60s').mean()
    # Means of recorded digits never lie between two of the fifth, so no sum's order matters.
    return frame.round(5).reset_index(), effects


def _paper(entry: Entry, days: float) -> tuple[Simulation, tuple[EffectSpec, ...]]:
    """Simulate a plant of the paper's kind, every third the paper's own."""
    if entry.kind == 'healthy':
        case = null(entry.seed)
    elif entry.kind == 'hidden':
        case = hidden((entry.label,), entry.seed, days, TIMES)
    else:
        case = (outside if entry.label in OUTSIDE else slow)(entry.label, entry.seed)
    case = replace(case, unit=replace(case.unit, sample_period_s=1.0))
    return Simulation(simulated(case, days), days, entry.seed), case.effects


def _physics(entry: Entry, days: float) -> tuple[Simulation, tuple[EffectSpec, ...]]:
    """Simulate a unit built from physics; its effects are as large as in the paper's unit."""
    rng = np.random.default_rng([entry.seed, 2])
    kind = str(rng.choice(np.array(list(KINDS))))
    effects: tuple[EffectSpec, ...] = ()
    if entry.kind == 'hidden':
        setting = Setting(rng, UnitDescription(), days, *TIMES)
        effects = (drawn(entry.label, setting),)
    simulation = vf.simulate(days, entry.seed, effects, unit=f'{kind}:number={entry.seed}')
    if entry.kind == 'outside':
        data: Any = simulation.data
        simulation = replace(simulation, data=slowly(data, entry.label, entry.seed))
    return simulation, effects


def truth_of(entry: Entry, effects: tuple[EffectSpec, ...], content: bytes) -> dict[str, Any]:
    """Return what is true of a record; ``sha256`` is that of its unpacked file.

    ``also`` are names that are true of a healthy unit: to give them is never wrong. A unit built
    from physics has a reheater, and the paper's law with another exponent than 9/8.
    """
    also: list[str] = []
    if entry.plant != 'paper':
        exponent = kind_of(entry).startswith('integrated_input')
        also = ['reheater', 'exponent'] if exponent else ['reheater']
    about = {
        'seed': entry.seed, 'plant': entry.plant, 'recording': entry.recording,
        'kind': entry.kind, 'label': entry.label, 'names': [e.name for e in effects],
        'also': also, 'sha256': hashlib.sha256(content).hexdigest(),
    }  # fmt: skip
    for effect in effects:
        values = effect.parameters
        about |= {'parameters': values, 'size': next(iter(values.values()))}
        if 't0_days' in values:
            about['onset_hours'] = round(24.0 * float(values['t0_days']), 4)
    return about


def write(folder: Path, wanted: list[Entry], days: float = DAYS) -> Iterator[str]:
    """Write records, what may be known of them, and their truth apart; yield each name."""
    if (folder / 'truth.json').exists():
        raise RecordingError(folder, 'it has a set of records already; name another folder')
    (folder / 'records').mkdir(parents=True, exist_ok=True)
    known, truth = {}, {}
    for k, entry in enumerate(wanted, 1):
        name = f'record_{k:02}'
        frame, effects = record(entry, days)
        content = frame.to_csv(index=False).encode()
        file = f'records/{name}.csv.gz'
        (folder / file).write_bytes(gzip.compress(content, 5, mtime=0))
        law = 'u = V p^1.125' if entry.plant == 'paper' else 'not known'
        known[name] = {'file': file, 'recording': entry.recording, 'flow_law': law}
        truth[name] = truth_of(entry, effects, content)
        yield name
    (folder / 'records.json').write_text(json.dumps(known, indent=1) + '\n')
    (folder / 'truth.json').write_text(json.dumps(truth, indent=1) + '\n')


def sha256(folder: Path) -> str:
    """Return the sum of the truth of a set; it has the sums of the records."""
    return hashlib.sha256((folder / 'truth.json').read_bytes()).hexdigest()


def same_as_published(folder: Path, first: int) -> bool:
    """Tell whether a set is the published one."""
    return sha256(folder) == SHA256[first]
