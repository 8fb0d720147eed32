# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The picture of `segment_study`: an excerpt with truth and finding, and the scores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import segment_study as study
from benchmarks.segment_truth import true_stretches
from benchmarks.study import plots
from valveflow_ros.monitoring.rows import Rows
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate

_COLOURS = {1: '#2b7bba', 2: '#d9822b'}
_NAMES = {1: 'steady state', 2: 'slope response'}
_EXCERPT_H = (30.0, 42.0)


def draw(result: dict[str, Any], place: Path) -> None:
    """Write the picture."""
    plt = plots()
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(11, 8), gridspec_kw={'height_ratios': [3, 2]}, layout='constrained'
    )
    _excerpt(above, int(result['first_seed']))
    _scores(below, result)
    figure.savefig(place, dpi=110)
    plt.close(figure)


def _excerpt(axes: Any, seed: int) -> None:
    settings = Settings({})
    log = simulate(_EXCERPT_H[1] / 24.0 + 0.1, seed)
    true = true_stretches(log, seed, settings)
    found, _ = study.found_segments(log, settings)
    u = Rows.of(log.table, 1.125).u
    a, b = (int(3600 * h) for h in _EXCERPT_H)
    hours = np.arange(len(u)) / 3600.0
    axes.plot(hours[a:b:10], u[a:b:10], color='0.6', lw=0.8, label='integrated input u')
    low, high = float(u[a:b].min()), float(u[a:b].max())
    band = 0.05 * (high - low)
    for level, (stretches, name) in enumerate(((true, 'truth'), (found, 'found'))):
        at = low - (2.0 + 1.6 * level) * band
        axes.text(_EXCERPT_H[0] - 0.1, at + 0.5 * band, name, ha='right', va='center')
        for first, end, kind in stretches:
            if end > a and first < b:
                axes.fill_between(
                    [max(first, a) / 3600.0, min(end, b) / 3600.0], at, at + band,
                    color=_COLOURS[kind], lw=0,
                )  # fmt: skip
    for kind, name in _NAMES.items():
        axes.fill_between([], [], [], color=_COLOURS[kind], label=name)
    for first, end, kind in found:
        if end > a and first < b:
            x = np.arange(max(first, a), min(end, b), 10)
            axes.plot(hours[x], u[x], color=_COLOURS[kind], lw=1.6)
    axes.set_xlim(*_EXCERPT_H)
    axes.set_xlabel('hours')
    axes.set_ylabel('u (% MPa$^{9/8}$)')
    axes.set_title(
        f'Twelve hours of the simulated unit, seed {seed}: special segments', loc='left'
    )
    axes.legend(ncols=3, loc='upper left', frameon=False)
    axes.set_ylim(low - 4.5 * band, high + 3.0 * band)
    axes.set_yticks([t for t in axes.get_yticks() if low - band < t < high])


def _scores(axes: Any, result: dict[str, Any]) -> None:
    plants = result['plants']
    bars = [
        ('row_precision', 1, 'precision, steady'), ('row_recall', 1, 'recall, steady'),
        ('row_precision', 2, 'precision, slope'), ('row_recall', 2, 'recall, slope'),
    ]  # fmt: skip
    kind_of = {1: 'steady', 2: 'slope'}
    for k, (key, kind, name) in enumerate(bars):
        at = np.arange(len(plants)) + 0.19 * (k - 1.5)
        values = [p['learnt'][kind_of[kind]][key] or 0.0 for p in plants]
        rigid = [p['fixed'][kind_of[kind]][key] or 0.0 for p in plants]
        axes.bar(at, values, 0.17, color=_COLOURS[kind], alpha=1.0 if 'prec' in key else 0.5,
                 label=name)  # fmt: skip
        axes.scatter(at, rigid, marker='_', s=160, color='k', zorder=3,
                     label='with fixed thresholds' if k == 3 else None)  # fmt: skip
    axes.set_xticks(np.arange(len(plants)), [p['plant'] for p in plants])
    axes.set_ylim(0.0, 1.05)
    axes.set_ylabel('share of rows')
    axes.set_title('Precision and recall by rows, thresholds learnt from the data', loc='left')
    axes.legend(ncols=5, loc='upper center', bbox_to_anchor=(0.5, -0.1), frameon=False)
