"""The catalogue of causes, by family; every `Cause` at the top of a module here is one of them."""

from __future__ import annotations

import functools
import importlib
import pkgutil

from valveflow_ros.diagnosis.cause import Cause
from valveflow_ros.diagnosis.causes.covariate import covariate_cause
from valveflow_ros.diagnosis.grids import Grids


@functools.cache
def catalogue() -> dict[str, Cause]:
    """Return every cause by name, in alphabetical order."""
    modules = [
        importlib.import_module(f'{__name__}.{m.name}') for m in pkgutil.iter_modules(__path__)
    ]
    causes = [
        made for module in modules for made in vars(module).values() if isinstance(made, Cause)
    ]
    return {cause.name: cause for cause in sorted(causes, key=lambda cause: cause.name)}


def causes_for(grids: Grids) -> dict[str, Cause]:
    """Return the catalogue for the form of a record and a cause for each covariate, by name."""
    own = {name: covariate_cause(about) for name, (about, _) in grids.covariates.items()}
    return {name: cause.on(grids.form) for name, cause in (catalogue() | own).items()}
