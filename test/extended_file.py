# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""An ``extended_model.json`` for the simulated plant of the tests, as ``diagnose`` writes one."""

import json
from pathlib import Path
from typing import Any

from valveflow_ros.plant.simulator import DEFAULT_START_NS


def extended_json(**causes: dict[str, float]) -> dict[str, Any]:
    return {
        'format': 'valveflow/extended_model', 'version': 2, 'pressure_exponent': 1.125,
        'start_ns': DEFAULT_START_NS,
        'reference': {
            'span_s': 34_560.0, 'temperature_degc': 539.0, 'log_pressure': 2.62,
            'pressure_level': 3.93, 'pressure_slope': 0.042, 'opening_noise': 0.01,
        },
        'curve': {
            'knots': [1060.0, 1250.0, 1600.0, 1900.0, 2300.0],
            'left': [154.5, 200.0, 263.0, 290.0], 'right': [200.0, 263.0, 290.0, 294.0],
        },
        'dynamics': {
            'levels': [240.0], 'time_constants_s': [10.0, 80.0], 'delays_s': [3.0, 10.0],
        },
        'causes': [
            {'name': name, 'values': values, 'switches_s': []} for name, values in causes.items()
        ],
    }  # fmt: skip


def write_extended(path: Path, **causes: dict[str, float]) -> Path:
    path.write_text(json.dumps(extended_json(**causes)), encoding='utf-8')
    return path
