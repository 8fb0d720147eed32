"""The model that is fitted: a piecewise-linear curve and dynamics by region."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.records import ByteArray, FloatArray


@dataclass(frozen=True, slots=True)
class RegionalModel:
    """Curve F of eq. (2) and G_i of eq. (3).

    Attributes
    ----------
    knots : float64 (J + 1,)
        Boundaries of the pieces in % MPa^m; beyond the outer ones the outer pieces go on.
    left, right : float64 (J,)
        Flow in MW at the left and right end of each piece.
    levels : float64 (I - 1,)
        Flow in MW at which one region gives way to the next.
    time_constants, delays : float64 (I,)
        Seconds. ``I = 0`` (empty) means the dynamics are not known.
    """

    knots: FloatArray
    left: FloatArray
    right: FloatArray
    levels: FloatArray
    time_constants: FloatArray
    delays: FloatArray

    @property
    def pieces(self) -> int:
        """Return J."""
        return len(self.left)

    @property
    def regions(self) -> int:
        """Return I."""
        return len(self.time_constants)

    def slopes(self) -> FloatArray:
        """Return K_f, MW per unit of u, shape (J,)."""
        return np.asarray((self.right - self.left) / np.diff(self.knots))

    def intercepts(self) -> FloatArray:
        """Return C, MW at u = 0, shape (J,)."""
        return np.asarray(self.left - self.slopes() * self.knots[:-1])

    def static(self, u: FloatArray) -> FloatArray:
        """Evaluate F; NaN in gives NaN out."""
        piece = np.clip(np.searchsorted(self.knots, u, side='right') - 1, 0, self.pieces - 1)
        width = np.diff(self.knots)[piece]
        w = (u - self.knots[piece]) / width
        return np.asarray(self.left[piece] + (self.right - self.left)[piece] * w)

    def taps(self, step_s: float) -> FloatArray:
        """Return the filter of each region as the kernels want it, shape (I, 7)."""
        # A model that is only looked at can do without compiled code.
        from valveflow_ros.curve import regional_kernel as kernel

        return kernel.make_taps(self.time_constants, self.delays, step_s)

    def respond(
        self, u: FloatArray, usable: ByteArray, step_s: float, settle_s: float
    ) -> tuple[FloatArray, ByteArray]:
        """Return the dynamic prediction in MW and where it has settled, shapes (n,)."""
        answer = np.empty(len(u))
        settled = np.empty(len(u), dtype=np.uint8)
        from valveflow_ros.curve import regional_kernel as kernel

        kernel.respond(
            self.static(u), usable, self.levels, self.taps(step_s),
            round(settle_s / step_s), answer, settled,
        )  # fmt: skip
        return answer, settled

    def with_levels(self, levels: FloatArray) -> RegionalModel:
        """Return a copy that switches elsewhere."""
        return replace(self, levels=np.asarray(levels, dtype=np.float64))

    def pack(self) -> FloatArray:
        """Return the parameters in the order of the kernel's columns."""
        values = np.append(self.left[0], self.right)
        jumps = self.left[1:] - self.right[:-1]
        return np.concatenate(
            [values, self.knots[1:-1], jumps, np.log(self.time_constants), self.delays]
        )

    def unpack(self, parameters: FloatArray) -> RegionalModel:
        """Return the model with other parameters; the inverse of `pack`."""
        j, i = self.pieces, self.regions
        values, rest = parameters[: j + 1], parameters[j + 1 :]
        inner, jumps, rest = rest[: j - 1], rest[j - 1 : 2 * j - 2], rest[2 * j - 2 :]
        knots = self.knots.copy()
        knots[1:-1] = inner
        left = values[:-1].copy()
        left[1:] += jumps
        return replace(
            self, knots=knots, left=left, right=values[1:].copy(),
            time_constants=np.exp(rest[:i]), delays=rest[i:].copy(),
        )  # fmt: skip
