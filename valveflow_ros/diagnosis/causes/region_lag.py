"""Above a load the unit stores more steam and answers with other dynamics than the model's.

The regional G_i of eq. (3): above ``level`` another time constant and another delay hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Cause, Kind, Stage, Start, Unknown, Values

_TRIED_SHARES = (0.1, 0.3, 0.5, 0.7)
_TRIED_FACTORS = (0.4, 0.7, 1.5, 2.5)


def act(model: RegionalModel, values: Values) -> RegionalModel:
    """Return the model with one region above the level."""
    time_s, delay_s, level = values
    keep = model.levels < level
    inside = int(keep.sum()) + 1
    return replace(
        model,
        levels=np.append(model.levels[keep], level),
        time_constants=np.append(model.time_constants[:inside], time_s),
        delays=np.append(model.delays[:inside], delay_s),
    )


def starts(bench: Bench) -> Sequence[Start]:
    """Try other time constants above some loads, the model's own levels among them."""
    scene, base = bench.scene, bench.model.base
    x = base.static(scene.u[scene.usable > 0][::10])
    levels = [*np.quantile(x, _TRIED_SHARES).tolist(), *(base.levels + 0.01).tolist()]
    grid: list[Values] = []
    for level in levels:
        own = int(np.searchsorted(base.levels, level))
        for factor in _TRIED_FACTORS:
            grid.append(
                (float(base.time_constants[own]) * factor, float(base.delays[own]), float(level))
            )
    return bench.best(CAUSE, grid)


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'Above {values["level_mw"]:.0f} MW the unit answers with a time constant of '
        f'{values["time_s"]:.3g} s and a delay of {values["delay_s"]:.2g} s, unlike the model.'
    )


CAUSE = Cause(
    'region_lag', 'lag', Stage.DYNAMICS,
    (
        Unknown('time_s', 's', 1.0, 0.2, 3600.0),
        Unknown('delay_s', 's', 0.5, 0.0, 600.0),
        Unknown('level_mw', 'MW', 6.0, 0.0, 1e5, Kind.LINE),
    ),
    act, starts, sentence, ('reheater', 'backlash', 'rate_limit'),
    'Run the same ramp at two speeds: what a lag does grows with the speed.',
    of_model=True,
)  # fmt: skip
