# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes the calls by which one thread changes the disk fail, one after the other."""

import errno
import os
import threading
import time
from contextlib import contextmanager

# Every call of the operating system that a recorder's thread makes to change the disk.
CALLS = (
    'open', 'write', 'fsync', 'fdatasync', 'replace', 'rename', 'unlink', 'fchmod', 'mkdir',
    'ftruncate', 'close',
)  # fmt: skip
SHORT = 0


class Faults:
    """Counts the calls of a thread and fails them from one on, until healed.

    Parameters
    ----------
    thread : str
        The thread's name; calls of others are not touched.
    first : int
        Number of the first call that fails, from 1.
    error : int
        The `errno` it fails with, or `SHORT`: that write takes a half and says so.
    once : bool
        The calls after it succeed.
    """

    def __init__(self, thread, first, error, once=False):
        self.calls = 0
        self.failed_at_s = None
        self.what = ''
        self._thread, self._first, self._error = thread, first, error
        self._once, self._healed = once, False

    def heal(self):
        """Let everything succeed from now on."""
        self._healed = True

    @contextmanager
    def active(self):
        """Stand between the thread and the operating system."""
        real = {name: getattr(os, name) for name in CALLS}
        try:
            for name, call in real.items():
                setattr(os, name, self._between(name, call))
            yield
        finally:
            for name, call in real.items():
                setattr(os, name, call)

    def _between(self, name, call):
        def watched(*arguments, **named):
            if threading.current_thread().name != self._thread:
                return call(*arguments, **named)
            self.calls += 1
            if self._healed or self.calls < self._first:
                return call(*arguments, **named)
            return self._fail(name, call, arguments, named)

        return watched

    def _fail(self, name, call, arguments, named):
        if self.failed_at_s is None:
            self.failed_at_s = time.monotonic()
            self.what = name
        self._healed |= self._once or self._error == SHORT
        half = b''
        if name == 'write':
            half = bytes(arguments[1])[: len(arguments[1]) // 2]
        if self._error == SHORT:
            return call(arguments[0], half) if half else call(*arguments, **named)
        if half and self._error == errno.ENOSPC:
            # A full disk takes a part before it says so.
            call(arguments[0], half)
        if name == 'close':
            # Linux lets go of the descriptor whatever it answers.
            call(*arguments, **named)
        raise OSError(self._error, os.strerror(self._error))
