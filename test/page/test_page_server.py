# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page's server: what it answers, what it refuses, and what hostile or slow peers can do."""

import http.client
import json
import math
import socket
import time
from contextlib import ExitStack, suppress

import pytest
from page_units import alarm, predict, shown_now, told

from valveflow_ros.errors import DataError, InputError, RecordingError, ValveflowError
from valveflow_ros.page import server as module
from valveflow_ros.page.server import MOST_CONNECTIONS, check_installed, read_token
from valveflow_ros.page.unit import Shown, Unit
from valveflow_ros.records import zone_of
from valveflow_ros.report.terminal.board import CURVE


@pytest.fixture(scope='module')
def quiet(serve_long):
    """Return a server of little that several tests speak to."""
    return serve_long(shown_now(told(seconds=3)), names=['Plant.Example'])


def asked(server, path='/', method='GET', body=None, **head):
    """Return status, headers and text of an answer."""
    connection = http.client.HTTPConnection('127.0.0.1', server.port, timeout=20)
    names = {k.replace('_', '-'): v for k, v in head.items()}
    connection.request(method, path, body=body, headers=names)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, dict(answer.getheaders()), text


def tick(server, seen=None, **head):
    """Ask for what a browser asks for each tick; return status and the parts that came."""
    ids = [{'unit': 0, 'part': 'pictures'}]
    names = ('head', 'alarms', 'curve_words', 'now', 'diagnosis', 'health')
    outputs = [
        *([{'id': {'unit': 0, 'part': name}, 'property': 'children'}] for name in names),
        [{'id': {'unit': 0, 'part': 'pictures'}, 'property': 'data'}],
        {'id': 'note', 'property': 'children'}, {'id': 'note', 'property': 'className'},
        {'id': 'seen', 'property': 'data'},
    ]  # fmt: skip
    _, _, described = asked(server, '/_dash-dependencies')
    output = next(d['output'] for d in json.loads(described) if 'seen.data' in d['output'])
    content = {
        'output': output, 'outputs': outputs, 'changedPropIds': ['tick.n_intervals'],
        'inputs': [{'id': 'tick', 'property': 'n_intervals', 'value': 1}],
        'state': [{'id': 'seen', 'property': 'data', 'value': seen},
                  [{'id': i, 'property': 'id', 'value': i} for i in ids]],
    }  # fmt: skip
    status, _, text = asked(
        server, '/_dash-update-component', 'POST', json.dumps(content),
        **{'Content_Type': 'application/json', **head},
    )  # fmt: skip
    return status, json.loads(text)['response'] if status == 200 else text


def test_the_page_and_its_metrics_are_served_from_here_alone(serve):
    server = serve(shown_now(told()))
    assert server.address == f'http://127.0.0.1:{server.port}/'
    status, head, text = asked(server)
    assert status == 200
    assert 'react-entry-point' in text
    assert "default-src 'self'" in head['Content-Security-Policy']
    assert "'unsafe-eval'" not in head['Content-Security-Policy']
    assert 'http://' not in text.replace('http://www.w3.org', '')
    assert 'https://' not in text
    status, head, text = asked(server, '/metrics')
    assert (status, head['Content-Type'].split(';')[0]) == (200, 'text/plain')
    assert 'valveflow_monitor_up{unit="U1"} 1.0' in text
    status, _, text = asked(server, '/_dash-layout')
    assert status == 200
    assert 'The valve sticks.' in text
    assert 'Lubricate' in text


def test_times_are_told_and_drawn_in_a_zone(serve):
    servers = [serve(shown_now(told()), zone=zone) for zone in (None, zone_of('+05:30'))]
    found = []
    for server, said in zip(servers, ('22:13 UTC', '03:43 UTC+05:30'), strict=True):
        _, _, text = asked(server, '/_dash-layout')
        assert said in text
        assert f'Clock and pictures are in {said[6:]}.' in text
        seen = tick(server, {})[1]['seen']['data']
        _, whole = tick(server, {'generation': seen['generation']})
        made = whole['{"part":"pictures","unit":0}']['data']
        found.append(made['recent']['data'][0]['x'])
    assert [b - a for a, b in zip(*found, strict=True)] == [5.5 * 3_600_000.0] * len(found[0])


def test_a_browser_is_sent_what_has_changed_and_no_more(serve):
    unit = told()
    shown = shown_now(unit)
    server = serve(shown)
    status, first = tick(server, {})
    # A page that was loaded from another server, or for other units, is only told to load again.
    assert (status, set(first)) == (200, {'note', 'seen'})
    generation = {'generation': first['seen']['data']['generation']}
    _, whole = tick(server, generation)
    pictures = whole['{"part":"pictures","unit":0}']['data']
    assert set(pictures) == {'curve', 'recent', 'day'}
    assert whole['{"part":"head","unit":0}']['children']
    _, nothing = tick(server, whole['seen']['data'])
    assert set(nothing) == {'note', 'seen'}
    alarm(unit, 1, second=199)
    shown.put([unit.snapshot(unit.frame('m'))], 'Look.')
    _, changed = tick(server, nothing['seen']['data'])
    assert changed['note']['children'] == 'Look.'
    # Not only the alarm: one word at the head of the unit sums it up.
    assert set(changed) == {
        'note', 'seen', '{"part":"alarms","unit":0}', '{"part":"head","unit":0}'
    }  # fmt: skip


