# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pictures of the handbook, drawn from what ``docs.picture_data`` has kept.

Run: ``python -m docs.make_pictures [NAME ...]``. The same data give the same bytes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from scipy.stats import binomtest

from docs.page_claims import true_causes
from docs.picture_data import CASES, DATA
from valveflow_ros.diagnosis.evidence import LEAST_GAIN

mpl.use('svg')
from matplotlib import pyplot as plt

PICTURES = DATA.parent
# The colours of the report, told apart by all common kinds of colour blindness.
INK, MUTED, BAND, GRID = '#1b1f24', '#59636e', '#d9dde2', '#e6e9ed'
PLAIN, EXTENDED, UP, DOWN = '#b05a00', '#0067b1', '#d55e00', '#00876a'
_AXES = {
    'u': ('integrated input u (% MPa^9/8)', 1.0),
    'pressure given u': ('pressure off its usual line (MPa)', 1.0),
    'temperature': ('main steam temperature (°C)', 1.0),
    'time': ('days', 1.0 / 86400.0),
    'time of day': ('hour of the day (UTC)', 1.0 / 3600.0),
    'ramp': ('ramp: change of u in 3 min', 1.0),
    'direction': ('after closing  ←  last move  →  after opening', 1.0),
}
mpl.rcParams.update({
    'svg.fonttype': 'none', 'svg.hashsalt': 'valveflow', 'font.family': 'sans-serif',
    'font.size': 10, 'axes.spines.top': False, 'axes.spines.right': False,
    'axes.edgecolor': MUTED, 'axes.labelcolor': INK, 'xtick.color': MUTED, 'ytick.color': MUTED,
    'text.color': INK, 'axes.grid': True, 'grid.color': GRID, 'axes.axisbelow': True,
    'legend.frameon': False, 'legend.fontsize': 9, 'savefig.facecolor': 'white',
})  # fmt: skip


def _save(figure: Any, name: str) -> Path:
    path = PICTURES / f'{name}.svg'
    figure.savefig(path, metadata={'Date': None, 'Creator': None})
    plt.close(figure)
    return path


def _legend(axis: Any, columns: int) -> None:
    """Put the legend above the axes, where it hides no data."""
    axis.legend(loc='lower center', bbox_to_anchor=(0.5, 1.0), ncols=columns, columnspacing=1.2)


def _binned(axis: Any, variable: str, view: dict[str, list[float]]) -> None:
    label, scale = _AXES[variable]
    x = scale * np.array(view['middle'])
    order = np.argsort(x)
    x = x[order]
    chance = np.array(view['chance'])[order]
    axis.fill_between(x, -chance, chance, color=BAND, lw=0, label='chance, 99 %')
    axis.plot(x, np.array(view['before'])[order], 'o--', color=PLAIN, ms=3.5, label='plain model')
    axis.plot(x, np.array(view['after'])[order], 'o-', color=EXTENDED, ms=3.5,
              label='extended model')  # fmt: skip
    axis.set_xlabel(label)


def _moves(axis: Any, answers: list[dict[str, Any]]) -> None:
    if not answers:
        axis.text(0.5, 0.5, 'too few fast moves', ha='center', transform=axis.transAxes)
        return
    chance = max(a['chance'] for a in answers)
    axis.axhspan(-chance, chance, color=BAND, lw=0)
    for a in answers:
        way, colour = ('opening', UP) if a['up'] else ('closing', DOWN)
        axis.plot(a['time_s'], a['before'], '--', color=colour, label=f'{way}, plain')
        axis.plot(a['time_s'], a['after'], '-', color=colour, lw=2, label=f'{way}, extended')
    axis.set_xlabel('seconds after a fast move')


def _map(figure: Any, axis: Any, across: str, view: dict[str, Any]) -> None:
    label, scale = _AXES[across]
    cells = np.ma.masked_equal(np.array(view['before']), 0.0)
    most = float(np.abs(cells).max()) if cells.count() else 1.0
    drawn = axis.pcolormesh(scale * np.array(view['across']), np.array(view['up']), cells,
                            cmap='PuOr_r', vmin=-most, vmax=most, rasterized=True)  # fmt: skip
    axis.set_xlabel(label)
    axis.set_ylabel('u')
    axis.grid(visible=False)
    figure.colorbar(drawn, ax=axis, label='plain model, MW')


