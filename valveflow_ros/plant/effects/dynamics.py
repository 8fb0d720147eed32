# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects in the response of the power: another lag at high load, and the reheater."""

from __future__ import annotations

import dataclasses

import numpy as np

from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import Hooks, Values, effect
from valveflow_ros.plant.unit import Region


@effect(
    'Above a load the unit answers with another time constant and delay.',
    Parameter('time_s', 30.0, 's', 'Time constant above the level.', 0.1, 1000.0),
    Parameter('delay_s', 3.0, 's', 'Delay above the level.', 0.0, 600.0),
    Parameter('level_mw', 240.0, 'MW', 'Where it begins.', 1.0, 10_000.0),
)
def region_lag(values: Values, hooks: Hooks) -> None:
    """Above a load the unit stores more steam and responds more slowly.

    The regional dynamics G_i of eq. (3): above ``level_mw`` the unit has the given
    time constant and delay instead of its own.
    """
    hooks.claim('region_lag')
    level = values['level_mw']
    # A region above the level gets an empty range of power, so it is never active.
    kept = [
        dataclasses.replace(region, power_to_mw=min(region.power_to_mw, level))
        for region in hooks.regions
    ]
    above = Region(np.inf, values['time_s'], values['delay_s'])
    hooks.regions = (*kept, above)


@effect(
    'Part of the power follows later, through the reheater.',
    Parameter('alpha', 0.3, '', 'Share made in front of the reheater.', 0.0, 1.0),
    Parameter('time_s', 20.0, 's', 'Time constant of the reheater.', 0.0, 600.0),
)
def reheater(values: Values, hooks: Hooks) -> None:
    """Most of the power is generated after the reheater, which fills slowly.

    The turbine models of IEEE (IEEEG1, TGOV1) divide the power: a fraction is generated
    before the reheater without lag, the rest follows its filling.

        y = alpha y1 + (1 - alpha) y1 / (1 + T s),  y1 = G x
    """
    hooks.claim('reheater')
    hooks.reheater_share = values['alpha']
    hooks.reheater_s = values['time_s']