def test_hours_without_a_sample_are_a_gap():
    pytest.importorskip('dash', reason='the page is an extra')
    from valveflow_ros.page.view import day_picture

    unit = told(seconds=130)
    for k in range(7200, 7330):
        predict(unit, k)
    (found,) = shown_now(unit).units
    band, *_, measured = day_picture(found)['data']
    assert measured['y'].count(None) == 1
    assert len(measured['y']) == 6
    # Two outlines: the band does not run through the gap.
    assert len(band['y']) == 2 * 5 + 1
    assert band['x'].count(None) == band['y'].count(None) == 1


REFUSED = {
    'a name that was made to point here': ('/', 'GET', {'Host': 'evil.example'}, 403),
    'the same with a port': ('/metrics', 'GET', {'Host': 'evil.example:8350'}, 403),
    'no name': ('/', 'GET', {'Host': ''}, 403),
    'a broken name': ('/', 'GET', {'Host': '[::1'}, 403),
    'another origin': ('/metrics', 'GET', {'Origin': 'http://evil.example'}, 403),
    'an origin that is a secret': ('/', 'GET', {'Origin': 'null'}, 403),
    'another port': ('/', 'GET', {'Origin': 'http://127.0.0.1:1'}, 403),
    'a picture in another page': ('/metrics', 'GET', {'Sec_Fetch_Site': 'cross-site'}, 403),
    'a form in another page': (
        '/_dash-update-component', 'POST', {'Origin': 'http://evil.example'}, 403
    ),
    'no such page': ('/etc/passwd', 'GET', {}, 404),
    'a way out': ('/_dash-component-suites/../../etc/passwd', 'GET', {}, 400),
    'a file the library does not offer': ('/_dash-component-suites/dash/dash.py', 'GET', {}, 400),
    'a method': ('/', 'POST', {}, 405),
    'another method': ('/metrics', 'DELETE', {}, 405),
    'a head that is too large': ('/', 'GET', {'X': 'y' * 20000}, 431),
    'nothing to update': ('/_dash-update-component', 'POST', {}, 415),
}  # fmt: skip


def test_what_is_refused(quiet, capfd):
    for what, (path, method, head, status) in REFUSED.items():
        found, _, text = asked(quiet, path, method, **head)
        assert (found, what) == (status, what)
        assert len(text) < 200, what
        assert 'Traceback' not in text, what
    for body in ('', '{', '[]', 'null', '"x"', '{"output": 7}', '{"output":"a.b","inputs":[7]}',
                 'é' * 9):  # fmt: skip
        status, _, text = asked(
            quiet, '/_dash-update-component', 'POST', body.encode(),
            Content_Type='application/json',
        )  # fmt: skip
        assert (status, 'Traceback' in text) == (400, False), body
    for sent in (b'\0' * 100, b'GET / HTTP/9\r\n\r\n', b'\x16\x03\x01\x02\0\x01',
                 b'GET\r\n\r\n' * 50):  # fmt: skip
        with socket.create_connection(('127.0.0.1', quiet.port), timeout=20) as peer:
            peer.sendall(sent)
            peer.shutdown(socket.SHUT_WR)
            answer = peer.recv(65536)
        assert answer == b'' or b' 40' in answer.split(b'\r\n')[0], sent
    assert 'Traceback' not in capfd.readouterr().err
    assert asked(quiet)[0] == 200


def test_garbage_for_what_was_seen_does_no_harm(quiet):
    for seen in (None, 7, {'0': 7}, {'generation': None, '0': {'head': []}}):
        assert tick(quiet, seen)[0] == 200


def test_a_body_without_end_is_refused(quiet):
    with socket.create_connection(('127.0.0.1', quiet.port), timeout=20) as peer:
        peer.sendall(
            b'POST /_dash-update-component HTTP/1.1\r\nHost: localhost\r\n'
            b'Content-Length: 1000000000\r\n\r\n'
        )
        assert b'413' in peer.recv(65536)


def test_our_own_names(quiet):
    for name in ('localhost', '127.0.0.1', '[::1]', '10.1.2.3', 'plant.example'):
        host = f'{name}:{quiet.port}'
        assert asked(quiet, Host=host, Origin=f'http://{host}')[0] == 200


