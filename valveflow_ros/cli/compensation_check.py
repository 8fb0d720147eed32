"""What a compensation must keep before it is written."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable

from valveflow_ros.cli.compensation_table import within
from valveflow_ros.curve.compensation import Compensation, corner_count
from valveflow_ros.errors import DataError
from valveflow_ros.report.words import counted


def check(made: Compensation, tolerance_mw: float, again: Callable[[int], Compensation]) -> None:
    """Refuse a table that is off by more than was allowed.

    Parameters
    ----------
    made : Compensation
    tolerance_mw : float
        MW.
    again : callable
        Makes the same table with another number of points.

    Raises
    ------
    DataError
        The inverse is not exact enough, or the table is not; the sentence says how many points
        would do, or what can be had.
    """
    if within(made, tolerance_mw):
        return
    if made.identity_mw > tolerance_mw:
        raise DataError(
            f'The inverse is not exact: F(F^-1(x)) differs from x by up to '
            f'{made.identity_mw:.2g} MW (tolerance {tolerance_mw:g} MW). Nothing was written.'
        )
    have, corners = len(made.u), corner_count(made.curve)
    off = f'Interpolating in a table of {counted(have, "point")} is off by up to'
    least = min(made, again(corners), key=lambda m: m.table_mw)
    if least.table_mw > tolerance_mw:
        raise DataError(
            f'{off} {made.table_mw:.2g} MW (tolerance {tolerance_mw:g} MW), and with as many as '
            f'it takes {least.table_mw:.2g} MW are left, from rounding. Ask for a larger '
            '--tolerance. Nothing was written.'
        )
    # The error of the best choice of corners falls with their number.
    tried = range(2, corners + 1)
    enough = tried[bisect_left(tried, True, key=lambda n: again(n).table_mw <= tolerance_mw)]
    raise DataError(
        f'{off} {made.table_mw:.2g} MW (tolerance {tolerance_mw:g} MW); --points {enough} would '
        'do. Nothing was written.'
    )
