"""Above a load the unit stores more steam and answers later.

The regional dynamics G_i of eq. (3): above ``level_mw`` the unit has the given
time constant and delay instead of its own.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import Hooks
from valveflow_ros.plant.unit import Region


def install(values: Values, hooks: Hooks) -> None:
    """Replace all regions above the level by one."""
    hooks.claim('region_lag')
    level = values['level_mw']
    # A region that lay above the level keeps no power at which it would act.
    kept = [
        dataclasses.replace(region, power_to_mw=min(region.power_to_mw, level))
        for region in hooks.regions
    ]
    above = Region(np.inf, values['time_s'], values['delay_s'])
    hooks.regions = (*kept, above)


EFFECT = Effect(
    'region_lag',
    'Above a load the unit answers with another time constant and delay.',
    (
        Parameter('time_s', 30.0, 's', 'Time constant above the level.', 0.1, 1000.0),
        Parameter('delay_s', 3.0, 's', 'Delay above the level.', 0.0, 600.0),
        Parameter('level_mw', 240.0, 'MW', 'Where it begins.', 1.0, 10_000.0),
    ),
    install,
)
