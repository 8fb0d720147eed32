# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated flow, pressure and level loops under PI control, with and without a sticking valve.

They are for fixing and trying thresholds of `valveflow_ros.diagnosis.loop`; nothing in them was
taken from the measured loops but their length and step. The valve is direct or reverse acting. It
sticks as He's two-parameter model says, which the method itself fits, or as Kano's (M. Kano,
H. Maruta, H. Kugemoto, K. Shimizu, "Practical model and detection algorithm for valve stiction",
IFAC DYCOPS 2004), which it does not know.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from valveflow_ros.numerics import jit
from valveflow_ros.plant.loop import stick_slip
from valveflow_ros.records import FloatArray

ROWS, STEP_S = 751, 10.0
_SETTLE_S = 3000
HE, KANO = 'he', 'kano'
NULLS = ('quiet', 'setpoint', 'sine', 'random', 'tight', 'all')
KINDS = ('flow', 'pressure', 'level')


@dataclass(frozen=True)
class Loop:
    """What a historian has of a loop, and what is true of it.

    Attributes
    ----------
    command, response, setpoint : float64 (ROWS,)
        Controller output in %, measured variable and its set point in its unit.
    kind, case : str
        Of `KINDS`; of `NULLS`.
    band, jump : float
        S and J in %, 0 where the valve is sound.
    """

    command: FloatArray
    response: FloatArray
    setpoint: FloatArray
    kind: str
    case: str
    band: float
    jump: float

    @property
    def truth(self) -> str:
        """Return the catalogue's name, empty for a sound valve."""
        if self.band == 0.0:
            return ''
        return 'backlash' if self.jump == 0.0 else 'stiction'


@jit
def _kano(wanted: float, before: float, stick: FloatArray, memory: FloatArray) -> float:
    """Move a valve of Kano's model; memory: the last command, that of the rest, way, resting."""
    band, jump = stick[0] + stick[1], stick[0] - stick[1]
    last, place, way, resting = memory
    step = wanted - last
    if resting == 0.0 and step * way <= 0.0:
        place, resting = last, 1.0
    gone = way * (wanted - place)
    if resting == 1.0 and -gone > band:
        way, resting = -way, 0.0
    elif resting == 1.0 and gone > jump:
        resting = 0.0
    memory[:] = (wanted, place, way, resting)
    return before if resting == 1.0 else wanted - way * stick[1]


@jit
def _run(
    process: FloatArray, pi: FloatArray, stick: FloatArray, sp: FloatArray,
    load: FloatArray, noise: FloatArray, pv: FloatArray, op: FloatArray,
) -> None:  # fmt: skip
    """Run a loop second by second.

    ``process``: gain, time constant, integrating rate (0: self-regulating), delay, filter,
    largest change of the measured value a second. ``pi``: gain and reset time. ``stick``:
    slip-off and slip-to distance, and 1 for Kano's model. ``load`` is added to the plug's opening.
    """
    gain, lag, integrating, delay, smooth, slew = process
    line = np.zeros(int(delay) + 1)
    plug, flow, level, seen, out = 0.0, 0.0, 0.0, 0.0, 0.0
    integral = 0.0
    memory = np.array([0.0, 0.0, 1.0, 1.0])
    for t in range(sp.size):
        error = sp[t] - seen
        integral += pi[0] * error / pi[1]
        out = pi[0] * error + integral
        if out > 50.0 or out < -50.0:
            integral += (50.0 if out > 0 else -50.0) - out
            out = 50.0 if out > 0 else -50.0
        if stick[2] == 1.0:
            plug = _kano(out, plug, stick, memory)
        else:
            plug = stick_slip(out, plug, stick[0], stick[1])
        line[t % line.size] = plug + load[t]
        late = line[(t + 1) % line.size]
        flow += (gain * late - flow) / max(lag, 1.0)
        level += integrating * flow
        true = level if integrating > 0.0 else flow
        moved = (true + noise[t] - seen) / max(smooth, 1.0)
        seen += min(max(moved, -slew), slew)
        pv[t] = seen
        op[t] = out


def _process(rng: np.random.Generator, kind: str) -> FloatArray:
    """Draw gain, time constant, integrating rate, delay, filter in seconds."""
    u = rng.uniform
    if kind == 'flow':
        return np.array([u(0.4, 3), u(1, 8), 0.0, u(0, 4), u(1, 6), np.inf])
    if kind == 'pressure':
        return np.array([u(0.2, 2), np.exp(u(2, 4.5)), 0.0, u(0, 15), u(1, 6), np.inf])
    rate = 1.0 / np.exp(u(np.log(100), np.log(3000)))
    return np.array([1.0, u(1, 15), rate, u(0, 10), u(1, 20), np.inf])


