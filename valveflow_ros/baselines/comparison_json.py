"""A comparison as JSON: what ``comparison.json`` holds."""

from __future__ import annotations

import math
from typing import Any

from valveflow_ros.baselines.comparison import Comparison, Line
from valveflow_ros.baselines.judged import JudgedSegment, Judgement
from valveflow_ros.baselines.library import NAMES
from valveflow_ros.baselines.paired import PairedTest
from valveflow_ros.baselines.sparse import SparseFit
from valveflow_ros.baselines.truth import CurveError
from valveflow_ros.baselines.verdict import Pair, finding_of
from valveflow_ros.records import SegmentKind

FORMAT = 'valveflow/comparison'
VERSION = 1


def number(value: float) -> float | None:
    """JSON has neither NaN nor infinity: absent is null."""
    return float(value) if math.isfinite(value) else None


def paired_json(test: PairedTest) -> dict[str, Any]:
    """Return a test."""
    return {
        'mean': number(test.mean),
        'stderr': number(test.stderr),
        't': number(test.t),
        'p_value': number(test.p_value),
        'effective': number(test.effective),
    }


def segment_json(segment: JudgedSegment) -> dict[str, Any]:
    """Return one special segment with the scores of all predictions."""
    return {
        'number': segment.number,
        'kind': segment.kind.name.lower(),
        'start_ns': segment.start_ns,
        'end_ns': segment.end_ns,
        'samples': len(segment.rows),
        'power_mw': segment.power_mw,
        'scores': {
            name: {
                'mse_mw2': number(score.mse_mw2),
                'each_sample': paired_json(score.samples),
                'correlation_counted': paired_json(score.effective),
            }
            for name, score in segment.scores.items()
        },
    }


def total_json(judgement: Judgement, name: str) -> dict[str, Any]:
    """Return one prediction over all segments."""
    each, of_each = judgement.passed(name, as_paper=True)
    counted, of_counted = judgement.passed(name, as_paper=False)
    return {
        'mse_mw2': number(judgement.mse(name)),
        'mse_steady_mw2': number(judgement.mse(name, SegmentKind.STEADY)),
        'mse_slope_mw2': number(judgement.mse(name, SegmentKind.SLOPE)),
        'mean_difference_mw': paired_json(judgement.bias(name)),
        'zero_stands': {
            'each_sample': {'segments': each, 'of': of_each},
            'correlation_counted': {'segments': counted, 'of': of_counted},
        },
        'segments_not_finite': judgement.failed(name),
    }


def _line_json(line: Line) -> list[dict[str, float]]:
    return [
        {
            'u_from': float(line.knots[j]),
            'u_to': float(line.knots[j + 1]),
            'slope': float(line.slopes[j]),
            'intercept': float(line.intercepts[j]),
        }
        for j in range(len(line.slopes))
    ]


def _methods(c: Comparison) -> dict[str, Any]:
    methods: dict[str, Any] = {
        name: {'pieces': _line_json(line)} for name, line in c.lines.items()
    }
    methods['proposed'] |= {
        'model_id': c.characteristic.model_id,
        'dynamics': [
            {
                'power_from': d.power_from,
                'power_to': d.power_to,
                'time_constant_s': d.time_constant_s,
                'delay_s': d.delay_s,
            }
            for d in c.characteristic.dynamics
        ],
    }
    m = c.hammerstein.model
    methods['hammerstein'] |= {
        'numerator': m.b.tolist(),
        'denominator': [1.0, *m.denominator.tolist()],
        'delay_s': m.delay * m.step_s,
        'step_s': m.step_s,
        'time_constants_s': m.time_constants_s.tolist(),
        'noise': c.hammerstein.noise,
        'tried': [
            {'taps': n_b, 'poles': n_f, 'noise': noise, 'mse_mw2': number(mse)}
            for n_b, n_f, noise, mse in c.hammerstein.tried
        ],
    }
    methods['sparse'] = {'failure': c.failure} if c.sparse is None else _sparse(c.sparse)
    return methods


def _sparse(s: SparseFit) -> dict[str, Any]:
    return {
        'functions': dict(zip(NAMES, s.model.xi.tolist(), strict=True)),
        'form': s.form.kind,
        'window_s': s.form.window_s,
        'threshold': s.threshold,
        'tried': [
            {'form': kind, 'window_s': window, 'functions': terms, 'mse_mw2': number(mse)}
            for kind, window, terms, mse in s.mse_by_form
        ],
    }


def _pair_json(pair: Pair) -> dict[str, Any]:
    return {
        'terms': pair.terms.value,
        'ours': pair.ours,
        'theirs': pair.theirs,
        'mse_ours_mw2': number(pair.mse_ours_mw2),
        'mse_theirs_mw2': number(pair.mse_theirs_mw2),
        'theirs_less_ours': paired_json(pair.test),
        'segments_not_finite': pair.failed,
        'ours_is': pair.outcome.value,
    }


def _error_json(error: CurveError) -> dict[str, Any]:
    return {
        'rmse_mw': number(error.rmse_mw),
        'largest_mw': number(error.largest_mw),
        'known_share': error.known,
        'largest_slope_error': number(error.slope),
        'largest_knee_error': number(error.knee),
        'largest_intercept_error_mw': number(error.intercept),
    }


def to_json(c: Comparison) -> dict[str, Any]:
    """Return the content of ``comparison.json``, without the words."""
    j = c.judgement
    return {
        'format': FORMAT,
        'version': VERSION,
        'pressure_exponent': c.characteristic.pressure_exponent,
        'finding': finding_of(c.pairs).value,
        'methods': _methods(c),
        'pairs': [_pair_json(p) for p in c.pairs],
        'totals': {name: total_json(j, name) for name in c.predictions},
        'all_rows_mse_mw2': {name: number(v) for name, v in c.all_rows.items()},
        'errors_against_truth': {m: _error_json(e) for m, e in c.errors.items()} or None,
        'judged': {
            'segments': len(j.segments),
            'samples': j.samples,
            'samples_not_judged': j.outside,
            'samples_per_independent_value': j.widening,
        },
        'segments': [segment_json(s) for s in j.segments],
    }
