# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What systemd is told: that the monitor is ready, alive, ending; and never while it is stuck."""

import configparser
import contextlib
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from pathlib import Path

import hurt_monitor
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ros_helpers import wait_until

from valveflow_ros.logs import RecorderState, RecorderStatus
from valveflow_ros.ros.node.monitor_node import Watchdog, recorder_lives

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
WELL = RecorderStatus(RecorderState.RECORDING)
PERIOD_S = 0.2


class Supervisor:
    """Listens as systemd does, and notes when it heard what."""

    def __init__(self, address):
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind('\0' + address[1:] if address.startswith('@') else address)
        self.heard = []
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self):
        while data := self._socket.recv(65536):
            self.heard.append((time.monotonic(), data.decode()))

    def texts(self):
        return [text for _, text in self.heard]

    def pings(self, since_s=0.0):
        return [at_s for at_s, text in self.heard if 'WATCHDOG=1' in text and at_s >= since_s]

    def environment(self, usec=0):
        return {'NOTIFY_SOCKET': self.address, **({'WATCHDOG_USEC': str(usec)} if usec else {})}

    def close(self):
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as last:
            last.sendto(b'', self._socket.getsockname())
        self._thread.join(5.0)
        self._socket.close()


@contextlib.contextmanager
def listening(abstract=False):
    # A socket's path may be 107 bytes long, which pytest's folders are not made for.
    folder = tempfile.mkdtemp(prefix='vf')
    made = Supervisor(f'@{folder}/s' if abstract else f'{folder}/s')
    try:
        yield made
    finally:
        made.close()
        shutil.rmtree(folder)


@pytest.fixture
def supervisor():
    with listening() as made:
        yield made


def last(supervisor, count):
    wait_until(lambda: len(supervisor.heard) >= count, f'{count} datagrams', 10.0)
    return supervisor.texts()


def test_ready_status_and_end_reach_the_manager():
    for abstract in (False, True):
        with listening(abstract) as supervisor:
            watchdog = Watchdog(supervisor.environment(usec=10_000_000))
            watchdog.status('Loading.')
            watchdog.ready('Listening.')
            watchdog.stopping('Ending.')
            assert last(supervisor, 3) == [
                'STATUS=Loading.',
                'READY=1\nSTATUS=Listening.\nWATCHDOG=1',
                'STOPPING=1\nSTATUS=Ending.',
            ]


def test_pings_come_at_twice_the_rate_asked_for_and_no_faster(supervisor):
    # 20 s, a tenth each.
    now_s = iter(0.1 * k for k in range(1000, 1200))
    watchdog = Watchdog(supervisor.environment(usec=10_000_000), lambda: next(now_s))
    assert watchdog.period_s == 5.0
    for _ in range(200):
        watchdog.completed(lambda: WELL)
    # One each 5 s.
    assert last(supervisor, 4) == ['WATCHDOG=1'] * 4


def test_no_ping_where_none_is_asked_of_this_process(supervisor):
    for count, environment in enumerate((
        {},
        {'WATCHDOG_USEC': '0'},
        {'WATCHDOG_USEC': 'soon'},
        {'WATCHDOG_USEC': '9' * 5000},
        {'WATCHDOG_USEC': '1000000', 'WATCHDOG_PID': '1'},
    )):  # fmt: skip
        watchdog = Watchdog({**supervisor.environment(), **environment})
        watchdog.completed(lambda: pytest.fail('the recorder was asked for nothing'))
        with watchdog.patient(600.0):
            pass
        watchdog.status('Here.')
        assert last(supervisor, count + 1) == ['STATUS=Here.'] * (count + 1)


def test_silent_and_unharmed_where_nobody_listens():
    for address in ('', 'relative/socket', '@', '/nowhere/socket', 'vsock:2:1'):
        watchdog = Watchdog({'NOTIFY_SOCKET': address, 'WATCHDOG_USEC': '1000000'})
        watchdog.ready('Listening.')
        watchdog.completed(lambda: WELL)
        watchdog.stopping('Ending.')
    assert Watchdog({'WATCHDOG_USEC': '1000000'}).period_s == 0.0


def test_a_manager_that_does_not_read_holds_nobody_up_and_gets_the_ping_later():
    folder = tempfile.mkdtemp(prefix='vf')
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as deaf:
        deaf.bind(f'{folder}/s')
        environment = {'NOTIFY_SOCKET': f'{folder}/s', 'WATCHDOG_USEC': '2000000'}
        watchdog = Watchdog(environment, lambda: 100.0)
        begun_s = time.monotonic()
        for _ in range(5000):
            watchdog.status('x' * 1000)
        assert time.monotonic() - begun_s < 10.0
        watchdog.completed(lambda: WELL)
        deaf.setblocking(False)
        waiting = 0
        while True:
            try:
                assert 'WATCHDOG' not in deaf.recv(65536).decode()
            except BlockingIOError:
                break
            waiting += 1
        assert 0 < waiting < 5000
        # Not a period later, but after the next cycle.
        watchdog.completed(lambda: WELL)
        assert deaf.recv(65536) == b'WATCHDOG=1'
    shutil.rmtree(folder)


@given(st.text())
def test_no_text_becomes_another_assignment(text):
    sent = []
    watchdog = Watchdog({'NOTIFY_SOCKET': '@nobody'})
    watchdog._send = lambda said: sent.append(said) or True
    watchdog.ready(text)
    first, second, third = sent[0].splitlines()
    assert (first, third) == ('READY=1', 'WATCHDOG=1')
    assert second.startswith('STATUS=')
    assert second[7:].split() == text.split()


