# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Units that make one thing visible at a time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from valveflow_ros.plant.unit import Noise, Programme, Region, UnitDescription


@pytest.fixture(scope='session')
def open_loop() -> UnitDescription:
    """Return the paper's curve with one lag and without power control."""
    return UnitDescription(
        regions=(Region(np.inf, 10.0, 3.0),), programme=Programme(feedback=False)
    )


@pytest.fixture(scope='session')
def prompt(open_loop: UnitDescription) -> UnitDescription:
    """Return a unit that answers at once, so that power is F(u) times what acts on it."""
    return dataclasses.replace(open_loop, regions=(Region(np.inf, 1e-3, 0.0),))


@pytest.fixture(scope='session')
def quiet() -> UnitDescription:
    """Return the paper's unit with sensors and a grid that make no noise."""
    return UnitDescription(
        noise=Noise(0.0, 60.0, 0.0, 0.0, 0.0, 0.0),
        programme=Programme(temperature_wander_k=0.0),
    )
