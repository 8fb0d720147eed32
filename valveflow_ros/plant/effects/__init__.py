# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The effects of a plant by family: all `Effect` objects at the top level of these modules."""

from __future__ import annotations

import functools
import importlib
import pkgutil

from valveflow_ros.plant.effect import Effect


@functools.cache
def catalogue() -> dict[str, Effect]:
    """Return all effects by name, in alphabetical order."""
    modules = [
        importlib.import_module(f'{__name__}.{m.name}') for m in pkgutil.iter_modules(__path__)
    ]
    effects = [
        made for module in modules for made in vars(module).values() if isinstance(made, Effect)
    ]
    return {effect.name: effect for effect in sorted(effects, key=lambda effect: effect.name)}
