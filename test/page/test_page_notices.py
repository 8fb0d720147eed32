# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Notices of alarms: in order, tried again, bounded, and never waited for."""

import json
import socket
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from monitor_recording import START_NS
from page_units import alarm, predict

from valveflow_ros.errors import UsageError
from valveflow_ros.page.notices import (
    MOST_WAITING,
    DeliveryError,
    Notices,
    Sender,
    command,
    notice,
    webhook,
)
from valveflow_ros.page.unit import AlarmChange, Unit
from valveflow_ros.report.terminal.frame import AlarmView

PATIENCE_S = 20.0


def change(state=1, previous=0):
    view = AlarmView('residual', state, 'Nine MW less – look.', START_NS)
    return AlarmChange('U1', '/m', view, previous, START_NS + 10**9)


def until(condition):
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, 'it did not come'
        time.sleep(0.005)


def test_what_is_sent():
    assert json.loads(notice(change())) == {
        'unit': 'U1', 'monitor': '/m', 'alarm': 'residual', 'state': 'unacknowledged',
        'previous_state': 'normal', 'sentence': 'Nine MW less – look.',
        'time': '2023-11-14T22:13:21+00:00', 'raised': '2023-11-14T22:13:20+00:00',
    }  # fmt: skip
    unknown = json.loads(notice(change(state=99, previous=None)))
    assert (unknown['state'], unknown['previous_state']) == ('state_99', None)


def test_in_order_tried_again_given_up_and_counted():
    came, said, refused = [], [], [True, True, False, True, True, True, False]

    def deliver(content):
        came.append(content)
        if refused.pop(0):
            raise DeliveryError('not now')

    sender = Sender(deliver, pauses_s=(0.0, 0.0), complain=said.append)
    for content in (b'1', b'2', b'3'):
        sender.put(content)
    until(lambda: sender.sent == 2)
    sender.close()
    assert came == [b'1'] * 3 + [b'2'] * 3 + [b'3']
    assert sender.failed == 1
    assert [('not now' in s, 'given up' in s) for s in said] == [(True, k == 4) for k in range(5)]


def test_while_one_hangs_the_oldest_that_wait_are_dropped_and_nobody_waits():
    go, begun, came = threading.Event(), threading.Event(), []

    def deliver(content):
        begun.set()
        go.wait(PATIENCE_S)
        came.append(content)

    sender = Sender(deliver)
    sender.put(b'first')
    assert begun.wait(PATIENCE_S)
    begun_s = time.monotonic()
    for k in range(MOST_WAITING + 10):
        sender.put(str(k).encode())
    assert time.monotonic() - begun_s < 1.0
    assert sender.dropped == 10
    go.set()
    until(lambda: sender.sent == MOST_WAITING + 1)
    sender.close()
    assert came[:2] == [b'first', b'10']


def test_closing_does_not_wait_for_the_next_try():
    said = []
    sender = Sender(command('false'), pauses_s=(3600.0,), complain=said.append)
    sender.put(b'1')
    until(lambda: said)
    begun_s = time.monotonic()
    sender.close(1.0)
    assert time.monotonic() - begun_s < 5.0


def test_a_command_gets_the_notice(tmp_path):
    file = tmp_path / 'said with spaces'
    code = 'import sys; open(sys.argv[1], "wb").write(sys.stdin.buffer.read())'
    command(f"{sys.executable} -c '{code}' '{file}'")(notice(change()))
    assert json.loads(file.read_bytes())['alarm'] == 'residual'


class Answering(BaseHTTPRequestHandler):
    def do_POST(self):
        content = self.rfile.read(int(self.headers['Content-Length']))
        self.server.came.append((self.path, self.headers['Content-Type'], content))
        self.send_response(self.server.statuses.pop(0))
        self.send_header('Location', '/elsewhere')
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture
def hook():
    server = ThreadingHTTPServer(('127.0.0.1', 0), Answering)
    server.came, server.statuses = [], []
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def test_a_webhook_is_tried_until_it_takes_the_notice(hook):
    hook.statuses += [500, 302, 204]
    deliver = webhook(f'http://127.0.0.1:{hook.server_port}/a?b=c')
    sender = Sender(deliver, pauses_s=(0.0, 0.0, 0.0))
    sender.put(notice(change()))
    until(lambda: sender.sent == 1)
    sender.close()
    # A redirection is not followed.
    assert [path for path, _, _ in hook.came] == ['/a?b=c'] * 3
    assert hook.came[-1][1] == 'application/json'
    assert json.loads(hook.came[-1][2])['unit'] == 'U1'


@pytest.mark.parametrize('drip', [False, True])
def test_a_webhook_that_hangs_is_left(drip):
    with socket.create_server(('127.0.0.1', 0)) as silent:
        ended = threading.Event()

        def answer():
            connection, _ = silent.accept()
            with connection:
                while not ended.wait(0.05):
                    try:
                        connection.sendall(b'H' if drip else b'')
                    except OSError:
                        return

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        deliver = webhook(f'http://127.0.0.1:{silent.getsockname()[1]}/', limit_s=0.4)
        begun_s = time.monotonic()
        with pytest.raises(DeliveryError, match=r'no answer within 0\.4 s'):
            deliver(b'{}')
        assert time.monotonic() - begun_s < 5.0
        ended.set()
        thread.join()


def test_what_cannot_be_delivered_is_told():
    with socket.create_server(('127.0.0.1', 0)) as free:
        port = free.getsockname()[1]
    for deliver, told in (
        (command('false'), 'ended with status 1'),
        (command('/no/such/program'), 'No such file'),
        # A shell and what it starts are both ended.
        (command("sh -c 'sleep 600 & wait'", limit_s=0.3), 'longer than 0.3 s'),
        (webhook(f'http://127.0.0.1:{port}/'), 'refused'),
    ):
        begun_s = time.monotonic()
        with pytest.raises(DeliveryError, match=told):
            deliver(b'{}')
        assert time.monotonic() - begun_s < PATIENCE_S


def test_what_is_no_address_and_no_command_is_refused():
    addresses = ('', 'host', 'ftp://host/', 'http://', 'http://[1', 'http://a:99999/',
                 'http://u:p@h/')  # fmt: skip
    lines = ('', '  ', "an 'open quote")
    for make, said, texts in (
        (webhook, '--webhook must be an address', addresses),
        (command, '--on-alarm', lines),
    ):
        for text in texts:
            with pytest.raises(UsageError, match=said):
                make(text)


def test_changes_of_a_unit_reach_the_webhook(hook):
    hook.statuses += [200, 200]
    notices = Notices(None, f'http://127.0.0.1:{hook.server_port}/', lambda _: None)
    unit = Unit('/m')
    predict(unit, 0)
    for _ in range(4):
        notices.tell(unit.changes())
    alarm(unit, 1)
    alarm(unit, 0)
    notices.tell(unit.changes())
    until(lambda: notices.counters()['valveflow_notices_sent'][1] == 2)
    notices.close()
    states = [json.loads(content)['state'] for _, _, content in hook.came]
    assert states == ['unacknowledged', 'normal']
