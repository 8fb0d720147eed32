"""Hammerstein identification as its literature does it, tuned on data of its own.

Knots, values and one linear block are estimated together by the prediction
error over all rows: what ``nlhw`` of the System Identification Toolbox does, to
which the paper compares (Section IV). Starts come from several sets of knots;
orders and delay are searched; orders and the model of the noise are chosen by how
well the last part of the identification data is simulated from the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.baselines.hammerstein import HammersteinModel, tangents
from valveflow_ros.baselines.hammerstein_move import OUTPUT_ERROR, move, search_delay
from valveflow_ros.baselines.hammerstein_start import starts
from valveflow_ros.baselines.holdout import cut_samples, run_mse
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.whitening import fit_ar
from valveflow_ros.records import FloatArray

ORDERS = ((1, 1), (2, 2), (3, 3))  # taps n_b and poles n_f
_KEPT_STARTS = 3
_NEW_POLE = 0.5

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class HammersteinFit:
    """The model and how it was chosen.

    Attributes
    ----------
    model : HammersteinModel
    noise : str
        'output error' or 'autoregressive'.
    tried : tuple of (n_b, n_f, noise, mean squared error in MW^2 on the part held out)
    """

    model: HammersteinModel
    noise: str
    tried: tuple[tuple[int, int, str, float], ...]


def fit_hammerstein(
    samples: Samples, pieces: int, progress: Progress = lambda _: None
) -> HammersteinFit:
    """Identify a Hammerstein model of ``pieces`` pieces.

    Raises
    ------
    TooFewSamplesError
        Too few rows lie far enough behind a gap.
    """
    learn, judge = cut_samples(samples)
    progress('Hammerstein model: starts')
    coarse = _at_coarse(learn, pieces)
    progress('Hammerstein model: orders')
    candidates = _orders(learn, coarse)
    tried = [(*_order(m), noise, run_mse(m, judge)) for noise, m in candidates]
    best = int(np.argmin([t[-1] for t in tried]))
    noise, model = candidates[best]
    progress('Hammerstein model: all data')
    model = _on_all(samples, model, noise)
    return HammersteinFit(model, noise, tuple(tried))


def _order(model: HammersteinModel) -> tuple[int, int]:
    return len(model.numerator) + 1, len(model.denominator)


def _at_coarse(samples: Samples, pieces: int) -> HammersteinModel:
    """Return the best of several starts, moved on coarse rows, at the step of the rows."""
    coarse = samples.coarser()
    moved = [move(coarse, s, OUTPUT_ERROR, 15) for s in starts(coarse, pieces)[:_KEPT_STARTS]]
    model, _ = min(moved, key=lambda pair: pair[1])
    factor = model.step_s / samples.step_s
    pole = np.maximum(-model.denominator, 1e-6) ** (1.0 / factor)
    return replace(
        model, denominator=-pole, delay=round(model.delay * factor), step_s=samples.step_s
    )


def _orders(samples: Samples, model: HammersteinModel) -> list[tuple[str, HammersteinModel]]:
    """Return a model of each order, each begun at the one before, under both noises."""
    found = []
    delayed = False
    for n_b, n_f in ORDERS:
        model, best = move(samples, grown(model, n_b, n_f), OUTPUT_ERROR, 12)
        if not delayed:
            model, best = search_delay(samples, model, OUTPUT_ERROR, best)
            delayed = True
        found.append(('output error', model))
        found.append(('autoregressive', _whitened(samples, model)))
    return found


def _noise_of(samples: Samples, model: HammersteinModel) -> FloatArray:
    residual, _, weight = tangents(samples, model, columns=0)
    return fit_ar(residual, weight)


def _whitened(samples: Samples, model: HammersteinModel) -> HammersteinModel:
    """Refit under an AR model of the noise, which is far from white."""
    return move(samples, model, _noise_of(samples, model), 8)[0]


def grown(model: HammersteinModel, n_b: int, n_f: int) -> HammersteinModel:
    """Add taps and poles that change nothing yet: a tap of 0, or a pole on a zero."""
    b, f = model.b, np.concatenate([[1.0], model.denominator])
    while len(f) - 1 < n_f and len(b) < n_b:
        f, b = np.convolve(f, [1.0, -_NEW_POLE]), np.convolve(b, [1.0, -_NEW_POLE])
    b = np.append(b, np.zeros(n_b - len(b)))
    f = np.append(f, np.zeros(n_f + 1 - len(f)))
    return replace(model, denominator=f[1:], numerator=b[1:])


def _on_all(samples: Samples, model: HammersteinModel, noise: str) -> HammersteinModel:
    """Refit on all rows."""
    u = samples.u[samples.usable > 0]
    knots = model.knots.copy()
    knots[0], knots[-1] = min(knots[0], u.min()), max(knots[-1], u.max())
    model = replace(model, knots=knots, values=model.static(knots))
    model, best = move(samples, model, OUTPUT_ERROR, 12)
    model, _ = search_delay(samples, model, OUTPUT_ERROR, best)
    return model if noise == 'output error' else _whitened(samples, model)
