"""How much a file may cost before it is given up."""

from __future__ import annotations

from dataclasses import dataclass

MIB = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds a reader keeps to, whatever a file claims.

    The work bounds grow with the file, because an honest file of a plant
    compresses at most some ten times: ``work_floor_bytes + work_per_byte * size``
    may be decompressed in all, and ``failed_floor_bytes + failed_per_byte * size``
    in vain.
    """

    record_bytes: int = 64 * MIB
    chunk_bytes: int = 32 * MIB
    channels: int = 1024
    definition_bytes: int = 4 * MIB
    attachment_bytes: int = 64 * MIB
    work_floor_bytes: int = 32 * MIB
    work_per_byte: int = 64
    failed_floor_bytes: int = 128 * MIB
    failed_per_byte: int = 2


DEFAULT_LIMITS = Limits()


class OverBudgetError(Exception):
    """A file costs more work than its size justifies; never leaves the package."""


class Budget:
    """Counts the bytes a file makes the reader work through."""

    __slots__ = ('failed_left', 'left')

    def __init__(self, file_bytes: int, limits: Limits = DEFAULT_LIMITS) -> None:
        self.left = limits.work_floor_bytes + limits.work_per_byte * file_bytes
        self.failed_left = limits.failed_floor_bytes + limits.failed_per_byte * file_bytes

    def spend(self, size: int) -> None:
        """Count work before it is done; raises `OverBudgetError` when the purse is empty."""
        self.left -= size
        if self.left < 0:
            raise OverBudgetError

    def regret(self, size: int) -> None:
        """Count work that turned out to be in vain."""
        self.failed_left -= size
        if self.failed_left < 0:
            raise OverBudgetError