@pytest.mark.parametrize(
    ('host', 'said'),
    [('127.0.0.1', r'Port \d+ of 127\.0\.0\.1 is in use'),
     *((h, h) for h in ('no.such.name.invalid', '203.0.113.7', 'ä' * 100))],
)  # fmt: skip
def test_an_address_that_cannot_be_used_is_told(serve, quiet, host, said):
    with pytest.raises(ValveflowError, match=said):
        serve(Shown(), host=host, port=quiet.port)


def test_two_hundred_connections_and_then_too_many(serve):
    server = serve(shown_now(told(seconds=3)))
    with ExitStack() as stack:

        def more(count):
            for _ in range(count):
                peer = socket.create_connection(('127.0.0.1', server.port), timeout=20)
                stack.enter_context(peer).sendall(b'GET / HT')

        more(200)
        assert asked(server)[0] == 200
        assert tick(server, {})[0] == 200
        more(MOST_CONNECTIONS - 195)
        status, head, text = asked(server)
        assert (status, head.get('Retry-After')) == (503, '10')
        assert text == 'Too many connections; try again.\n'
    deadline_s = time.monotonic() + 20
    while asked(server)[0] != 200:
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def test_slow_peers_are_left(serve, monkeypatch):
    monkeypatch.setattr(module, 'IDLE_S', 1)
    monkeypatch.setattr(module, '_SWEEP_S', 0.2)
    server = serve(shown_now(told(seconds=3)))
    line = b'GET / HTTP/1.1\r\nHost: localhost\r\n'
    # Idle, half a request, one that drips, and one that does not read.
    sends = {'idle': b'', 'half': line, 'drips': line, 'deaf': (line + b'\r\n') * 400}
    with ExitStack() as stack:
        peers = {}
        for kind, sent in sends.items():
            peers[kind] = peer = stack.enter_context(socket.socket())
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            peer.settimeout(20)
            peer.connect(('127.0.0.1', server.port))
            peer.sendall(sent)
        assert asked(server)[0] == 200
        deadline_s = time.monotonic() + 20
        while server.connections():
            assert time.monotonic() < deadline_s, 'some are still connected'
            with suppress(OSError):
                peers['drips'].sendall(b'X')
            time.sleep(0.1)
    assert asked(server)[0] == 200


def test_a_unit_of_which_little_is_known_is_shown(serve):
    unit, nan, never = Unit('/m'), math.nan, {'sec': 0, 'nanosec': 0}
    unit.take(CURVE, {
        'header': {'stamp': never, 'frame_id': 'U1'}, 'breakpoints': [], 'values': [], 'status': 0,
        'cause': 'No curve yet.', 'model_id': '', 'samples': 0, 'window_start': never,
        'window_end': never, 'rmse_mw': nan, 'pressure_exponent': nan,
    })  # fmt: skip
    said = []
    server = serve(shown_now(Unit('/n'), unit), complain=said.append)
    status, _, text = asked(server, '/_dash-layout')
    assert status == 200
    assert 'No curve yet.' in text
    assert said == []


def test_an_error_of_the_page_is_told_once(serve):
    said = []
    server = serve(Shown(), complain=said.append)
    server.guard._metrics = lambda: {}['nothing']
    for _ in range(3):
        assert asked(server, '/metrics')[0] == 400
    assert said == ["A request of /metrics was not answered (KeyError: 'nothing')."]


def test_without_a_token_nothing_can_be_asked(quiet):
    assert 'Acknowledge' not in asked(quiet, '/_dash-layout')[2]
    assert 'answer' not in asked(quiet, '/_dash-dependencies')[2]


def test_a_token_and_few_wrong_ones():
    pytest.importorskip('dash', reason='the page is an extra')
    from valveflow_ros.page.view import Asking

    done = []

    def ask(unit, service):
        done.append((unit, service))
        return True, 'Acknowledged.'

    asking = Asking('the right one', ask)
    assert asking('/m', 'acknowledge residual', 'the right one') == (True, 'Acknowledged.')
    assert asking('/m', 'set_reference', 'the right one')[0] is False
    assert asking('/m', 'shelve residual', '')[0] is False
    for _ in range(5):
        asking('/m', 'shelve residual', 'the wrong one\udcff')
    # The right one has to wait as well, or guessing would be told from not guessing.
    assert 'wait' in asking('/m', 'shelve residual', 'the right one')[1]
    assert done == [('/m', 'acknowledge residual')]


def test_the_file_of_the_token(tmp_path):
    path = tmp_path / 'token'
    path.write_bytes(b' eight signs \nmore\n')
    assert read_token(path) == 'eight signs'
    for content in (b'short\n', b'', b'\xff' * 9):
        path.write_bytes(content)
        with pytest.raises((InputError, RecordingError), match='token'):
            read_token(path)


def test_without_its_libraries_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(module, 'find_spec', lambda name: None if name == 'dash' else name)
    with pytest.raises(DataError, match=r'page needs dash, not installed here: pip install dash'):
        check_installed()
