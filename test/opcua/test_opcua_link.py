# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The link against real servers in other processes: security, outages, history, odd values."""

import asyncio
import contextlib
import importlib.util
import threading
import time

import pytest
from opcua_server import (
    ENGINE,
    OpcUaServer,
    Relay,
    certificate,
    free_port,
    mapping,
    signals,
    write_mapping,
)

from valveflow_ros.opcua.link import Link
from valveflow_ros.opcua.mapping import read_mapping_file
from valveflow_ros.opcua.sampler import Sampler
from valveflow_ros.opcua.session import check_installed, history
from valveflow_ros.records import SIGNALS, Quality

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec('asyncua') is None, reason='asyncua not installed; it is an extra'
)
PATIENCE_S = 60.0


class Running:
    """A link in a thread, and the samples that came of it."""

    def __init__(self, folder, content):
        check_installed()
        self.unit = read_mapping_file(write_mapping(folder, content)).units[0]
        self.sampler = Sampler(self.unit, time.time_ns())
        self.samples = []
        self.saved = []
        self._lock = threading.Lock()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        self.link = Link(self.unit, self._tell, lambda parts: f'{self.saved.append(parts)}')
        self._task = self._loop.create_task(self.link.run())
        with contextlib.suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._task)

    def _tell(self, command):
        with self._lock:
            command(self.sampler)

    def look(self):
        with self._lock:
            self.samples += self.sampler.due(time.time_ns())
        return self.samples

    def until(self, condition, what):
        end_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end_s, f'{what} did not come: {self.link.state}'
            self.look()
            time.sleep(0.01)

    def until_good(self):
        self.until(lambda: self.samples and self.samples[-1].quality[3] == Quality.GOOD, 'good')

    def until_problem(self, words):
        self.until(lambda: words in getattr(self, 'link', None).state.problem, words)

    def end(self):
        self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A function that starts a link; it is ended after the test."""
    for module in ('link', 'session'):
        monkeypatch.setattr(f'valveflow_ros.opcua.{module}.ANSWER_S', 2.0)
    with contextlib.ExitStack() as stack:

        def start(content):
            made = Running(tmp_path, content)
            stack.callback(made.end)
            while not hasattr(made, 'link'):
                time.sleep(0.01)
            return made

        yield start


@pytest.fixture(scope='module')
def server():
    made = OpcUaServer(free_port(), '--history')
    yield made
    made.kill()


@pytest.fixture(scope='module')
def keys(tmp_path_factory):
    """Certificates and keys as files, by name."""
    folder = tmp_path_factory.mktemp('keys')
    names = {'gateway': 30.0, 'server': 30.0, 'other': 30.0, 'old': -1.0}
    found = {name: certificate(folder, name, days) for name, days in names.items()}
    (folder / 'damaged.der').write_bytes(b'no certificate')
    return {**found, 'damaged': (str(folder / 'damaged.der'), '')}


@pytest.fixture(scope='module')
def secured(keys):
    made = OpcUaServer(
        free_port(), '--policy', 'Aes256Sha256RsaPss_SignAndEncrypt', '--user', 'valveflow:secret',
        '--certificate', keys['server'][0], '--key', keys['server'][1],
        '--trusted', keys['gateway'][0],
    )  # fmt: skip
    yield made
    made.kill()


def secure(keys, port, own='gateway', trusted=('server',), **different):
    named = [keys[name][0] for name in trusted]
    named = named[0] if len(named) == 1 else named
    security = {'policy': 'Aes256Sha256RsaPss', 'certificate': keys[own][0],
                'private_key': keys[own][1], 'trusted': named}  # fmt: skip
    return mapping(port, security={**security, **different})


ODD = [
    ({'value': 'text', 'kind': 'String'}, 'wrong_type', Quality.BAD),
    ({'value': True, 'kind': 'Boolean'}, 'wrong_type', Quality.BAD),
    ({'value': 'nan'}, 'not_finite', Quality.BAD),
    ({'value': 3.0, 'status': 'UncertainSensorNotAccurate'}, 'uncertain', Quality.UNCERTAIN),
    ({'value': 4.0, 'status': 'BadSensorFailure'}, 'bad', Quality.BAD),
    ({'value': 150, 'kind': 'Int32'}, 'received', Quality.GOOD),
]


def test_odd_values_are_counted_and_have_their_quality(run, server):
    link = run(mapping(server.port))
    for asked, count, quality in ODD:
        server.set('power', 150_000.0)
        link.until_good()
        before = getattr(link.sampler.counts[3], count)
        server.set('power', **asked)
        link.until(lambda c=count, n=before: getattr(link.sampler.counts[3], c) > n, count)
        seen = len(link.samples)
        link.until(
            lambda n=seen, q=quality: link.samples[n:] and link.samples[-1].quality[3] == q, count
        )
    server.set('power', 150_000.0)


def test_an_unknown_node_is_named_and_the_others_go_on(run, server):
    content = mapping(server.port)
    content['units'][0]['signals'] = signals(
        valve_opening={'node': 'ns=3;s=nothing', 'unit': '%'},
        main_steam_pressure={'node': 'nsu=urn:nobody;s=x', 'unit': 'bar'},
    )
    link = run(content)
    link.until_good()
    values = dict(zip([i.topic for i in SIGNALS], link.samples[-1].values, strict=True))
    # In the units of the monitor.
    for name in ('main_steam_temperature', 'generated_power'):
        assert values[name] == pytest.approx(ENGINE[name])
    assert abs(link.link.state.clock_ahead_s) < 1.0
    problems = link.link.state.nodes
    assert 'node ns=3;s=nothing: the server has no such node' in problems[0]
    assert "the server has no namespace 'urn:nobody'" in problems[1]
    assert list(link.samples[-1].quality[:2]) == [Quality.BAD] * 2


@pytest.mark.parametrize('trusted', [['server'], ['damaged', 'old', 'other', 'server']], ids=str)
def test_an_encrypted_link_with_user_and_password(run, secured, keys, tmp_path, trusted):
    (tmp_path / 'password').write_text('secret\n')
    content = secure(keys, secured.port, trusted=trusted)
    content['user'] = {'name': 'valveflow', 'password_file': 'password'}
    run(content).until_good()


def test_an_expired_certificate_of_a_server_is_named_out_of_a_list(run, keys):
    old = OpcUaServer(
        free_port(), '--policy', 'Aes256Sha256RsaPss_SignAndEncrypt',
        '--certificate', keys['old'][0], '--key', keys['old'][1],
    )  # fmt: skip
    link = run(secure(keys, old.port, trusted=['server', 'old']))
    link.until_problem('old.der: expired on')
    assert not link.link.state.up
    old.kill()


SECURITY = [
    ({'own': 'old'}, 'old.der: expired on'),
    ({'trusted': ['old']}, 'old.der: expired on'),
    ({'trusted': ['other']}, "does not have the one named as 'trusted'"),
    ({'trusted': ['other', 'old']}, "The server has none of the certificates named as 'trusted'"),
    ({'trusted': ['other', 'damaged']}, 'damaged.der: is no certificate that can be read'),
    ({'own': 'other'}, 'the server does not accept the user'),
    ({}, 'the server does not accept the user'),
    ({'policy': 'Basic256Sha256'}, 'does not offer this policy'),
    ({'private_key': 'other'}, 'other.pem: is not the key of the certificate beside it'),
    ({'certificate': 'key'}, 'is no certificate that can be read'),
]


@pytest.mark.parametrize(('different', 'words'), SECURITY, ids=[str(row[0]) for row in SECURITY])
def test_what_is_wrong_with_security_is_said(run, secured, keys, different, words):
    given = dict(different)
    if given.get('private_key') == 'other':
        given['private_key'] = keys['other'][1]
    if given.get('certificate') == 'key':
        given['certificate'] = keys['gateway'][1]
    link = run(secure(keys, secured.port, **given))
    link.until(lambda: link.link.state.problem, 'a problem')
    assert words in link.link.state.problem
    assert 'Traceback' not in link.link.state.problem
    assert not link.link.state.up


def test_a_short_outage_leaves_no_bad_sample_where_there_is_history(run, server, tmp_path):
    """Once the link is back the samples that waited are filled."""
    relay = Relay(server.port)
    link = run({**mapping(relay.port), 'lateness': 20.0, 'reconnect_longest': 0.3})
    link.until_good()
    first = len(link.samples)
    relay.cut()
    link.until(lambda: not link.link.state.up, 'the loss')
    for k in range(5):
        server.set('power', 1000.0 * k)
        time.sleep(0.2)
    relay.mend()
    link.until(lambda: link.link.state.up and link.link.state.losses == 1, 'the link')
    back = len(link.samples)
    link.until(lambda: len(link.samples) > back + 10, 'samples')
    assert {x.quality[3] for x in link.samples[first:]} == {Quality.GOOD}
    assert {0.0, 1.0, 2.0, 3.0, 4.0} <= {x.values[3] for x in link.samples[first:]}
    stamps = [x.time_ns for x in link.samples]
    assert stamps == sorted(set(stamps))
    relay.close()


@pytest.mark.parametrize('how', ['cut', 'hold'])
def test_an_outage_stays_owed_across_a_second_loss(run, server, monkeypatch, how):
    """The link is lost again while the history is read; it is read once more later.

    A wire that is held still accepts connections, so the socket tells nothing.
    """
    relay, read, asked = Relay(server.port), history, []

    async def lost_meanwhile(client, nodes, start_ns, end_ns):
        asked.append(start_ns)
        if len(asked) == 1:
            getattr(relay, how)()
        async for part in read(client, nodes, start_ns, end_ns):
            yield part

    monkeypatch.setattr('valveflow_ros.opcua.link.history', lost_meanwhile)
    link = run({**mapping(relay.port), 'lateness': 0.3})
    link.until_good()
    relay.cut()
    link.until(lambda: link.samples[-1].quality[3] == Quality.BAD, 'a bad sample')
    server.set('power', 66_000.0)
    time.sleep(0.5)
    server.set('power', 150_000.0)
    relay.mend()
    link.until(lambda: link.link.state.losses == 2, 'the second loss')
    assert not link.saved
    relay.mend()
    link.until(lambda: link.saved, 'the history')
    values = [v for part in link.saved[0] for v in part.value[part.signal == 3]]
    assert 66.0 in values
    assert asked[1] == asked[0]
    relay.close()


def test_a_server_without_history_is_asked_once(run):
    server = OpcUaServer(free_port())
    relay = Relay(server.port)
    link = run({**mapping(relay.port), 'lateness': 0.3})
    link.until_good()
    relay.cut()
    link.until(lambda: link.samples[-1].quality[3] == Quality.BAD, 'a bad sample')
    relay.mend()
    link.until(lambda: link.link.state.backfill, 'what came of it')
    assert 'history of the last outage' in link.link.state.backfill
    assert not link.link._outages
    assert not link.saved
    relay.close()
    server.kill()


@pytest.mark.parametrize('times', [1, pytest.param(20, marks=pytest.mark.long)])
def test_a_server_that_is_killed_and_started_again(run, times):
    server = OpcUaServer(free_port())
    link = run(mapping(server.port))
    for k in range(times):
        server.set('power', 1000.0 * (k + 1))
        link.until(lambda k=k: link.samples and link.samples[-1].values[3] == k + 1.0, 'a value')
        server.kill()
        link.until(lambda: link.samples[-1].quality[3] == Quality.BAD, 'a bad sample')
        server.restart()
    link.until_good()
    assert link.link.state.losses == times
    stamps = [x.time_ns for x in link.samples]
    assert stamps == list(range(stamps[0], stamps[-1] + 1, link.unit.period_ns))
    server.kill()


class Republishing:
    """A session that still has some messages."""

    def __init__(self, *numbers):
        self.numbers = numbers

    async def republish(self, _subscription, number):
        from asyncua import ua

        if number not in self.numbers:
            raise ua.UaStatusCodeError(ua.StatusCodes.BadMessageNotAvailable)
        return message(number, float(number)).NotificationMessage


def message(number, *values):
    """A message of the server with the power; without values a keep-alive."""
    from asyncua import ua

    items = [
        ua.MonitoredItemNotification(ClientHandle=3, Value=ua.DataValue(ua.Variant(v)))
        for v in values
    ]
    data = [ua.DataChangeNotification(MonitoredItems=items)] if items else []
    return ua.PublishResult(
        SubscriptionId=1,
        MoreNotifications=False,
        NotificationMessage=ua.NotificationMessage(SequenceNumber=number, NotificationData=data),
    )


@pytest.fixture
def link(tmp_path):
    """A link without a server, and its sampler."""
    unit = read_mapping_file(write_mapping(tmp_path, mapping(1))).units[0]
    sampler = Sampler(unit, time.time_ns())
    made = Link(unit, lambda command: command(sampler))
    made.sampler = sampler
    return made


def take(link, session, *messages):
    for one in messages:
        asyncio.run(link._published(one, session))


def test_missing_messages_are_asked_for_and_counted(link):
    take(link, Republishing(2), message(1, 1.0), message(2), message(3, 3.0), message(4))
    # 2 came again; keep-alives have the number of what comes next.
    assert (link.state.lost_messages, link.state.republished) == (0, 1)
    assert link.sampler.counts[3].received == 3
    confirmed_ns = link.sampler.confirmed_ns
    assert confirmed_ns > 0
    # What is lost for good may have held a change: nothing is confirmed until there is a new
    # subscription, which begins with every value. Each of many is counted.
    take(link, Republishing(), message(1000))
    assert link.state.lost_messages == 996
    assert link._ended == 'a message of the server was lost'
    assert link.sampler.confirmed_ns == confirmed_ns


def test_an_overflow_of_the_servers_queue_is_counted(link):
    from asyncua import ua

    full = message(1, 1.0)
    item = full.NotificationMessage.NotificationData[0].MonitoredItems[0]
    item.Value = ua.DataValue(ua.Variant(1.0), StatusCode=ua.StatusCode(0x480))
    take(link, None, full)
    assert link.state.overflows == {3: 1}


def test_more_to_follow_and_the_end_of_a_subscription_confirm_nothing(link):
    from asyncua import ua

    first, last, end = message(1, 1.0), message(2, 2.0), message(0)
    status = ua.StatusCode(ua.StatusCodes.BadShutdown)
    end.NotificationMessage.NotificationData = [ua.StatusChangeNotification(Status=status)]
    first.MoreNotifications = True
    take(link, None, end, first)
    assert (link.sampler.confirmed_ns, link.state.lost_messages) == (0, 0)
    take(link, None, last)
    assert link.sampler.confirmed_ns > 0
    assert link.sampler.counts[3].received == 2
