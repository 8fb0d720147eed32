"""The power follows the time of day.

The pressure in the condenser follows the ambient air or the cooling water, and
the enthalpy drop follows it. Auxiliary load driven by the weather looks the same.

    x = F(u) (1 + a cos(2 pi (t - t_peak) / 24 h)),  t the time of day, UTC
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.config import Parameter
from valveflow_ros.plant.effect import Effect, Values
from valveflow_ros.plant.hooks import DAY_S, Forcing, Hooks


def install(values: Values, hooks: Hooks) -> None:
    """Multiply x by a daily wave."""
    peak_s = values['peak_h'] * 3600.0

    def change(rows: Forcing) -> None:
        wave = np.cos(2.0 * np.pi * (rows.clock_s - peak_s) / DAY_S)
        rows.gain[:] *= 1.0 + values['a'] * wave

    hooks.forcing.append(change)


EFFECT = Effect(
    'diurnal',
    'The power belonging to a flow rises and falls once a day.',
    (
        Parameter('a', 0.005, '', 'Relative amplitude.', -0.2, 0.2),
        Parameter('peak_h', 5.0, 'h', 'Time of day of the highest power, UTC.', 0.0, 24.0),
    ),
    install,
)
