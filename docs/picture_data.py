# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the pictures of the handbook show: plants that are simulated and diagnosed once.

Run: ``python -m docs.picture_data [NAME ...]`` (about a minute each); ``python -m
docs.make_pictures`` draws what this keeps in ``docs/pictures/data/``.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

DATA = Path(__file__).parent / 'pictures' / 'data'
SEED = 5
_DIGITS = 5
_TOLD = (
    'verdict', 'causes', 'not_told_apart', 'rmse_simulation', 'rmse_extended', 'rmse_noise_floor',
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """How one effect is shown.

    Attributes
    ----------
    parameters : str
        As ``--effect NAME:`` takes them.
    views : tuple of str
        Variables of the residual that tell most, 'map' and a variable held against u,
        'fast moves' or 'record'.
    days : int
    earlier : bool
        Diagnosed against the curve of an earlier, healthy record: an identification of the
        same record would take the effect for the unit's own.
    exponent : float, optional
        Exponent of the pressure that is given to the diagnosis, for the same reason.
    """

    parameters: str
    views: tuple[str, ...]
    days: int = 5
    earlier: bool = False
    exponent: float | None = None


# Larger than the smallest that is found, so that an eye sees it too.
CASES = {
    'backlash': Case('w_percent=1.5', ('direction', 'fast moves')),
    'choked': Case('kappa=0.038', ('pressure given u', 'map pressure given u')),
    'clock': Case('d_s=25', ('fast moves', 'ramp')),
    'curve_shape': Case('h_mw=3,u0=1425,width_u=150', ('u', 'map pressure given u'), earlier=True),
    'curve_step': Case('s_mw=-5,t0_days=2', ('time', 'map time')),
    'diurnal': Case('a=0.01', ('time of day', 'time')),
    'exponent': Case('dm=0.12', ('pressure given u', 'map pressure given u'), exponent=1.125),
    'gain_drift': Case('g=0.04', ('time', 'map time')),
    'gain_step': Case('g=0.012,t0_days=2', ('time', 'map time')),
    'input_drift': Case('g=0.04', ('time', 'map time')),
    'input_step': Case('g=0.02,t0_days=2', ('time', 'map time')),
    'intervals': Case('g=-0.015', ('time', 'map time')),
    'output_offset_drift': Case('b_mw=8', ('time', 'map time')),
    'rate_limit': Case('r_percent_per_s=0.06', ('fast moves', 'ramp')),
    'region_lag': Case('time_s=200,delay_s=10,level_mw=270', ('fast moves', 'ramp'), earlier=True),
    'reheater': Case('alpha=0.3,time_s=120', ('fast moves', 'ramp')),
    'saturation': Case('max_percent=82', ('u', 'map pressure given u')),
    'stiction': Case('s_percent=2,j_percent=1.4', ('direction', 'fast moves')),
    'temperature': Case('k=-0.0015', ('temperature', 'time')),
    'flatline': Case('signal=main_steam_pressure,minutes=120,t0_days=1.5', ('record',), 3),
    'quantisation': Case('signal=generated_power,step=5', ('record',), 3),
    'spikes': Case('signal=generated_power,height=25,per_day=20', ('record',), 3),
}


def commands(name: str) -> list[str]:
    """Return the commands that make the plant of an effect and diagnose it."""
    case = CASES[name]
    made = f'--days {case.days} --seed {SEED}'
    lines = [
        f'valveflow simulate -o {name}.mcap {made} --effect {name}:{case.parameters}',
        f'valveflow diagnose {name}.mcap -o {name}',
    ]
    if case.exponent is not None:
        lines[-1] += f' --set pressure_exponent={case.exponent:g}'
    if case.earlier:
        lines[-1] += ' --model healthy/characteristic.json'
        lines = [
            f'valveflow simulate -o healthy.mcap --days {case.days} --seed {SEED + 1}',
            'valveflow identify healthy.mcap -o healthy',
            *lines,
        ]
    return lines


def _numbers(values: Any) -> list[float]:
    return [float(f'{v:.{_DIGITS}g}') for v in np.asarray(values, dtype=np.float64)]


def _views(page: Any, wanted: tuple[str, ...]) -> dict[str, Any]:
    """Return the residual in bins of the wanted variables, before and after."""
    found: dict[str, Any] = {}
    for s in page.signatures:
        if s.variable in wanted:
            found[s.variable] = {
                key: _numbers(getattr(s, key)) for key in ('middle', 'before', 'after', 'chance')
            }
    if 'fast moves' in wanted:
        found['fast moves'] = [
            {
                'up': bool(a.up), 'moves': int(a.moves), 'chance': float(a.chance),
                **{key: _numbers(getattr(a, key)) for key in ('time_s', 'before', 'after')},
            }
            for a in page.answers
        ]  # fmt: skip
    for m in page.maps:
        if f'map {m.across}' in wanted:
            found[f'map {m.across}'] = {
                'across': _numbers(m.across_edges), 'up': _numbers(m.up_edges),
                'before': [_numbers(row) for row in np.nan_to_num(m.before)],
                'after': [_numbers(row) for row in np.nan_to_num(m.after)],
            }  # fmt: skip
    return found


def _record(name: str, faulty: Any, sound: Any) -> dict[str, Any]:
    """Return a stretch of the record of a faulty signal, and what it should have been."""
    topic = dict(p.split('=') for p in CASES[name].parameters.split(','))['signal']
    from valveflow_ros.records import SIGNALS

    info = next(s for s in SIGNALS if s.topic == topic)
    bad, good = faulty.table.column(info.signal), sound.table.column(info.signal)
    first = int(np.argmax(np.abs(bad - good) > 1e-9))
    before, after, step = {
        'flatline': (3600, 10800, 30), 'quantisation': (0, 400, 1), 'spikes': (150, 450, 1),
    }[name]  # fmt: skip
    rows = slice(max(0, first - before), first + after, step)
    hours = (faulty.table.time_ns[rows] - faulty.table.time_ns[0]) / 3.6e12
    return {
        'signal': topic, 'unit': info.unit, 'hours': _numbers(hours),
        'recorded': _numbers(bad[rows]), 'true': _numbers(good[rows]),
    }  # fmt: skip


def _healthy(days: int, folder: Path) -> Any:
    """Return the curve of the same unit in other, healthy days."""
    from valveflow_ros.interface.identify import identify
    from valveflow_ros.logs import write_table
    from valveflow_ros.plant.simulator import simulate

    path = folder / 'healthy.parquet'
    write_table(simulate(days, SEED + 1).table, path)
    return identify(path).characteristic


def gather(name: str) -> dict[str, Any]:
    """Simulate, diagnose, and return what is shown and what the program said."""
    from valveflow_ros.diagnosis.result import to_json
    from valveflow_ros.interface.diagnose import diagnose
    from valveflow_ros.logs import write_table
    from valveflow_ros.plant.simulator import simulate
    from valveflow_ros.plant.spec import EffectSpec

    case = CASES[name]
    effect = EffectSpec.parse(f'{name}:{case.parameters}')
    log = simulate(case.days, SEED, effects=[effect])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f'{name}.parquet'
        write_table(log.table, path)
        model = _healthy(case.days, Path(folder)) if case.earlier else None
        law = {} if case.exponent is None else {'pressure_exponent': case.exponent}
        found = diagnose(path, parameters=law, model=model).data
    told = to_json(found.diagnosis)
    views = _views(found, case.views)
    if 'record' in case.views:
        views['record'] = _record(name, log, simulate(case.days, SEED))
    return {
        'effect': name, 'parameters': case.parameters,
        'commands': commands(name),
        'start_ns': int(found.start_ns), 'sentence': found.diagnosis.sentence,
        'diagnosis': {k: told[k] for k in _TOLD},
        'views': views,
    }  # fmt: skip


def main(names: list[str]) -> int:
    """Gather what is named, or all."""
    DATA.mkdir(parents=True, exist_ok=True)
    for name in names or CASES:
        data = gather(name)
        (DATA / f'{name}.json').write_text(json.dumps(data, separators=(',', ':')) + '\n')
        print(name, data.get('sentence', ''), flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
