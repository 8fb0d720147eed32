# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How much memory this process holds and has held."""

from __future__ import annotations

from pathlib import Path

MIB = 1 << 20
_STATUS = Path('/proc/self/status')


def _field(name: str) -> int:
    for line in _STATUS.read_text().splitlines():
        if line.startswith(name):
            return int(line.split()[1]) * 1024
    raise KeyError(name)


def resident() -> int:
    """Return the resident bytes."""
    return _field('VmRSS:')


def peak() -> int:
    """Return the most resident bytes since the start or the last `forget_peak`."""
    return _field('VmHWM:')


def address_space() -> int:
    """Return the bytes of address space."""
    return _field('VmSize:')


def forget_peak() -> None:
    """Let the peak begin anew."""
    Path('/proc/self/clear_refs').write_text('5')


def descriptors() -> int:
    """Return the number of open file descriptors."""
    return len(list(Path('/proc/self/fd').iterdir()))


def threads() -> int:
    """Return the number of threads."""
    return len(list(Path('/proc/self/task').iterdir()))
