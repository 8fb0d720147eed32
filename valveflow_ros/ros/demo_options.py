"""The command line of the demo."""

from __future__ import annotations

import argparse
from pathlib import Path


def parser() -> argparse.ArgumentParser:
    """Return the description of the command line."""
    made = argparse.ArgumentParser(
        prog='python -m valveflow_ros.ros.demo',
        description='Run a simulated plant and the monitor as two ROS 2 processes, switch a '
        'fault on, and show what the monitor says and records.',
    )
    made.add_argument('--output', type=Path, required=True, metavar='DIR', help='for all results')
    made.add_argument('--days', type=float, default=3.0, help='of plant (default: 3)')
    made.add_argument('--seed', type=int, default=1, help='of the plant (default: 1)')
    made.add_argument(
        '--rate',
        type=float,
        default=0.0,
        help='plant seconds in a second; 0: as fast as the monitor takes it (default: 0)',
    )
    return made
