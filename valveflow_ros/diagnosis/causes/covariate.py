# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Causes from columns other than the four signals: covariates that the power may follow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.diagnosis.cause import Cause, SentenceValues, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.grids import Covariate, Grids
from valveflow_ros.diagnosis.screening import Screening
from valveflow_ros.diagnosis.slow import covariate_gain
from valveflow_ros.records import FloatArray

LEAST_SLOW_GAIN = 12.0  # least gain in log-likelihood over a model with a slow disturbance
_STEP_MW = 0.1
_MOST_SHARE = 0.5  # of the power, for one standard deviation
_LEAST_SPREAD = 1e-6  # of the largest value: rounding in the last digits of a constant


def covariate_cause(about: Covariate) -> Cause:
    """Return the cause "the power follows a covariate c".

    Condenser vacuum, ambient temperature, fuel and extraction change how much power the same
    steam generates:

        x = F(u) (1 + (b (c - usual c) + a1 (L - 1) + a2 (L - 1)^2) / P),  L = load / P

    where P is the mean power of the record, so that b is in MW per unit of c at that power. The
    usual c is that of the record at the same load: the part of c that depends on the load (more
    steam, a warmer condenser) is already in the curve. In a record of a few days it is uncertain,
    because weather and load may be correlated by chance; a1 and a2 absorb the part of that error
    that the straight pieces of the curve cannot.

    Relevant covariates vary over hours and days, like other influences that were not logged, and
    two slow series may correlate by chance. So b must improve a model that already has a slow
    disturbance of the power with free variance and time scale; see `slow.covariate_gain`.
    """
    name, spread = about.name, max(about.spread, 1e-300)
    bend = _MOST_SHARE * about.power_mw
    most = bend / spread

    def act(values: Values, grids: Grids, extra: Values) -> FloatArray:
        del extra
        # Not by u with the other causes applied: the terms are the same for every model.
        if about not in grids.cache:
            _, here = grids.covariates[name]
            grids.cache[about] = about.terms(grids.u, grids.pressure, here) / about.power_mw
        return np.asarray(1.0 + np.array(values) @ grids.cache[about])

    def starts(screening: Screening) -> Sequence[Start]:
        if covariate_gain(screening.task, screening.model, name) < LEAST_SLOW_GAIN:
            return []
        return [screening.scaled_height(cause, (0.0, 0.0))]

    def sentence(values: SentenceValues) -> str:
        b, per = values['b'], about.unit or 'unit'
        column = name if about.column.lstrip('/') == name else f'{about.column} ({name})'
        return (
            f'The power {"rises" if b > 0.0 else "falls"} by {abs(b):.2g} MW for every {per} that '
            f'{column} is higher, at a load of {about.power_mw:.0f} MW.'
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
