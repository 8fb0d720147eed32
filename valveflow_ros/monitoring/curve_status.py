"""What the running curve is worth."""

from __future__ import annotations

import enum


class CurveStatus(enum.IntEnum):
    """What can be said of the running curve; the same numbers stand in the message.

    `STALE`: there is a curve, but the last fit was refused or the clock went
    back. `REFUSED`: there is none, and the last fit was refused.
    """

    UNKNOWN = 0
    FRESH = 1
    STALE = 2
    REFUSED = 3
