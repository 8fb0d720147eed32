# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pictures of the studies of the curve and of its alarm, from their results.

Run: ``python -m benchmarks.study_figures``. Each result that is there gets a picture beside it.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from benchmarks.study import RESULTS, plots

_KINDS = ('slope', 'intercept', 'knee', 'time_constant', 'delay')
_BLUE, _ORANGE, _GREY = '#2b7bba', '#d9822b', '#777777'


def _coverage(result: dict[str, Any], pyplot: Any) -> Any:
    """Draw errors over standard errors against what chance would give."""
    from scipy.stats import norm

    figure, axes = pyplot.subplots(1, len(_KINDS), figsize=(15, 3.6), sharey=True)
    for axis, kind in zip(axes, _KINDS, strict=True):
        z = np.sort([v for r in result['rows'] for v in r['scores'].get(kind, [])])
        chance = norm.ppf((np.arange(len(z)) + 0.5) / len(z))
        axis.plot([-3.5, 3.5], [-3.5, 3.5], color=_GREY, lw=1)
        axis.axhspan(-1.96, 1.96, color=_BLUE, alpha=0.1)
        axis.plot(chance, z, '.', ms=3, color=_BLUE)
        share = result['summary'][kind]['covered_95']
        axis.set_title(f'{kind.replace("_", " ")}: {100 * share:.1f} % of {len(z)}', fontsize=10)
        axis.set_xlabel('sd, if errors were normal')
        axis.set_ylim(-5, 5)
    axes[0].set_ylabel('error / standard error')
    figure.suptitle(
        f'{result["summary"]["plants"]} simulated plants: share of 95 % intervals with the truth'
    )
    return figure


def _paper(result: dict[str, Any], pyplot: Any) -> Any:
    """Draw each seed's largest errors, of the published curve and of the partition's."""
    figure, axes = pyplot.subplots(1, 3, figsize=(12, 3.6))
    shown = (
        ('slope', 'largest slope error (MW per unit of u)'),
        ('knee', 'largest knee error (units of u)'),
        ('curve_rmse_mw', 'rms error of the curve (MW)'),
    )
    for axis, (name, words) in zip(axes, shown, strict=True):
        for which, colour, label in (
            ('partition', _ORANGE, "exact partition, the paper's rule"),
            ('published', _BLUE, 'published curve'),
        ):
            values = sorted(r[which][name] for r in result['rows'] if name in r[which])
            axis.plot(values, np.arange(1, len(values) + 1), 'o-', ms=4, color=colour, label=label)
        axis.set_xlabel(words)
        axis.set_xlim(left=0)
    axes[0].set_ylabel('plants at most this wrong')
    axes[0].legend(fontsize=8)
    figure.suptitle("The paper's simulation study, ten days, other seeds")
    return figure


def _alarm(result: dict[str, Any], pyplot: Any) -> Any:
    """Draw how soon shifts are found."""
    figure, axis = pyplot.subplots(figsize=(7, 4))
    for size, colour in (('3', _BLUE), ('1', _ORANGE)):
        delays = np.sort([v for r in result['plants'] for v in r[f'delay_min_{size}_sd']])
        axis.plot(
            delays, np.arange(1, len(delays) + 1) / len(delays), color=colour,
            label=f'shift of {size} sd of a block: median {np.median(delays):.0f} min',
        )  # fmt: skip
    summary = result['summary']
    axis.set_xscale('log')
    axis.set_xlabel('minutes until the alarm')
    axis.set_ylabel('share found')
    axis.set_title(
        f'{summary["false_alarms"]} false alarms in {summary["days_watched"]:g} clean days',
        fontsize=11,
    )
    axis.legend()
    return figure


def main() -> None:
    """Draw all."""
    pyplot = plots()
    for pattern, draw in (
        ('coverage_*.json', _coverage),
        ('paper_study_*.json', _paper),
        ('alarm_[0-9]*.json', _alarm),
    ):
        for path in sorted(RESULTS.glob(pattern)):
            figure = draw(json.loads(path.read_text(encoding='utf-8')), pyplot)
            figure.tight_layout()
            figure.savefig(path.with_suffix('.png'), dpi=110)
            pyplot.close(figure)
            print(path.with_suffix('.png').name)


if __name__ == '__main__':
    main()
