# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The extended model: curve, regional dynamics and causes, run on measured inputs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    FittedData,
    HeldCause,
    Piece,
    RegionDynamics,
    ResidualStatistics,
)
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.cause import FittedCause, Stage
from valveflow_ros.diagnosis.grids import Grids, Reference
from valveflow_ros.records import ByteArray, FloatArray
from valveflow_ros.signals.static_form import StaticForm
from valveflow_ros.signals.units import in_unit

_REMEMBERED = 24


@dataclass(frozen=True, slots=True)
class Drive:
    """Inputs with the effect of causes, (n,): u, p^e, MW added, factor on x (None: no effect)."""

    u: FloatArray
    scale: FloatArray
    added: FloatArray | None
    gain: FloatArray | None


@dataclass(frozen=True, slots=True)
class Extended:
    """A model with the causes found so far; without causes it is the plain simulation."""

    base: RegionalModel
    active: tuple[FittedCause, ...] = ()

    def at(self, stage: Stage) -> tuple[FittedCause, ...]:
        """Return the causes that act at one stage."""
        return tuple(a for a in self.active if a.cause.stage == stage)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the causes in the order found."""
        return tuple(a.name for a in self.active)

    @property
    def regional(self) -> RegionalModel:
        """Return curve and dynamics, including the changes by causes of the dynamics."""
        model = self.base
        for a in self.at(Stage.DYNAMICS):
            model = a.cause.act(model, a.values)
        return model

    def place_words(self, form: StaticForm) -> Callable[[float], str]:
        """Return a function of u: that place on the curve in words, as power or as opening."""
        if form.input_exponent == 0.0:
            return '{:.1f} % opening'.format
        knots = self.base.knots
        return lambda u: f'{self.base.static(np.clip([u], knots[0], knots[-1]))[0]:.0f} MW'

    def without_causes(self) -> Extended:
        """Return the model without its causes."""
        return replace(self, active=())

    def with_cause(self, added: FittedCause) -> Extended:
        """Return the model with one more cause."""
        return replace(self, active=(*self.active, added))

    def without(self, name: str) -> Extended:
        """Return the model without a cause."""
        return replace(self, active=tuple(a for a in self.active if a.name != name))

    def having(self, changed: FittedCause) -> Extended:
        """Return the model with other values for one of its causes."""
        return replace(
            self, active=tuple(changed if a.name == changed.name else a for a in self.active)
        )


def _input(grids: Grids, model: Extended) -> FloatArray:
    """Return u for the opening with its causes applied; the last few results are cached."""
    chain = sorted(model.at(Stage.OPENING), key=lambda a: a.cause.order)
    if not chain:
        return grids.u
    # By the function, not by the name: the path of a plug may be held, or one of several drawn.
    key = tuple((a.cause.act, a.values, a.extra) for a in chain)
    u = grids.cache.get(key)
    if u is None:
        v = grids.v
        for a in chain:
            v = a.cause.act(v, a.values, grids)
        # Other threads use the cache too.
        inputs = [k for k in list(grids.cache) if isinstance(k, tuple)]
        if len(inputs) >= _REMEMBERED:
            grids.cache.pop(inputs[0], None)
        u = np.where(grids.usable > 0, grids.coarse(v * grids.density), 0.0)
        grids.cache[key] = u
    return u


def drive(grids: Grids, model: Extended) -> Drive:
    """Return the inputs of the curve and the changes of its output."""
    u, scale = _input(grids, model), grids.scale
    for a in model.at(Stage.INPUT):
        factor = a.cause.act(u, a.values, grids, model.base)
        if acts_on_scale(a, grids.form):
            scale = scale * factor
        else:
            u = u * factor
    added: FloatArray | None = None
    for a in model.at(Stage.FLOW):
        part = a.cause.act(u, a.values, grids)
        added = part if added is None else added + part
    gain: FloatArray | None = None
    for a in model.at(Stage.GAIN):
        factor = a.cause.act(a.values, grids, a.extra)
        gain = factor if gain is None else gain * factor
    return Drive(u, scale, added, gain)


def acts_on_scale(a: FittedCause, form: StaticForm) -> bool:
    """Return True if a cause changes p^e, not u: a cause of the pressure in a form with e."""
    return form.scaled and a.cause.family == 'nozzle'


def flow_of(model: Extended, driven: Drive) -> FloatArray:
    """Return the steam power x in MW, shape (n,)."""
    x = np.empty(len(driven.u))
    m = model.base
    kernels.flow(driven.u, driven.scale, m.offset, m.knots, m.left, m.right, x)
    if driven.added is not None:
        x += driven.added
    if driven.gain is not None:
        x *= driven.gain
    return x


def region_path(model: Extended, x: FloatArray) -> ByteArray:
    """Return the region of every model row."""
    out = np.empty(len(x), dtype=np.uint8)
    kernels.regions(x, model.regional.levels, out)
    return out


def answer(
    grids: Grids, model: Extended, driven: Drive | None = None, path: ByteArray | None = None
) -> FloatArray:
    """Return the predicted means of the power in MW, shape (m,).

    Parameters
    ----------
    driven : Drive, optional
        For this model, if already computed.
    path : uint8 (n,), optional
        Fixed regions of the rows. They must not change during differentiation: the derivative
        would have spikes.
    """
    x = flow_of(model, driven if driven is not None else drive(grids, model))
    if path is None:
        path = region_path(model, x)
    shown = sorted(model.at(Stage.OUTPUT), key=lambda a: a.cause.order)
    return _measured(grids, model, x, path, shown)


def response(grids: Grids, model: Extended, change: FloatArray, path: ByteArray) -> FloatArray:
    """Return what a small change of x, (n,), makes of the means of the power, (m,)."""
    return _measured(grids, model, change, path, lags_of(model))


def lags_of(model: Extended) -> list[FittedCause]:
    """Return the causes that delay the power; others only add to it."""
    late = [a for a in model.at(Stage.OUTPUT) if a.cause.family == 'lag']
    return sorted(late, key=lambda a: a.cause.order)


def _measured(
    grids: Grids, model: Extended, x: FloatArray, path: ByteArray, causes: list[FittedCause]
) -> FloatArray:
    group = 1 if causes else grids.group
    y = np.empty(len(x) // group)
    taps = model.regional.taps(grids.step_s)
    kernels.respond_means(x, grids.usable, path, taps, group, y)
    return means_through(grids, causes, y) if causes else y


def means_through(grids: Grids, causes: list[FittedCause], y: FloatArray) -> FloatArray:
    """Return the means, (m,), of a power y, (n,), after causes that change it.

    Causes that delay the power also work on a table, (n, k).
    """
    for a in causes:
        y = a.cause.act(y, a.values, grids)
    return grids.means(y)


# An extended model as stored: with its start time and the reference values of its causes.


@dataclass(frozen=True, slots=True)
class ExtendedModel:
    """The content of ``extended_model.json``.

    Attributes
    ----------
    model : Extended
    form : StaticForm
    start_ns : int
        Start time for drifts and onsets.
    reference : Reference
        Reference values of the record in which the causes were found.
    on_top_of : ExtendedModel, optional
        An earlier model: the causes of this one were found in rows from which the causes of
        the earlier one had been removed.
    output_unit : str
        MW, or the unit of a flow.
    """

    model: Extended
    form: StaticForm
    start_ns: int
    reference: Reference
    on_top_of: ExtendedModel | None = None
    output_unit: str = 'MW'

    @property
    def pressure_exponent(self) -> float:
        """Return q of u = V p^q."""
        return self.form.input_exponent

    @property
    def held(self) -> tuple[HeldCause, ...]:
        """Return the causes, those of the earlier model first."""
        earlier = () if self.on_top_of is None else self.on_top_of.held
        place = self.model.place_words(self.form)
        return earlier + tuple(
            HeldCause(
                a.name,
                tuple(a.named().items()),
                in_unit(a.sentence(self.start_ns, place=place), self.output_unit),
            )
            for a in self.model.active
        )

    def characteristic(self) -> Characteristic:
        """Return the curve of the plant without the causes; its uncertainty is not stored."""
        nan = math.nan
        return Characteristic(
            pressure_exponent=self.pressure_exponent,
            pieces=_pieces(self.model.base),
            breakpoint_intervals=tuple((nan, nan) for _ in self.model.base.left[1:]),
            choice=Choice('extended_model', {}, {}),
            source=FittedData(0, 0, 0, 0, 0, nan, nan, False),
            residuals=ResidualStatistics(nan, nan, nan, nan, nan),
            dynamics=_dynamics(
                self.model.base, self.form.scale(math.exp(self.reference.log_pressure))
            ),
            held=self.held,
            axis=self.form.axis,
            pressure_scale_exponent=self.form.scale_exponent,
            offset_mw=self.model.base.offset,
            reference_pressure_mpa=math.exp(self.reference.log_pressure),
            output_unit=self.output_unit,
        ).with_id()


def _pieces(m: RegionalModel) -> tuple[Piece, ...]:
    slopes, intercepts = m.slopes(), m.intercepts()
    return tuple(
        Piece(float(m.knots[k]), float(m.knots[k + 1]), float(slopes[k]), float(intercepts[k]),
              math.nan, math.nan, 0)
        for k in range(m.pieces)
    )  # fmt: skip


def _dynamics(m: RegionalModel, scale: FloatArray | float) -> tuple[RegionDynamics, ...]:
    flow = scale * np.concatenate([m.left, m.right]) + m.offset
    ends = [*flow.tolist(), *m.levels.tolist()]
    edges = [min(ends), *m.levels.tolist(), max(ends)]
    return tuple(
        RegionDynamics(
            edges[i], edges[i + 1], float(m.time_constants[i]), float(m.delays[i]),
            math.nan, math.nan,
        )
        for i in range(m.regions)
        if edges[i] < edges[i + 1]  # a level outside the curve gives an empty region
    )  # fmt: skip