def _ultimate(p: FloatArray, reset: float) -> float:
    """Return the gain at which a loop with this reset time just oscillates."""
    w = np.geomspace(1e-5, 1.0, 4000)
    s = 1j * w
    g = p[0] / (p[1] * s + 1) * np.exp(-s * (p[3] + 1.0)) / (p[4] * s + 1)
    if p[2] > 0.0:
        g = g * p[2] / s
    g = g * (1 + 1 / (reset * s))
    phase = np.unwrap(np.angle(g))
    over = np.flatnonzero(phase <= -np.pi)
    k = over[over > 0][0] if np.any(over > 0) else len(w) - 1
    return float(1.0 / np.abs(g[k]))


def _controller(rng: np.random.Generator, p: FloatArray, tight: bool) -> FloatArray:
    """Draw a PI controller: sound, or so tight that the loop nearly oscillates by itself."""
    slow = p[1] + p[3] + p[4] + 1.0
    if p[2] > 0.0:
        closed = np.exp(rng.uniform(np.log(4), np.log(20))) * slow
        gain, reset = 2.0 / (p[2] * p[0] * closed), rng.uniform(1.5, 4.0) * closed
        if tight and rng.random() < 0.5:  # a reset too short for the gain swings slowly
            damping = rng.uniform(0.04, 0.15)
            gain *= rng.uniform(0.1, 0.6)
            return np.array([gain, 4.0 * damping**2 / (gain * p[2] * p[0])])
    else:
        reset = max(p[1], p[4], 4.0) * rng.uniform(0.8, 2.0)
        gain = reset / (p[0] * (slow + np.exp(rng.uniform(0, 2.5)) * slow))
    most = _ultimate(p, reset)
    gain = most * rng.uniform(0.85, 0.98) if tight else min(gain, 0.5 * most)
    return np.array([gain, reset])


def _wander(rng: np.random.Generator, n: int, memory_s: float) -> FloatArray:
    """Return a first-order wander of standard deviation 1."""
    a = np.exp(-1.0 / memory_s)
    out = lfilter([np.sqrt(1 - a * a)], [1.0, -a], rng.standard_normal(n + 2000))
    return np.asarray(out[2000:])


def _excitation(
    rng: np.random.Generator, case: str, n: int, size: float, scale: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Draw load in % of opening, set point and noise in the unit of the response."""
    some = case == 'all'
    load = 0.15 * size * _wander(rng, n, float(rng.uniform(50, 2000)))
    if case == 'random' or some:
        load += size * _wander(rng, n, float(np.exp(rng.uniform(2, 7))))
        load += size * np.cumsum(rng.standard_normal(n)) / np.sqrt(1800.0)
    if case == 'sine' or some:
        turn = 2 * np.pi / np.exp(rng.uniform(np.log(80), np.log(2400)))
        load += rng.uniform(1, 3) * size * np.sin(turn * np.arange(n) + rng.uniform(0, 6))
    sp = np.zeros(n)
    if case == 'setpoint' or some:
        for _ in range(rng.integers(1, 12)):
            sp[rng.integers(0, n) :] += rng.normal() * 4.0 * size * scale
        sp = sp - sp[0]
    noise = scale * np.exp(rng.uniform(np.log(0.02), np.log(0.6))) * rng.standard_normal(n)
    return load, sp, noise


def simulate_loop(seed: int, sticky: bool, model: str = HE) -> Loop:
    """Draw a loop and run it.

    Every seed gives one loop for each ``sticky``; its kind and its excitation are drawn. Odd ones
    are reverse acting.
    """
    rng = np.random.default_rng([seed, int(sticky)])
    kind = str(rng.choice(KINDS, p=[0.5, 0.2, 0.3]))
    case = str(rng.choice(NULLS))
    p = _process(rng, kind)
    pi = _controller(rng, p, case == 'tight' or (case == 'all' and rng.random() < 0.3))
    n = _SETTLE_S + int(ROWS * STEP_S)
    band = float(np.exp(rng.uniform(np.log(0.6), np.log(8.0)))) if sticky else 0.0
    jump = float(rng.choice([0.0, 1.0], p=[0.3, 0.7]) * rng.uniform(0.15, 1.0)) * band
    size = float(np.exp(rng.uniform(np.log(0.1), np.log(3.0))))  # of disturbances, in % opening
    scale = p[0] if p[2] == 0.0 else p[0] * p[2] * 60.0
    load, sp, noise = _excitation(rng, case, n, size, scale)
    if rng.random() < 0.15:
        p[5] = rng.uniform(0.05, 0.5) * scale
    pv, op = np.zeros(n), np.zeros(n)
    stick = np.array([0.5 * (band + jump), 0.5 * (band - jump), float(model == KANO)])
    _run(p, pi, stick, sp, load, noise, pv, op)
    rows = _SETTLE_S + (np.arange(ROWS) * STEP_S).astype(np.int64)
    centre, offset = rng.uniform(30, 70), rng.uniform(0, 200)
    response = pv[rows] + offset
    if rng.random() < 0.5:  # a historian rounds
        grain = 10.0 ** np.floor(np.log10(max(float(np.std(response)), 1e-9) / 8.0))
        response = np.round(response / grain) * grain
    command = op[rows] + centre
    if seed % 2:  # a valve that opens when the output falls
        command = 100.0 - command
    return Loop(command, response, sp[rows] + offset, kind, case, band, jump)
