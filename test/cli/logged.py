"""What stands in a log that a verb has written."""

from __future__ import annotations

from valveflow_ros.logs import open_log


def values(path, signal):
    readings = open_log(path).readings
    return readings.value[readings.signal == signal]
