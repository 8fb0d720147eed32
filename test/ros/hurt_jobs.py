# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Jobs that go wrong in every way a fit might."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from dataclasses import replace
from typing import Any

from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node.engine import example_curve


def good(task: Any) -> Any:
    """Return a curve at once."""
    curve = example_curve(Settings())
    source = replace(curve.source, window_end_ns=int(task.contents.time_ns[-1]))
    return replace(curve, source=source).with_id()


def raises(task: Any) -> Any:
    """Fail as code with a fault does."""
    raise ZeroDivisionError('a fault')


def refuses(task: Any) -> Any:
    """Refuse the data as `fit` does."""
    from valveflow_ros.errors import DataError

    raise DataError('There is no curve in these data.')


def hangs(task: Any) -> Any:
    """Never come back."""
    time.sleep(3600.0)


def dies(task: Any) -> Any:
    """Be killed, as by the kernel when memory runs out."""
    os.kill(os.getpid(), signal.SIGKILL)


def prints(task: Any) -> Any:
    """Write to standard output, where the results go, before giving a good one."""
    print('x' * 10_000, flush=True)
    os.write(1, b'y' * 10_000)
    return good(task)


def writes_nonsense(task: Any) -> Any:
    """Write what is no message into every socket there is; eight bytes are the task's name."""
    sent = (task.request_ns << 1).to_bytes(8, 'big') + b'no message at all'
    for name in os.listdir('/proc/self/fd'):
        if os.path.realpath(f'/proc/self/fd/{name}').startswith('/proc') and int(name) > 2:
            with contextlib.suppress(OSError):
                os.write(int(name), sent)
    time.sleep(3600.0)


def nan(task: Any) -> Any:
    """Give a slope that is no number."""
    curve = good(task)
    return replace(curve, pieces=(replace(curve.pieces[0], slope=float('nan')), curve.pieces[1]))


def backwards(task: Any) -> Any:
    """Give breakpoints that do not increase."""
    curve = good(task)
    return replace(curve, pieces=(curve.pieces[1], curve.pieces[0]))


def of_other_data(task: Any) -> Any:
    """Answer for a window that was not asked about."""
    curve = good(task)
    return replace(curve, source=replace(curve.source, window_end_ns=1)).with_id()


def renamed(task: Any) -> Any:
    """Give a curve under another curve's name."""
    return replace(good(task), model_id='000000000000')


def nothing(task: Any) -> Any:
    """Give no curve at all."""
    return None


def greedy(task: Any) -> Any:
    """Ask for more memory than there is."""
    raise MemoryError


ALL = (good, raises, refuses, greedy, nothing, nan, backwards, of_other_data, renamed, prints)


def told(task: Any) -> Any:
    """Do the one of `ALL` whose number is the task's name."""
    return ALL[task.request_ns](task)


def diagnosed(task: Any) -> Any:
    """Return a small diagnosis at once."""
    from valveflow_ros.monitoring.events import DiagnosisContent

    content = {
        'verdict': 'nothing', 'sentence': 'The model explains the unit.', 'causes': [],
        'not_told_apart': [], 'unexplained_by': [], 'rejected': [], 'disturbance': None,
        'rmse_simulation': 2.0, 'rmse_extended': 2.0, 'rmse_noise_floor': None,
    }  # fmt: skip
    return DiagnosisContent(task.window_end_ns, json.dumps(content))


def diagnosed_other_data(task: Any) -> Any:
    """Answer for a window that was not asked about."""
    return replace(diagnosed(task), window_end_ns=1)


def no_verdict(task: Any) -> Any:
    """Give a verdict that does not exist."""
    content = diagnosed(task)
    return replace(content, text=content.text.replace('nothing', 'perhaps'))


def half(task: Any) -> Any:
    """Give half of a result."""
    content = diagnosed(task)
    return replace(content, text='{"verdict": "named", "sentence": "Something."}')
