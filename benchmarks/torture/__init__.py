# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Trials that hurt recordings, files and processes on purpose, and count what comes of it."""

import sys
from pathlib import Path

# Small recordings and slow truths stand with the tests of logs, once.
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / 'test' / 'logs'))
