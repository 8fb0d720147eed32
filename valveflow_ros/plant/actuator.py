"""The actuator's faults as operators on a moving position, one sample after the other."""

from __future__ import annotations

import numpy as np

from valveflow_ros.jit import jit
from valveflow_ros.plant.hooks import Bank
from valveflow_ros.records import FloatArray

# One remembered position each: after the rate limit, the stick-slip, the slack.
N_POSITIONS = 3


def settings(bank: Bank, step_s: float) -> FloatArray:
    """Return what `move` wants: largest step, slip-off and slip-to distance, top, half slack."""
    off = (bank.band_percent + bank.jump_percent) / 2.0
    to = (bank.band_percent - bank.jump_percent) / 2.0
    return np.array(
        [
            bank.rate_percent_per_s * step_s,
            off,
            to,
            bank.top_percent,
            bank.slack_percent / 2.0,
        ]
    )


@jit
def rate_limited(wanted: float, before: float, largest: float) -> float:
    """Move towards ``wanted`` by at most ``largest``."""
    if wanted > before + largest:
        return before + largest
    if wanted < before - largest:
        return before - largest
    return wanted


@jit
def stick_slip(wanted: float, before: float, off: float, to: float) -> float:
    """Stay until the pull exceeds ``off`` = (S + J)/2, then slip to ``to`` = (S - J)/2 from it.

    He's two-parameter form of the stick band S and the slip jump J; without a
    jump it is a dead band of width S.
    """
    pull = wanted - before
    if pull > off:
        return wanted - to
    if pull < -off:
        return wanted + to
    return before


@jit
def play(wanted: float, before: float, half: float) -> float:
    """Follow only when pushed by either flank of a slack of width ``2 half``."""
    return min(max(before, wanted - half), wanted + half)


@jit
def move(wanted: float, positions: FloatArray, bank: FloatArray) -> float:
    """Return where a bank lets the position go, remembering its inner positions.

    Servo first, then the friction of the stem, its upper stop, the slack of the linkage.
    """
    positions[0] = rate_limited(wanted, positions[0], bank[0])
    positions[1] = stick_slip(positions[0], positions[1], bank[1], bank[2])
    positions[2] = play(min(positions[1], bank[3]), positions[2], bank[4])
    return float(positions[2])
