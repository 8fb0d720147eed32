"""What a recorder is told and what it tells."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

from valveflow_ros.logs.mcap.recover import RecoveryReport

MIB = 1 << 20


class RecorderState(enum.Enum):
    """How a recorder is doing."""

    RECORDING = 'recording'
    DEGRADED = 'degraded'
    STOPPED = 'stopped'


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """How a recorder works; every time is in seconds.

    Attributes
    ----------
    queue_limit : int
        Messages held at most while they are not on disk; newer ones are dropped, and counted.
    flush_period_s : float
        A killed process loses at most what came in this time.
    sync_period_s : float
        A power cut loses at most what came in this time; 0: left to the system.
    rotate_s, rotate_bytes : float, int
        A new split is begun after this time or size.
    free_floor_bytes : int
        Below so much free space on the disk nothing is written.
    keep_files : int or None
        Finished splits that stay in the folder; the oldest go. None: all stay.
    retry_s, retry_max_s : float
        First and longest wait after a failure; it doubles.
    """

    queue_limit: int = 200_000
    flush_period_s: float = 0.5
    sync_period_s: float = 5.0
    rotate_s: float = 3600.0
    rotate_bytes: int = 256 * MIB
    free_floor_bytes: int = 500 * MIB
    keep_files: int | None = None
    retry_s: float = 1.0
    retry_max_s: float = 10.0


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """A recorder's account: ``received == written + queued + lost + sum of dropped``, always.

    Attributes
    ----------
    state : RecorderState
        How it is doing.
    reason : str
        Why it is not recording; empty if it is.
    file : str
        The split at hand, empty if none.
    received : int
        Messages handed in.
    written : int
        Of these, in whole chunks on disk.
    queued : int
        Of these, waiting.
    lost : int
        Of these, waiting when the recorder had to stop.
    dropped : dict[str, int]
        Of these, refused because too many were waiting, by topic.
    files_finished : int
        Splits finished since the start.
    bytes_written : int
        Bytes written since the start.
    recovered : tuple of RecoveryReport
        Leftovers of an earlier recorder that were finished at the start.
    stalled_s : float
        How long the thread has been at one and the same step; 0 while it waits for work. A disk
        that refuses keeps it small, one that does not answer lets it grow.
    """

    state: RecorderState
    reason: str = ''
    file: str = ''
    received: int = 0
    written: int = 0
    queued: int = 0
    lost: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    files_finished: int = 0
    bytes_written: int = 0
    recovered: tuple[RecoveryReport, ...] = ()
    stalled_s: float = 0.0
