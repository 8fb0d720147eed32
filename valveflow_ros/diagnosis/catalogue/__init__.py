"""The catalogue of causes: every module here is one of them, found by itself."""

from __future__ import annotations

import functools
import importlib
import pkgutil

from valveflow_ros.diagnosis.cause import Cause


@functools.cache
def catalogue() -> dict[str, Cause]:
    """Return every cause by name; adding a cause is adding a module with a ``CAUSE``."""
    found = {}
    for info in pkgutil.iter_modules(__path__):
        if info.name.startswith('_'):
            continue
        module = importlib.import_module(f'{__name__}.{info.name}')
        found[module.CAUSE.name] = module.CAUSE
    return found
