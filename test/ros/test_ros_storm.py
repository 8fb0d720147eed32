# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A burst of requests: each is answered, also while parameters change and fits run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from listener import MONITOR, Listener, start_monitor
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.qos import QoSProfile
from ros_helpers import Processes
from std_srvs.srv import Trigger

from valveflow_ros.ros.node.outputs import SERVICES

pytestmark = pytest.mark.ros
BURSTS, OF_EACH = 3, 17
# Who calls must hold so many answers too.
MANY = QoSProfile(depth=1000)


def test_each_request_of_a_burst_is_answered(
    processes: Processes, context: Any, tmp_path: Path
) -> None:
    monitor = start_monitor(processes, tmp_path)
    caller = Listener(context, 'caller')
    value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=7200.0)
    change = SetParameters.Request(parameters=[Parameter(name='alarm_shelve_time', value=value)])
    asked: list[tuple[Any, str, Any]] = [
        *((Trigger, name, Trigger.Request()) for name in SERVICES),
        (SetParameters, 'set_parameters', change),
        (GetParameters, 'get_parameters', GetParameters.Request(names=['unit_tag'])),
    ]
    requests = [
        (caller.node.create_client(kind, f'{MONITOR}/{name}', qos_profile=MANY), request)
        for kind, name, request in asked
    ]
    caller.until(lambda: all(c.service_is_ready() for c, _ in requests), 'the services')
    answers, longest_s = [], 0.0
    for _ in range(BURSTS):
        begun_s = time.monotonic()
        burst = [c.call_async(request) for c, request in requests for _ in range(OF_EACH)]
        caller.until(lambda burst=burst: all(f.done() for f in burst), 'the answers', 30.0)
        longest_s = max(longest_s, time.monotonic() - begun_s)
        answers += [future.result() for future in burst]
    print(f'{len(answers)} answers, the last of a burst after {longest_s:.2f} s at most')
    assert len(answers) == BURSTS * OF_EACH * len(requests)
    assert all(a.message for a in answers if isinstance(a, Trigger.Response))
    assert monitor.poll() is None
    caller.close()
