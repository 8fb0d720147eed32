"""The command line of the demo."""

from __future__ import annotations

import argparse
from pathlib import Path

from valveflow_ros.report.terminal.terminal_number import number, whole
from valveflow_ros.ros.usage import Parser


def parser() -> argparse.ArgumentParser:
    """Return the description of the command line."""
    made = Parser(
        prog='python -m valveflow_ros.ros.demo',
        description='Run a simulated plant and the monitor as two ROS 2 processes, switch a '
        'fault on, and show what the monitor says and records.',
    )
    made.add_argument('--output', type=Path, required=True, metavar='DIR', help='for all results')
    made.add_argument(
        '--days', metavar='D', default=3.0, help='of plant (default: 3)',
        type=number('a number of days', 0, 400, '--days 3', above=True),
    )  # fmt: skip
    made.add_argument(
        '--seed', metavar='N', default=1, help='of the plant (default: 1)',
        type=whole('a whole number', 0, None, '--seed 1'),
    )  # fmt: skip
    made.add_argument(
        '--rate',
        metavar='R',
        type=number('plant seconds in a second', 0, 1e6, '--rate 600'),
        default=0.0,
        help='plant seconds in a second; 0: as fast as the monitor takes it (default: 0)',
    )
    return made
