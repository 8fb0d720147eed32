"""The loops of the extended model row by row, with what is remembered between blocks.

States are arrays that the caller owns and the loops write. ``begin`` says of every row how it
follows the one before: `GOES_ON`, `ANEW` after a gap, or `NO_DATA`.
"""

from __future__ import annotations

import numpy as np

from valveflow_ros.curve.regional_kernel import TAP_0, TAP_1, TAP_2, TAP_A, TAP_WHOLE, region_of
from valveflow_ros.diagnosis.kernels import play_step, rate_step, slip_step
from valveflow_ros.jit import jit
from valveflow_ros.records import NS_PER_S, ByteArray, FloatArray, IntArray

GOES_ON, ANEW, NO_DATA = 0, 1, 2
AGE, PLACE = 0, 1


@jit
def beginnings(
    time_ns: IntArray, u: FloatArray, gap_ns: int, state: IntArray, jumps: ByteArray,
    begin: ByteArray,
) -> None:  # fmt: skip
    """Write where time jumps, and how each row follows the one before.

    ``state`` holds the time of the last row and how that one began.
    """
    for t in range(time_ns.size):
        step = time_ns[t] - state[0]
        state[0] = time_ns[t]
        jumps[t] = 1 if step > gap_ns or step <= 0 else 0
        if np.isnan(u[t]):
            state[1] = NO_DATA
        else:
            state[1] = ANEW if jumps[t] or state[1] == NO_DATA else GOES_ON
        begin[t] = state[1]


@jit
def respond(
    x: FloatArray,
    begin: ByteArray,
    levels: FloatArray,
    taps: FloatArray,
    place: IntArray,
    answer: FloatArray,
    past: FloatArray,
    out: FloatArray,
) -> None:
    """Filter the flow by the taps of the region each row lies in; a gap begins in equilibrium.

    ``past`` is a ring of flows, ``place`` the rows since the gap and the place in the ring,
    ``answer`` (1,) the filter's state.
    """
    room = past.size
    for t in range(x.size):
        if begin[t] == NO_DATA:
            out[t] = np.nan
            continue
        if begin[t] == ANEW:
            place[AGE] = 0
            answer[0] = x[t]
        age, at = place[AGE], place[PLACE]
        past[at] = x[t]
        tap = taps[region_of(x[t], levels)]
        whole = int(tap[TAP_WHOLE])
        answer[0] = (
            tap[TAP_A] * answer[0]
            + tap[TAP_0] * past[(at - min(whole, age)) % room]
            + tap[TAP_1] * past[(at - min(whole + 1, age)) % room]
            + tap[TAP_2] * past[(at - min(whole + 2, age)) % room]
        )
        out[t] = answer[0]
        place[AGE] = age + 1
        place[PLACE] = (at + 1) % room


@jit
def lag(
    x: FloatArray, begin: ByteArray, taps: FloatArray, state: FloatArray, out: FloatArray
) -> None:
    """Pass a series through one first-order lag; ``state`` is its answer and the last value."""
    for t in range(x.size):
        if begin[t] == NO_DATA:
            out[t] = np.nan
            continue
        if begin[t] == ANEW:
            state[0] = state[1] = x[t]
        state[0] = taps[TAP_A] * state[0] + taps[TAP_1] * state[1] + taps[TAP_0] * x[t]
        state[1] = x[t]
        out[t] = state[0]


@jit
def delay(
    y: FloatArray, jumps: ByteArray, whole: int, part: float, place: IntArray, past: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Write what a series was ``whole + part`` rows ago, NaN where that is not known."""
    room = past.size
    for t in range(y.size):
        if jumps[t]:
            place[AGE] = 0
        age, at = place[AGE], place[PLACE]
        past[at] = y[t]
        out[t] = np.nan
        if part == 0.0 and age >= whole:
            out[t] = past[(at - whole) % room]
        elif age >= whole + 1:
            late, later = past[(at - whole) % room], past[(at - whole - 1) % room]
            out[t] = late * (1.0 - part) + later * part
        place[AGE] = age + 1
        place[PLACE] = (at + 1) % room


@jit
def play(v: FloatArray, half: float, state: FloatArray, out: FloatArray) -> None:
    """Follow ``v`` only where one flank of a slack pushes; NaN is passed."""
    for t in range(v.size):
        out[t] = np.nan
        if not np.isnan(v[t]):
            out[t] = state[0] = play_step(state[0], v[t], half)


@jit
def rate_limit(
    v: FloatArray, time_ns: IntArray, rate_per_s: float, state: FloatArray, last_ns: IntArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Follow ``v`` at no more than a rate; through a gap the plug moves on unseen."""
    for t in range(v.size):
        out[t] = np.nan
        if not np.isnan(v[t]):
            largest = rate_per_s * ((time_ns[t] - last_ns[0]) / NS_PER_S)
            out[t] = state[0] = rate_step(state[0], v[t], largest)
            last_ns[0] = time_ns[t]


@jit
def stick_slip(
    v: FloatArray, noise: FloatArray, band: float, jump: float, state: FloatArray, out: FloatArray
) -> None:
    """Write the mean place of plugs that each feel the position with a noise of their own.

    ``noise`` is (n, draws), ``state`` (draws,).
    """
    off, near = 0.5 * (band + jump), 0.5 * (band - jump)
    draws = state.size
    for t in range(v.size):
        out[t] = np.nan
        if np.isnan(v[t]):
            continue
        total = 0.0
        for d in range(draws):
            here = v[t] + noise[t, d]
            state[d] = here if np.isnan(state[d]) else slip_step(state[d], here, off, near)
            total += state[d]
        out[t] = total / draws


@jit
def filled(x: FloatArray, last: FloatArray, out: FloatArray) -> None:
    """Write a series in which the last value stands for a missing one; ``last`` is (1,)."""
    for t in range(x.size):
        if not np.isnan(x[t]):
            last[0] = x[t]
        out[t] = last[0]
