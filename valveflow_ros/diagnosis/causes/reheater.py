"""Part of the power comes behind the reheater, which fills slowly.

The turbine models of IEEE (IEEEG1, TGOV1) split the power: a share is made in front
of the reheater at once, the rest follows its filling.

    y = alpha y1 + (1 - alpha) y1 / (1 + T s),  y1 = G x
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from valveflow_ros.curve.regional_kernel import make_taps
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.cause import Active, Cause, Kind, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.fitting import improve
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

_SLOW, _SWALLOWED, _SHORTEST, _STEPS = (0.3, 60.0), 0.7, 0.3, 5
_TRIED = tuple((alpha, t) for alpha in (0.2, 0.4, 0.7) for t in (8.0, 20.0, 60.0, 200.0))


def act(y: FloatArray, values: Values, scene: Scene) -> FloatArray:
    """Return the power shown."""
    alpha, time_s = values
    taps = make_taps(np.array([time_s]), np.zeros(1), scene.step_s)[0]
    late = np.empty(len(y))
    kernels.lag(y, scene.usable, taps, late)
    return np.asarray(alpha * y + (1.0 - alpha) * late)


def starts(bench: Bench) -> Sequence[Start]:
    """Try shares and time constants, and fit one with the whole model on a quicker base.

    The plain model took much of the lag for its own; its tangents do not lead out of that.
    """
    task, base = bench.task, bench.model.base
    alpha, time_s = _SLOW
    less = _SWALLOWED * (1.0 - alpha) * time_s
    quicker = np.maximum(base.time_constants - less, _SHORTEST * base.time_constants)
    model = replace(bench.model, base=replace(base, time_constants=quicker))
    model, cost = improve(task, model.with_cause(Active(CAUSE, _SLOW)), _STEPS)
    gain = (task.cost(bench.model) - cost) / (2.0 * bench.variance)
    fitted = Start(model.active[-1].values, gain, base=model.base)
    return [*bench.best(CAUSE, list(_TRIED), keep=1), *([fitted] if gain > 0.0 else [])]


def sentence(values: dict[str, float]) -> str:
    """Say it."""
    return (
        f'Only {100.0 * values["alpha"]:.0f} % of the power follow the valve at once; the rest '
        f'comes {values["time_s"]:.3g} s later, through the reheater.'
    )


CAUSE = Cause(
    'reheater', 'lag', Stage.OUTPUT,
    (
        # The same delayed area (1 - alpha) T looks nearly the same: no ellipse holds them.
        Unknown('alpha', '', 0.03, 0.0, 1.0, Kind.ROUGH),
        # One fills within seconds to a minute; a memory of hours is another thing.
        Unknown('time_s', 's', 1.0, 0.5, 300.0, Kind.ROUGH),
    ),
    act, starts, sentence, ('clock', 'region_lag', 'rate_limit'),
    'Steps of the opening at constant pressure, power logged every second: two slopes in the '
    'answer are a reheater.',
    order=1,
)  # fmt: skip
