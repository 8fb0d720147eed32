# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Online identification and monitoring of main steam valve flow characteristics.

The Python interface, ``import valveflow_ros as vf``: `open_log`, `identify`, `diagnose`,
`compare`, `validate`, `monitor`, `fleet`, `judge_loop`, `simulate`, `load_characteristic`. Its
parts are loaded at their first use.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from valveflow_ros.interface import Progress
    from valveflow_ros.interface.compare import compare, validate
    from valveflow_ros.interface.diagnose import diagnose
    from valveflow_ros.interface.fleets.fleet import fleet
    from valveflow_ros.interface.identify import identify
    from valveflow_ros.interface.logs import open_log
    from valveflow_ros.interface.loop import judge_loop
    from valveflow_ros.interface.models import load_characteristic
    from valveflow_ros.interface.monitor import monitor
    from valveflow_ros.interface.simulate import simulate

__version__ = '0.1.0'
__all__ = [
    'Progress',
    'compare',
    'diagnose',
    'fleet',
    'identify',
    'judge_loop',
    'load_characteristic',
    'monitor',
    'open_log',
    'simulate',
    'validate',
]
_MODULES = {
    'compare': 'compare',
    'diagnose': 'diagnose',
    'fleet': 'fleets.fleet',
    'identify': 'identify',
    'judge_loop': 'loop',
    'load_characteristic': 'models',
    'monitor': 'monitor',
    'open_log': 'logs',
    'simulate': 'simulate',
    'validate': 'compare',
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    from importlib import import_module

    module = f'.{_MODULES[name]}' if name in _MODULES else ''
    return getattr(import_module(f'{__name__}.interface{module}'), name)


def __dir__() -> list[str]:
    return sorted([*__all__, '__version__'])
