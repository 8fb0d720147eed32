"""An extended model as it is kept: with the zero of its time and what its causes count from."""

from __future__ import annotations

import math
from dataclasses import dataclass

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    HeldCause,
    Piece,
    RegionDynamics,
    ResidualStatistics,
    Source,
)
from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.scene import Reference


@dataclass(frozen=True, slots=True)
class ExtendedModel:
    """What ``extended_model.json`` holds.

    Attributes
    ----------
    model : Extended
    pressure_exponent : float
        Of u in eq. (1).
    start_ns : int
        Time that drifts and onsets count from.
    reference : Reference
        Of the record the causes were found in.
    on_top_of : ExtendedModel, optional
        An earlier model: the causes of this one were found in rows that had been freed of
        the earlier ones.
    """

    model: Extended
    pressure_exponent: float
    start_ns: int
    reference: Reference
    on_top_of: ExtendedModel | None = None

    @property
    def held(self) -> tuple[HeldCause, ...]:
        """Return the causes, the earlier ones first."""
        earlier = () if self.on_top_of is None else self.on_top_of.held
        return earlier + tuple(
            HeldCause(a.name, tuple(a.named().items()), a.sentence(self.start_ns))
            for a in self.model.active
        )

    def characteristic(self) -> Characteristic:
        """Return the curve of the plant without the causes; how sure it is stands nowhere."""
        nan = math.nan
        return Characteristic(
            pressure_exponent=self.pressure_exponent,
            pieces=_pieces(self.model.base),
            breakpoint_intervals=tuple((nan, nan) for _ in self.model.base.left[1:]),
            choice=Choice('extended_model', {}, {}),
            source=Source(0, 0, 0, 0, 0, nan, nan, False),
            residuals=ResidualStatistics(nan, nan, nan, nan, nan),
            dynamics=_dynamics(self.model.base),
            held=self.held,
        ).with_id()


def _pieces(m: RegionalModel) -> tuple[Piece, ...]:
    slopes, intercepts = m.slopes(), m.intercepts()
    return tuple(
        Piece(float(m.knots[k]), float(m.knots[k + 1]), float(slopes[k]), float(intercepts[k]),
              math.nan, math.nan, 0)
        for k in range(m.pieces)
    )  # fmt: skip


def _dynamics(m: RegionalModel) -> tuple[RegionDynamics, ...]:
    ends = [*m.left.tolist(), *m.right.tolist(), *m.levels.tolist()]
    edges = [min(ends), *m.levels.tolist(), max(ends)]
    return tuple(
        RegionDynamics(
            edges[i], edges[i + 1], float(m.time_constants[i]), float(m.delays[i]),
            math.nan, math.nan,
        )
        for i in range(m.regions)
        if edges[i] < edges[i + 1]  # a level beyond the curve's ends leaves a region empty
    )  # fmt: skip
