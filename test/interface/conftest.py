# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Logs to call the interface on."""

import pytest

import valveflow_ros as vf


@pytest.fixture(scope='session')
def simulation():
    """Ten hours of the paper's plant."""
    return vf.simulate(0.4, 1)


@pytest.fixture(scope='session')
def log(simulation):
    return simulation.log
