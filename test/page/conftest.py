# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page's server, where its libraries are installed."""

import importlib.util
from contextlib import contextmanager

import pytest

EXTRA = ('dash', 'prometheus_client', 'waitress')


@contextmanager
def servers():
    """Give a function that starts a server on any free port; skip where the extra is absent."""
    missing = [name for name in EXTRA if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f'{", ".join(missing)} not installed; the page is an extra')
    from valveflow_ros.page.server import PageServer

    made = []

    def start(shown, port=0, **more):
        made.append(PageServer(shown, port=port, **more))
        return made[-1]

    yield start
    for server in made:
        server.close()


@pytest.fixture
def serve():
    """Start servers for one test."""
    with servers() as start:
        yield start


@pytest.fixture(scope='module')
def serve_long():
    """Start servers for the tests of a file."""
    with servers() as start:
        yield start
