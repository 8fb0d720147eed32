"""The effects a plant can have, one file each; a file put here is found by its ``EFFECT``."""

from __future__ import annotations

import functools
import importlib
import pkgutil

from valveflow_ros.plant.effect import Effect


@functools.cache
def catalogue() -> dict[str, Effect]:
    """Return all effects by name, in alphabetical order."""
    found: dict[str, Effect] = {}
    for module in sorted(pkgutil.iter_modules(__path__), key=lambda info: info.name):
        effect = importlib.import_module(f'{__name__}.{module.name}').EFFECT
        found[effect.name] = effect
    return dict(sorted(found.items()))
