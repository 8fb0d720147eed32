# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every test may ask for: a ROS domain of its own, the real data; how hypothesis runs."""

import fcntl
import importlib.util
import itertools
import os
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import hypothesis
import pytest
from chromium import BROWSERS, Chromium, installed

ROOT = Path(__file__).resolve().parent.parent

# `make test` draws the same examples each time, so that it never fails by luck; `make test-slow`
# draws fresh ones, and a failing example prints the line that brings it back. No deadline: a test
# machine may be busy, and the first call of a compiled function takes a second.
hypothesis.settings.register_profile(
    'valveflow',
    deadline=None,
    derandomize=not os.environ.get('VALVEFLOW_SLOW'),
    print_blob=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile('valveflow')


@pytest.fixture(autouse=True)
def _process_as_before() -> Iterator[None]:
    """Put signals and environment back.

    A node that ends in this process ignores signals, and one that starts in it selects a transport
    in the environment. A process that a later test starts would inherit both.
    """
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    environment = dict(os.environ)
    yield
    for number, handler in zip(numbers, before, strict=True):
        if signal.getsignal(number) is not handler:
            signal.signal(number, handler)
    for name in os.environ.keys() - environment.keys():
        del os.environ[name]
    for name, value in environment.items():
        if os.environ.get(name) != value:
            os.environ[name] = value


# Above 101 a domain's ports run into those that Linux hands out to anybody.
DOMAINS = 101
# Processes of one run take turns of their own, so that none comes upon what another one's nodes
# have just left.
WORKER = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0')[2:])
WORKERS = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
_turn = itertools.count(os.getpid())


@contextmanager
def leased_domain() -> Iterator[int]:
    """Hold a ROS domain id (1 to 101) that no other test on this machine holds.

    The lease is a file lock, so it ends with the process, however that ends. Every
    lease takes another number than the one before, because a dead test's nodes stay
    known to its domain for a while.
    """
    for _ in range(DOMAINS):
        domain = next(_turn) % (DOMAINS // WORKERS) * WORKERS + WORKER + 1
        path = Path(tempfile.gettempdir(), f'valveflow-ros-domain-{domain}.lock')
        try:
            handle = os.open(path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o666)
        except PermissionError:  # another user's
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield domain
            return
        except BlockingIOError:
            continue
        finally:
            os.close(handle)
    pytest.fail(f'all {DOMAINS} ROS domains are held by other tests on this machine')


# The first of these compiles most of what is compiled. The others hardly need it and take as long,
# so that on two cores nothing is compiled twice.
FIRST = ('test_from_window.py', 'test_opcua_link.py', 'test_page_browser.py')


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """On several cores begin with the files that take long, so that none is left at the end."""
    if not os.environ.get('VALVEFLOW_SLOW'):
        left = [item for item in items if item.get_closest_marker('long')]
        items[:] = [item for item in items if not item.get_closest_marker('long')]
        config.hook.pytest_deselected(items=left)
    if hasattr(config, 'workerinput'):
        long = {item.path for item in items if item.get_closest_marker('slow')}
        rank = {name: k for k, name in enumerate(FIRST)}
        items.sort(key=lambda item: (rank.get(item.path.name, len(FIRST)), item.path not in long))


@pytest.fixture
def ros_environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Give the test a ROS domain of its own that stays on this machine.

    Yields the environment for child processes; this process has it too. Without
    rclpy the test is skipped, except under `make test`, which promises it.
    """
    if importlib.util.find_spec('rclpy') is None:
        if os.environ.get('VALVEFLOW_REQUIRE_ROS'):
            pytest.fail('rclpy cannot be imported although the set-up has been done')
        pytest.skip('rclpy cannot be imported; source env.sh first')
    with leased_domain() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        yield dict(os.environ)


@pytest.fixture(scope='session')
def shared_data() -> Path:
    """Return the folder of real plant data, or skip the test where there is none."""
    named = os.environ.get('VALVEFLOW_SHARED_DATA')
    folder = Path(named) if named else ROOT.parent / 'shared' / 'data'
    if not folder.is_dir():
        pytest.skip(f'no real plant data in {folder}; VALVEFLOW_SHARED_DATA names another folder')
    return folder


@pytest.fixture(scope='session')
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    """Return a browser without a head; one for all tests."""
    found = installed()
    if found is None:
        pytest.skip(f'none of {", ".join(BROWSERS)} is installed')
    opened = Chromium(found, tmp_path_factory.mktemp('browser'))
    yield opened
    opened.close()
