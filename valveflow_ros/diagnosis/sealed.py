"""The sealed blocks, opened once: what each cause is worth there, and whether that stands.

A name that the open blocks suggest stands only if blocks nothing was fitted to confirm it at
the 5 % level, the number of causes tried taken into account.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import improve
from valveflow_ros.diagnosis.gain import Gain, sealed_gain
from valveflow_ros.diagnosis.search import Found

LARGEST_P = 0.05


def confirm(found: Found) -> None:
    """Take back names that the sealed blocks do not confirm, the least likely first."""
    while found.model.active:
        gains = gains_of(found, steps(found))
        worst = max(range(len(gains)), key=lambda k: gains[k].p_value)
        if gains[worst].p_value <= LARGEST_P:
            return
        name = found.model.active[worst].name
        found.model, _ = improve(found.task, found.model.without(name), 3)
        found.near.pop(name, None)
        found.evidence.pop(name, None)
        found.reasons[name] = (
            'blocks of time that were kept out of the search do not confirm it (a gain as large '
            f'there has a chance of {gains[worst].p_value:.2g})'
        )


def steps(found: Found) -> list[Extended]:
    """Return the models with one cause more each, fitted to the open blocks."""
    models = [found.plain]
    for k in range(1, len(found.model.active)):
        part = replace(found.model, active=found.model.active[:k])
        models.append(improve(found.task, part, 2)[0])
    return models + ([found.model] if found.model.active else [])


def gains_of(found: Found, models: list[Extended]) -> list[Gain]:
    """Return what each cause brings on the sealed blocks, over those found before it."""
    return [sealed_gain(found.task, a, b, found.tried) for a, b in itertools.pairwise(models)]
