# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Records of the simulated plant to be diagnosed, and a start an identification would give."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.diagnose import Record, diagnose
from valveflow_ros.diagnosis.result import Diagnosis
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import Noise, Programme, UnitDescription
from valveflow_ros.records import SampleTable
from valveflow_ros.signals.static_form import StaticForm

STEP_S, EXPONENT, SETTLE_S = 2.0, 1.125, 300.0
# A whole diagnosis takes half the time with rows twice as far apart.
COARSE_S = 4.0


def unit(
    noise: Noise | None = None, programme: Programme | None = None, step_s: float = STEP_S
) -> UnitDescription:
    """The paper's unit, sampled every two seconds."""
    return UnitDescription(
        noise=noise or Noise(), programme=programme or Programme(), sample_period_s=step_s
    )


coarse_unit = partial(unit, step_s=COARSE_S)


def rough_model() -> RegionalModel:
    """A curve and dynamics near the paper's, as wrong as an identification may be."""
    knots = np.array([1060.0, 1260.0, 1590.0, 1910.0, 2300.0])
    values = np.array([154.5, 201.5, 261.5, 291.0, 294.0])
    return RegionalModel(
        knots, values[:-1].copy(), values[1:].copy(), np.array([238.5]),
        np.array([11.5, 72.0]), np.array([2.0, 12.0]),
    )  # fmt: skip


_simulated: dict[str, SampleTable] = {}


def table(days: float, seed: int, effects: tuple[str, ...], of: UnitDescription) -> SampleTable:
    """What the historian of a plant has; nothing is simulated twice."""
    key = repr((days, seed, effects, of))
    if key not in _simulated:
        specs = [EffectSpec.parse(e) for e in effects]
        _simulated[key] = simulate(days, seed, of, effects=specs).table
    return _simulated[key]


def record(samples: SampleTable) -> Record:
    """A record without special segments."""
    step_s = float(np.median(np.diff(samples.time_ns[:1000]))) / 1e9
    return Record(
        samples, step_s, StaticForm(exponent=EXPONENT), SETTLE_S, np.empty((0, 2), dtype=np.int64)
    )


def diagnosed(
    *effects: str, days: float = 4.0, seed: int = 1, of: UnitDescription | None = None,
    model: RegionalModel | None = None, given: bool = False,
) -> Diagnosis:  # fmt: skip
    """Simulate and diagnose."""
    samples = table(days, seed, effects, of or coarse_unit())
    return diagnose(record(samples), model or rough_model(), given)


def names(found: Diagnosis) -> set[str]:
    """The names of the causes."""
    return {cause.name for cause in found.causes}


def masked(samples: SampleTable, share: float, seed: int) -> SampleTable:
    """A table with single rows missing."""
    keep = np.random.default_rng(seed).random(len(samples)) >= share
    keep[0] = True
    return SampleTable(samples.time_ns[keep], samples.values[keep], samples.quality[keep])


def shifted_column(samples: SampleTable, column: int, rows: int) -> SampleTable:
    """A table with one column moved in time."""
    values = samples.values.copy()
    values[:, column] = np.roll(values[:, column], rows)
    return replace(samples, values=values)
