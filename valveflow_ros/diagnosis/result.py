"""The diagnosis as a record: verdict, causes, proof."""

from __future__ import annotations

from dataclasses import dataclass

from valveflow_ros.diagnosis.estimate import Estimate
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.gain import Gain, SegmentGain
from valveflow_ros.diagnosis.scene import Reference

NAMED, NOTHING, UNEXPLAINED = 'named', 'nothing', 'unexplained'


@dataclass(frozen=True, slots=True)
class NamedCause:
    """A cause with its parameters and what it is worth on sealed blocks."""

    name: str
    sentence: str
    parameters: dict[str, Estimate]
    gain: Gain
    experiment: str = ''
    not_told_apart: tuple[str, ...] = ()
    switches_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A slow wander that is no cause."""

    rms_mw: float
    time_scale_s: float


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the simulation gets wrong, why, and what the extended model is worth.

    Attributes
    ----------
    verdict : str
        'named', 'nothing' or 'unexplained'.
    sentence : str
        For an operator.
    causes : tuple of NamedCause
        In the order found; faults of the record come last.
    not_told_apart : tuple of str
        Causes these data cannot tell from the ones named.
    experiments : tuple of str
        What would tell them apart.
    disturbance : Disturbance or None
    unexplained_by : tuple of str
    rejected : tuple of (name, reason)
    rmse_simulation, rmse_extended, rmse_noise_floor : float
        MW, on sealed blocks.
    segments : tuple of SegmentGain
    simulation, extended : Extended
        Without and with causes, fitted to the open blocks.
    final : Extended
        With causes, fitted to everything: the model to go on with.
    reference : Reference
        What its causes count from.
    notes : tuple of str
    """

    verdict: str
    sentence: str
    causes: tuple[NamedCause, ...]
    not_told_apart: tuple[str, ...]
    experiments: tuple[str, ...]
    disturbance: Disturbance | None
    unexplained_by: tuple[str, ...]
    rejected: tuple[tuple[str, str], ...]
    rmse_simulation: float
    rmse_extended: float
    rmse_noise_floor: float
    segments: tuple[SegmentGain, ...]
    simulation: Extended
    extended: Extended
    final: Extended
    reference: Reference
    notes: tuple[str, ...] = ()