def effect(name: str) -> Path:
    """Draw the residual of one effect in the two views that tell most."""
    data = json.loads((DATA / f'{name}.json').read_text())
    views = data['views']
    if 'record' in views:
        return _record(name, views['record'])
    wanted = CASES[name].views
    figure, axes = plt.subplots(1, len(wanted), figsize=(9, 3.3))
    for axis, variable in zip(axes, wanted, strict=True):
        if variable.startswith('map '):
            _map(figure, axis, variable.removeprefix('map '), views[variable])
            continue
        axis.axhline(0.0, color=MUTED, lw=0.8)
        if variable == 'fast moves':
            _moves(axis, views[variable])
        else:
            _binned(axis, variable, views[variable])
        _legend(axis, 2 if variable == 'fast moves' else 3)
    axes[0].set_ylabel('measured − simulated (MW)')
    figure.suptitle(f'{name}: {data["parameters"].replace(",", ", ")}', fontsize=11)
    figure.tight_layout()
    return _save(figure, name)


def _record(name: str, view: dict[str, Any]) -> Path:
    figure, axis = plt.subplots(figsize=(9, 3.0))
    minutes = 60.0 * (np.array(view['hours']) - view['hours'][0])
    axis.plot(minutes, view['recorded'], '-', color=PLAIN, lw=1.2, label='recorded')
    axis.plot(minutes, view['true'], '-', color=EXTENDED, lw=1.0, alpha=0.8, label='the plant')
    axis.set_xlabel('minutes')
    axis.set_ylabel(f'{view["signal"].replace("_", " ")} ({view["unit"]})')
    _legend(axis, 2)
    figure.suptitle(f'{name}: {CASES[name].parameters.replace(",", ", ")}', fontsize=11)
    figure.tight_layout()
    return _save(figure, name)


CHANCE = 'chance_of_a_name'
_SIZES = (0.0, 4.0, 5.0, 6.0, 7.0, 8.5, 10.0, 12.0, 15.0, 20.0, 30.0, np.inf)


def chance() -> Path:
    """Draw how often a true cause is named, against its size over its standard error."""
    size, *answers = np.array(true_causes()).T
    place = np.digitize(size, _SIZES)
    bins = np.unique(place)
    count = np.array([np.sum(place == k) for k in bins])
    middle = np.array([np.median(size[place == k]) for k in bins])
    figure, axis = plt.subplots(figsize=(9, 3.6))
    for told, label, colour, shift in zip(
        answers, ('named', 'named, or listed as not told apart from a name'), (EXTENDED, PLAIN),
        (0.985, 1.015), strict=True,
    ):  # fmt: skip
        hits = [int(told[place == k].sum()) for k in bins]
        share = np.array(hits) / count
        ends = np.array([
            binomtest(k, int(n)).proportion_ci(0.95, 'wilson')
            for k, n in zip(hits, count, strict=True)
        ])  # fmt: skip
        axis.errorbar(
            shift * middle, share, abs(ends.T - share), fmt='o-', ms=4, lw=1.0, color=colour,
            label=label,
        )  # fmt: skip
    for x, n in zip(middle, count, strict=True):
        axis.annotate(f'{n}', (x, 1.04), ha='center', fontsize=8, color=MUTED)
    axis.axvline(np.sqrt(2.0 * LEAST_GAIN), color=MUTED, lw=1.0, ls='--')
    axis.set(xscale='log', ylim=(-0.03, 1.12), ylabel='share of the true causes',
             xlabel='size of the effect over its standard error')  # fmt: skip
    ticks = [2, 3, 4, 6, 8, 10, 15, 20, 30, 50]
    axis.set_xticks(ticks, labels=[str(tick) for tick in ticks])
    axis.minorticks_off()
    _legend(axis, 2)
    figure.tight_layout()
    return _save(figure, CHANCE)


def main(names: list[str]) -> int:
    """Draw what is named, or everything there are data for."""
    for name in names or (*CASES, CHANCE):
        if name == CHANCE:
            print(chance().name)
            continue
        if not (DATA / f'{name}.json').exists():
            print(f'{name}: no data; run python -m docs.picture_data {name}')
            continue
        path = effect(name)
        print(f'{path.name}: {path.stat().st_size // 1024} kB')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
