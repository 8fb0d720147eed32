# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the four signals do not hold: columns beside them that the power may follow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.cause import Cause, SentenceValues, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.grids import Covariate, Grids
from valveflow_ros.diagnosis.screening import Screening
from valveflow_ros.diagnosis.slow import covariate_gain
from valveflow_ros.records import FloatArray

LEAST_SLOW_GAIN = 12.0  # log-likelihood beside a slow wander of the power
_STEP_MW = 0.1
_MOST_SHARE = 0.5  # of the power, for one standard deviation
_LEAST_SPREAD = 1e-6  # of the largest value: the last digits of a constant


def covariate_cause(about: Covariate) -> Cause:
    """Return the cause that the power follows a covariate c.

    Condenser vacuum, ambient temperature, fuel and extraction change how much power the same
    steam makes:

        x = F(u) (1 + (b (c - usual c) + a1 (L - 1) + a2 (L - 1)^2) / P),  L = load / P

    with P the mean power of the record, so that b is in MW per unit of c at that power. The usual
    c is that of the record at the same load: what of c is a function of the load (more steam, a
    warmer condenser) is in the curve already. In a record of days it is known only as well as
    chance parted weather and load; a1 and a2 are what the straight pieces of the curve cannot
    take up of that error.

    The covariates that matter vary over hours and days, as does whatever else the power follows
    and nobody logged; two slow series look alike by chance. So b has to show beside a slow wander
    of the power whose variance and time scale are free; see `slow.covariate_gain`.
    """
    name, spread = about.name, max(about.spread, 1e-300)
    bend = _MOST_SHARE * about.power_mw
    most = bend / spread

    def act(values: Values, grids: Grids, extra: Values) -> FloatArray:
        del extra
        _, here = grids.covariates[name]
        load = about.load(grids.u, grids.pressure) - 1.0
        usual = about.usual(grids.u, grids.pressure)
        more = values[0] * (here - usual) + values[1] * load + values[2] * load * load
        return np.asarray(1.0 + more / about.power_mw)

    def starts(screening: Screening) -> Sequence[Start]:
        if covariate_gain(screening.task, screening.model, name) < LEAST_SLOW_GAIN:
            return []
        return [screening.scaled_height(cause, (0.0, 0.0))]

    def sentence(values: SentenceValues) -> str:
        b, per = values['b'], about.unit or 'unit'
        return (
            f'The power {"rises" if b > 0.0 else "falls"} by {abs(b):.2g} MW for every {per} that '
            f'{name} ({about.column}) is higher, at a load of {about.power_mw:.0f} MW.'
        )

    def hindered(grids: Grids) -> str:
        _, here = grids.covariates[name]
        whole = max(float(np.abs(here).max()), 1e-12)
        if about.spread > _LEAST_SPREAD * whole:
            return ''
        return f'{about.column} hardly changes beyond what the load makes of it'

    unit = f'MW/{about.unit}' if about.unit else 'MW per unit'
    cause = Cause(
        name, 'covariate', Stage.GAIN,
        (
            Unknown('b', unit, _STEP_MW / spread, -most, most),
            Unknown('a1', 'MW', _STEP_MW, -bend, bend),
            Unknown('a2', 'MW', _STEP_MW, -bend, bend),
        ),
        act, starts, sentence, ('diurnal', 'intervals', 'gain_drift'),
        f'Record while {about.column} changes and the load does not.',
        hindered, covariate=about,
    )  # fmt: skip
    return cause
