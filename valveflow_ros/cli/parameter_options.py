"""The options that set parameters: ``--params`` and ``--set``."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path


def add_parameters(parser: ArgumentParser) -> None:
    """Add the options that `parameters.read_parameters` reads."""
    parser.add_argument(
        '--params', metavar='FILE', type=Path, help='parameters, a YAML file as the node takes it'
    )
    parser.add_argument(
        '--set', action='append', default=[], metavar='NAME=VALUE', dest='pairs',
        help='one parameter, such as time_constant=120; stands above the file',
    )  # fmt: skip
