"""The tables of a comparison as CSV, unrounded."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from valveflow_ros.baselines.judged import Judgement
from valveflow_ros.records import FloatArray
from valveflow_ros.report.comparison_data import METHODS, Compared
from valveflow_ros.report.comparison_tables import KIND

_PLACES = 500


def _csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table; what is not finite becomes an empty cell."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator='\n')
    writer.writerow(head)
    for row in rows:
        writer.writerow(['' if isinstance(v, float) and not math.isfinite(v) else v for v in row])
    return out.getvalue()


def segments_csv(judgement: Judgement, names: Sequence[str]) -> str:
    """Return one row a special segment (Table III)."""
    head = ['segment', 'kind', 'start_ns', 'end_ns', 'samples', 'power_mw']
    for name in names:
        head += [
            f'{name}.{column}'
            for column in ('mse_mw2', 'mean_mw', 't', 'p', 'samples_effective', 't_effective',
                           'p_effective')
        ]  # fmt: skip
    rows = []
    for s in judgement.segments:
        row: list[object] = [
            s.number, KIND[s.kind], s.start_ns, s.end_ns, len(s.rows), s.power_mw,
        ]  # fmt: skip
        for name in names:
            score = s.scores[name]
            row += [
                score.mse_mw2, score.samples.mean, score.samples.t, score.samples.p_value,
                score.effective.effective, score.effective.t, score.effective.p_value,
            ]  # fmt: skip
        rows.append(row)
    return _csv(head, rows)


def parameters_csv(data: Compared) -> str:
    """Return one row a piece (Table II, and IV where the truth is known)."""
    truth = data.result.truth
    rows: list[list[object]] = []
    for method in METHODS:
        line = data.result.lines.get(method)
        for j in range(0 if line is None else len(line.slopes)):
            assert line is not None
            same = truth is not None and len(truth.slopes) == len(line.slopes)
            true = [truth.slopes[j], truth.intercepts[j]] if truth and same else [math.nan] * 2
            rows.append(
                [
                    method, j + 1, *(float(v) for v in (line.slopes[j], line.intercepts[j],
                                                        line.knots[j], line.knots[j + 1])),
                    *(float(v) for v in true),
                ]
            )  # fmt: skip
    head = ['method', 'piece', 'slope', 'intercept', 'u_from', 'u_to', 'true_slope',
            'true_intercept']  # fmt: skip
    return _csv(head, rows)


def curves_csv(data: Compared) -> str:
    """Return the curves of all methods at evenly spaced inputs (Figs. 7 and 11)."""
    curves = curves_of(data)
    return _csv(list(curves), zip(*(c.tolist() for c in curves.values()), strict=True))


def curves_of(data: Compared) -> Mapping[str, FloatArray]:
    """Return u and each method's curve there, MW; NaN where a method says nothing."""
    r = data.result
    ends = r.characteristic.breakpoints
    u = np.linspace(float(ends[0]), float(ends[-1]), _PLACES)
    curves: dict[str, FloatArray] = {'u': u}
    for method in METHODS:
        if method in r.methods:
            curves[method] = r.curve(method)(u)
    if r.truth is not None:
        curves['truth'] = r.truth(u)
    return curves
