# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis could reach at best: the true causes, begun at their true sizes and refitted.

It tells a cause that was missed from one that the record does not show, and a wrong name from one
that fits the record as well as the truth.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.diagnosis_cases import Case
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import FittedCause
from valveflow_ros.diagnosis.causes import causes_for
from valveflow_ros.diagnosis.diagnose import Record
from valveflow_ros.diagnosis.evidence import LEAST_GAIN, colour, inferred, rmse
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import Task, improve, settle
from valveflow_ros.diagnosis.grids import ORDER
from valveflow_ros.diagnosis.result import Diagnosis
from valveflow_ros.diagnosis.search import rebuilt, simplified

_LEAST_SHARE = 0.02  # of the squared error that the truth must remove for a share to be told


def best_of(case: Case, record: Record, model: RegionalModel, found: Diagnosis) -> dict[str, Any]:
    """Compare a diagnosis with the true causes.

    Returns
    -------
    dict
        ``each``: by name, the log-likelihood that a true cause gains over the model without it.
        ``found_gains``: log-likelihood of the diagnosis less that of the truth, open blocks.
        ``share``: of the squared error on the sealed blocks that the truth removes, the part that
        the diagnosis removes; None if there is little to remove. The summary has it for those
        records that were answered rightly.
    """
    grids = record.grids(record.faults()[0])
    task = Task(grids, grids.open_rows, np.zeros(ORDER), case.given)
    task, plain, _ = settle(task, Extended(model if case.given else simplified(model)), 2, 4)
    causes, truth = causes_for(grids), plain
    for effect in case.effects:
        unknowns = causes[effect.name].unknowns
        values = tuple(float(effect.parameters[u.name]) for u in unknowns)
        truth = truth.with_cause(FittedCause(causes[effect.name], values))
    everywhere = np.ones(grids.subs, dtype=bool)
    task, truth, _ = settle(task, inferred(task, truth, everywhere), 2, 4)
    if not case.given:
        task, truth = rebuilt(task, truth)
    truth = inferred(task, truth, everywhere)
    e = task.innovations(task.residual(truth))
    cost, scale = float(e @ e), 2.0 * float(e @ e) / len(e) * colour(task, e)
    each = {n: (improve(task, truth.without(n), 4)[1] - cost) / scale for n in truth.names}
    told = inferred(task, found.extended, everywhere)  # fitted to open blocks, as the truth
    before, best, reached = (
        rmse(task, m, grids.sealed_rows) ** 2 for m in (plain, truth, found.extended)
    )
    much = before - best > _LEAST_SHARE * before
    return {
        'each': {n: round(float(gain), 1) for n, gain in each.items()},
        'found_gains': round((cost - task.cost(told)) / scale, 1),
        'share': round((before - reached) / (before - best), 3) if much else None,
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how many records show all their causes, and what a diagnosis made of those."""
    rows = [r for r in rows if 'best' in r]
    visible = [r for r in rows if min(r['best']['each'].values()) >= LEAST_GAIN]
    wrong = [r for r in visible if not r['right']]
    shares = [r['best']['share'] for r in rows if r['right'] and r['best']['share'] is not None]
    return {
        'records': len(visible), 'right': len(visible) - len(wrong),
        'wrong_and_likelier': sum(r['best']['found_gains'] > 0.0 for r in wrong),
        'share': {'records': len(shares), 'median': round(float(np.median(shares)), 3),
                  'worst_tenth': round(float(np.quantile(shares, 0.1)), 3)} if shares else None,
    }  # fmt: skip
