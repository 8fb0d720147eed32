"""What an earlier run had said is not said again, and what it had not is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy')

from valveflow_ros.logs import LoggedMessage
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node.restart import Earlier, retrace
from valveflow_ros.ros.outputs import Output
from valveflow_ros.signals.align import Aligner

NAMES = {'/m/characteristic': 'characteristic', '/m/breakpoints': 'breakpoints'}
LOG_NS = 1_700_000_000_000_000_000
# As `Session` records them: before the first row there is no time of the plant, and the message
# bears the time of the log.
BEFORE, AFTER = Output('characteristic', b'curve', 0), Output('breakpoints', b'knots', 5_000)


def recorded(output: Output) -> LoggedMessage:
    topic = f'/m/{output.name}'
    return LoggedMessage(topic, 'some/msg/Type', LOG_NS, output.time_ns or LOG_NS, output.data)


@pytest.mark.parametrize(
    ('said', 'again'),
    [
        ([], [BEFORE, AFTER]),
        ([BEFORE], [AFTER]),
        ([AFTER], [BEFORE]),
        ([AFTER, BEFORE], []),
    ],
)
def test_each_output_stands_in_the_recording_once(said: list[Output], again: list[Output]) -> None:
    settings = Settings()
    engine: Any = SimpleNamespace(monitor=Monitor(settings), aligner=Aligner(settings))
    speaker: Any = SimpleNamespace(of=lambda events: [BEFORE, AFTER])
    earlier = Earlier(settings, LOG_NS, None, [recorded(output) for output in said])

    def curves(model_id: str) -> Any:
        raise AssertionError(model_id)

    left: list[str] = []
    assert list(retrace(engine, speaker, earlier, {}, NAMES, curves, left)) == again
    assert left == []
