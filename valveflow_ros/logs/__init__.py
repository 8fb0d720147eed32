# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads, writes and repairs log files without ROS: MCAP recordings and tables."""

from valveflow_ros.logs.contents import LogContents, LoggedMessage, TopicInfo
from valveflow_ros.logs.mcap.cdr import Decoder
from valveflow_ros.logs.mcap.definitions import Definitions
from valveflow_ros.logs.mcap.importing import WrittenLog, write_samples
from valveflow_ros.logs.mcap.reading import messages_since
from valveflow_ros.logs.mcap.recorder import (
    Recorder,
    RecorderSettings,
    RecorderState,
    RecorderStatus,
)
from valveflow_ros.logs.mcap.recover import RecoveryReport, recover, recover_leftovers
from valveflow_ros.logs.mcap.writer import LATCHED, Message, Qos, RecordingWriter
from valveflow_ros.logs.outputs import outputs_in, write_outputs
from valveflow_ros.logs.reader import open_log
from valveflow_ros.logs.tables.table import RawTable, read_table, write_table

__all__ = [
    'LATCHED',
    'Decoder',
    'Definitions',
    'LogContents',
    'LoggedMessage',
    'Message',
    'Qos',
    'RawTable',
    'Recorder',
    'RecorderSettings',
    'RecorderState',
    'RecorderStatus',
    'RecordingWriter',
    'RecoveryReport',
    'TopicInfo',
    'WrittenLog',
    'messages_since',
    'open_log',
    'outputs_in',
    'read_table',
    'recover',
    'recover_leftovers',
    'write_outputs',
    'write_samples',
    'write_table',
]
