"""What a chart was designed for; apart from its kernels, for whoever only reads models."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ChartDesign:
    """What a chart needs to know of the residual it watches.

    Attributes
    ----------
    block_s : float
        Length of a block.
    correlation : float
        From block to block, 0 <= correlation < 1.
    innovation_mw : float
        sd of a block mean given the one before.
    slack : tuple of float
        What each sum lets pass per block, in innovations: for small and for large shifts.
    limit : tuple of float
        Where each sum raises the alarm, in innovations.
    run_length_days : float
        Mean time between false alarms that the limits were set for.
    """

    block_s: float
    correlation: float
    innovation_mw: float
    slack: tuple[float, float]
    limit: tuple[float, float]
    run_length_days: float
