# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page beside real monitors: what it shows and asks, kills and starts, and how it ends."""

import importlib.util
import json
import re
import signal
import socket
import threading
import urllib.request

import pytest
from rclpy.executors import SingleThreadedExecutor
from ros_helpers import spin_until, wait_until
from test_ros_watch import Speaker
from valveflow_msgs.srv import OperateAlarm

EXTRA = ('dash', 'prometheus_client', 'waitress')
pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(
        any(importlib.util.find_spec(name) is None for name in EXTRA),
        reason=f'{", ".join(EXTRA)} not installed; the page is an extra',
    ),
]
PAGE = 'valveflow_ros.ros.page_main'


@pytest.fixture
def port():
    with socket.create_server(('127.0.0.1', 0)) as free:
        return int(free.getsockname()[1])


def page_of(port, path):
    with urllib.request.urlopen(f'http://127.0.0.1:{port}{path}', timeout=10) as answer:
        return str(answer.read().decode())


def metrics(port):
    try:
        return page_of(port, '/metrics')
    except OSError:
        return ''


def newest(port):
    found = re.search(r'^valveflow_sample_timestamp_seconds\S* (\S+)$', metrics(port), re.M)
    return float(found[1]) if found else 0.0


def test_every_monitor_is_shown_asked_and_told_of(context, speaker, processes, port, tmp_path):
    token, told = tmp_path / 'token', tmp_path / 'told'
    token.write_text('the right one\n')
    tell = tmp_path / 'tell'
    tell.write_text(f'#!/bin/sh\ncat >> {told}\necho >> {told}\n')
    tell.chmod(0o755)
    other = Speaker(context, 'other')
    process = processes.start(
        PAGE, '--port', str(port), '--token-file', str(token), '--on-alarm', str(tell)
    )

    def both():
        speaker.go_on()
        other.go_on()
        return metrics(port).count('valveflow_power_residual_watts{') == 2

    wait_until(both, 'both monitors')
    for publisher in (speaker.predictions, speaker.health, other.predictions):
        publisher.publish(b'\x00\x01\x00\x00no message')
    text = metrics(port)
    # Two units of one tag are told apart by their monitors.
    assert 'valveflow_power_residual_watts{unit="/other"} 1.5e+06' in text
    assert 'valveflow_health_level{item="input valve_opening",unit="/valveflow_monitor"} 3' in text
    assert 'It sticks.' in page_of(port, '/_dash-layout')

    wait_until(
        lambda: told.exists() and told.read_text().count('\n') == 2,
        'a notice of each alarm that stands',
    )
    first = json.loads(told.read_text().splitlines()[0])
    assert (first['alarm'], first['state'], first['previous_state']) == (
        'residual', 'unacknowledged', None,
    )  # fmt: skip

    asked = []

    def answer(request, response):
        asked.append((request.action, request.name))
        response.success, response.message = True, 'Acknowledged.'
        return response

    speaker.create_service(OperateAlarm, '~/operate_alarm', answer)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(speaker)
    ids = [{'unit': k, 'part': 'answer'} for k in (0, 1)]
    pressed = {'unit': 1, 'ask': 'shelve curve_shift'}
    output = next(
        d['output']
        for d in json.loads(page_of(port, '/_dash-dependencies'))
        if '"answer"' in d['output']
    )
    content = {
        'output': output, 'outputs': [{'id': i, 'property': 'children'} for i in ids],
        'changedPropIds': ['{"ask":"shelve curve_shift","unit":1}.n_clicks'],
        'inputs': [[{'id': pressed, 'property': 'n_clicks', 'value': 1}]],
        'state': [{'id': 'token', 'property': 'value', 'value': 'the right one'},
                  [{'id': i, 'property': 'id', 'value': i} for i in ids]],
    }  # fmt: skip
    request = urllib.request.Request(
        f'http://127.0.0.1:{port}/_dash-update-component', json.dumps(content).encode(),
        {'Content-Type': 'application/json'},
    )  # fmt: skip
    answers = []

    def ask():
        with urllib.request.urlopen(request, timeout=20) as found:
            answers.append(found.read().decode())

    thread = threading.Thread(target=ask)
    thread.start()

    spin_until(executor, lambda: answers, 'the answer', 30.0)
    thread.join()
    executor.shutdown()
    assert asked == [('shelve', 'curve_shift')]
    assert 'Acknowledged.' in answers[0]
    other.destroy_node()

    gone = 'valveflow_monitor_up{unit="/other"} 0.0'
    wait_until(lambda: gone in metrics(port), 'the end of the other monitor', 60.0)
    assert 'The monitor has stopped. Its last values are shown.' in page_of(port, '/_dash-layout')
    process.send_signal(signal.SIGTERM)
    assert process.wait(20) == 0
    assert 'Traceback' not in processes.output(process)


@pytest.mark.long
def test_a_monitor_that_is_killed_and_started_again(processes, port, browser):
    """The real monitor and a real browser: it goes on with what comes."""
    page = processes.start(PAGE, '--port', str(port))
    wait_until(lambda: metrics(port), 'the page')
    browser.look(1280)
    browser.call('Page.navigate', url=f'http://127.0.0.1:{port}/')

    def shows(text):
        def found():
            try:
                return browser.ask(f'document.getElementById("page").innerText.includes({text!r})')
            except RuntimeError:
                return False

        wait_until(found, text, 90.0)

    shows('No monitor was found yet.')
    words = ('--ros-args', '-p', 'unit_tag:=U7', '-p', 'record:=false', '-p', 'keep_state:=false')
    plant = ('-p', 'stamped:=true', '-p', 'rate:=20.0', '-p', 'days:=0.1')
    monitor = processes.start('valveflow_ros.ros.monitor_main', *words)
    simulator = processes.start('valveflow_ros.ros.simulator_main', '--ros-args', *plant)
    shows('U7')
    shows('no curve yet')
    monitor.send_signal(signal.SIGKILL)
    before = newest(port)
    processes.start('valveflow_ros.ros.monitor_main', *words)
    wait_until(lambda: newest(port) > before + 60.0, 'samples of the new one', 90.0)
    shows('no curve yet')
    assert page.poll() is None
    assert 'Traceback' not in processes.output(page)
    simulator.send_signal(signal.SIGINT)
    browser.call('Page.navigate', url='about:blank')
    page.send_signal(signal.SIGINT)
    assert page.wait(20) == 0
