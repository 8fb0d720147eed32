# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Jobs that go wrong in every way a fit or a diagnosis might."""

import contextlib
import json
import os
import signal
import time
from dataclasses import replace

from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.events import DiagnosisContent
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node.engine import example_curve


def good(task):
    curve = example_curve(Settings())
    source = replace(curve.source, window_end_ns=int(task.contents.time_ns[-1]))
    return replace(curve, source=source).with_id()


def raises(task):
    """Fail as code with a fault does."""
    raise ZeroDivisionError('a fault')


def refuses(task):
    """Refuse the data as `fit` does."""
    raise DataError('There is no curve in these data.')


def greedy(task):
    """Ask for more memory than there is."""
    raise MemoryError


def hangs(task):
    time.sleep(3600.0)


def dies(task):
    """Be killed, as by the kernel when memory runs out."""
    os.kill(os.getpid(), signal.SIGKILL)


def prints(task):
    """Write to standard output, where the results go, before giving a good one."""
    print('x' * 10_000, flush=True)
    os.write(1, b'y' * 10_000)
    return good(task)


def writes_nonsense(task):
    """Write what is no message into every socket there is; eight bytes are the task's name."""
    sent = (task.request_ns << 1).to_bytes(8, 'big') + b'no message at all'
    for name in os.listdir('/proc/self/fd'):
        if os.path.realpath(f'/proc/self/fd/{name}').startswith('/proc') and int(name) > 2:
            with contextlib.suppress(OSError):
                os.write(int(name), sent)
    time.sleep(3600.0)


def nothing(task):
    """Give no result at all."""


def nan(task):
    first, second = good(task).pieces
    return replace(good(task), pieces=(replace(first, slope=float('nan')), second))


def backwards(task):
    return replace(good(task), pieces=good(task).pieces[::-1])


def of_other_data(task):
    return replace(good(task), source=example_curve(Settings()).source).with_id()


def renamed(task):
    return replace(good(task), model_id='000000000000')


def told(task):
    """Do the one of `BAD_FITS` whose number is the task's name, or `prints`."""
    return [*BAD_FITS, prints][task.request_ns](task)


BAD_FITS = {
    raises: 'failed unexpectedly: a fault (ZeroDivisionError, hurt_jobs.py, line',
    refuses: 'There is no curve in these data.',
    greedy: 'more memory than there is',
    nothing: 'gave no curve',
    nan: 'a curve that cannot be',
    backwards: 'a curve that cannot be',
    of_other_data: 'other data',
    renamed: 'its own name',
}


def diagnosed(task):
    """Return a small diagnosis at once."""
    content = {
        'verdict': 'nothing', 'sentence': 'The model explains the unit.', 'causes': [],
        'not_told_apart': [], 'unexplained_by': [], 'rejected': [], 'disturbance': None,
        'rmse_simulation': 2.0, 'rmse_extended': 2.0, 'rmse_noise_floor': None,
    }  # fmt: skip
    return DiagnosisContent(task.window_end_ns, json.dumps(content))


def no_verdict(task):
    content = diagnosed(task)
    return replace(content, text=content.text.replace('nothing', 'perhaps'))


def diagnosed_other_data(task):
    return replace(diagnosed(task), window_end_ns=1)


def half(task):
    return replace(diagnosed(task), text='{"verdict": "named", "sentence": "Something."}')


BAD_DIAGNOSES = {
    raises: 'The diagnosis failed unexpectedly: a fault (ZeroDivisionError',
    refuses: 'There is no curve in these data.',
    nothing: 'gave no result',
    diagnosed_other_data: 'answered for other data',
    no_verdict: 'gave no verdict',
    half: 'cannot be checked (KeyError)',
}