def test_long_work_gets_its_time_and_then_the_old_limit_holds(supervisor):
    watchdog = Watchdog(supervisor.environment(usec=10_000_000))
    with pytest.raises(ZeroDivisionError), watchdog.patient(600.0):
        raise ZeroDivisionError
    assert last(supervisor, 2) == [
        'WATCHDOG_USEC=600000000\nWATCHDOG=1',
        'WATCHDOG_USEC=10000000\nWATCHDOG=1',
    ]


def test_who_counts_as_alive(supervisor):
    expected = []
    for status, lives in (
        (None, True),
        (WELL, True),
        (RecorderStatus(RecorderState.RECORDING, stalled_s=0.9), True),
        (RecorderStatus(RecorderState.RECORDING, stalled_s=1.1), False),
        (RecorderStatus(RecorderState.DEGRADED, 'no space left', stalled_s=0.0), True),
        (RecorderStatus(RecorderState.DEGRADED, 'no space left', stalled_s=9.0), False),
        (RecorderStatus(RecorderState.STOPPED, 'the recorder failed'), False),
    ):
        assert recorder_lives(status, 1.0) is lives
        watchdog = Watchdog(supervisor.environment(usec=10_000_000))
        watchdog.completed(lambda status=status: status)
        watchdog.status('After.')
        expected += ['WATCHDOG=1'] * lives + ['STATUS=After.']
        assert last(supervisor, len(expected)) == expected


@pytest.mark.ros
def test_a_monitor_that_is_held_up_anywhere_pings_no_more(processes, supervisor, tmp_path):
    monitor = processes.start(
        'hurt_monitor', '--ros-args', '-p', f'record_directory:={tmp_path / "rec"}',
        '-p', 'diagnostics_period:=0.1', '-p', 'record_flush:=0.05',
        **supervisor.environment(usec=round(2e6 * PERIOD_S)),
        PYTHONPATH=f'{HERE}{os.pathsep}{os.environ.get("PYTHONPATH", "")}',
    )  # fmt: skip

    def ready():
        assert monitor.poll() is None, processes.output(monitor)
        return any('READY=1' in text for text in supervisor.texts())

    def goes_on():
        """Require several pings from now on."""
        since_s = time.monotonic()
        wait_until(lambda: ready() and len(supervisor.pings(since_s)) >= 4, 'four pings', 60.0)

    wait_until(ready, 'READY=1')
    assert any('WATCHDOG_USEC=600000000' in text for text in supervisor.texts())
    assert any('WATCHDOG_USEC=400000\n' in text for text in supervisor.texts())
    for place in ('loop', 'poll', 'writer', 'interpreter'):
        goes_on()
        hold, held = tmp_path / hurt_monitor.HOLD, tmp_path / hurt_monitor.HELD
        hold.write_text(place)
        wait_until(lambda: held.exists() and held.read_text() == place, place, 30.0)  # noqa: B023
        # A ping may be on its way; six periods without one are no accident.
        wait_until(
            lambda: not supervisor.pings(time.monotonic() - 6.0 * PERIOD_S), 'the silence', 30.0
        )
        assert monitor.poll() is None
        hold.unlink()
        held.unlink()
    goes_on()
    monitor.send_signal(signal.SIGTERM)
    assert monitor.wait(20.0) == 0, processes.output(monitor)
    assert any(text.startswith('STOPPING=1') for text in supervisor.texts())


# The unit


def test_the_unit_believes_the_process_that_watches_and_is_closed():
    unit = {}
    lines = (ROOT / 'config' / 'valveflow.service').read_text().replace('\\\n', ' ').splitlines()
    for line in lines:
        name, sign, value = line.partition('=')
        if sign and not line.startswith('#'):
            unit.setdefault(name, []).append(value)
    wanted = {
        'Type': 'notify', 'NotifyAccess': 'main', 'Restart': 'on-failure', 'IPAddressDeny': 'any',
        'IPAddressAllow': 'localhost', 'UMask': '0077',
    }  # fmt: skip
    assert {name: unit[name] for name in wanted} == {n: [v] for n, v in wanted.items()}
    assert 'MemoryDenyWriteExecute' not in unit
    (start,) = unit['ExecStart']
    # Whatever is started as a child of the main process is not believed.
    assert 'exec /opt/' in start
    assert '/lib/valveflow_ros/monitor ' in start
    assert 'ros2 run' not in start
    assert 5.0 <= float(unit['WatchdogSec'][0]) <= 60.0
    assert float(unit['TimeoutStopSec'][0]) > 2.0
    assert float(unit['TimeoutStartSec'][0]) >= 600.0
    scripts = configparser.ConfigParser()
    scripts.read(ROOT / 'setup.cfg')
    assert scripts['install']['install_scripts'].endswith('/lib/valveflow_ros')
    # It takes the loopback profile or does not start.
    (path,) = unit['AssertPathExists']
    assert path.endswith('/share/valveflow_ros/config/fastdds_loopback.xml')
    profiles = {f'{name}_DEFAULT_PROFILES_FILE={path}' for name in ('FASTRTPS', 'FASTDDS')}
    assert profiles | {'ROS_AUTOMATIC_DISCOVERY_RANGE=SYSTEM_DEFAULT'} <= set(unit['Environment'])


def test_the_unit_is_as_closed_as_its_work_allows():
    tool = shutil.which('systemd-analyze')
    if tool is None:
        pytest.skip('no systemd-analyze here')
    # 30 tenths, of which 0 is best.
    done = subprocess.run(
        [tool, 'security', '--offline=true', '--threshold=30', 'config/valveflow.service'],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if 'unrecognized option' in done.stderr:
        pytest.skip('systemd-analyze is too old to look at a file')
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'Overall exposure level' in done.stdout
