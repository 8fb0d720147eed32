"""What a person may have to say about a table that the table does not say itself."""

from __future__ import annotations

from dataclasses import dataclass

from valveflow_ros.errors import InputError

DATE_ORDERS = ('dmy', 'mdy', 'ymd')
DECIMALS = ('point', 'comma')


@dataclass(frozen=True, slots=True)
class TableOptions:
    """How to read a table; what is empty is seen in the file or refused as ambiguous.

    Attributes
    ----------
    time_zone : str
        Zone of times that name none: a name of the tz database (``Europe/Berlin``)
        or an offset (``+01:00``). Empty means UTC.
    date_order : str
        ``dmy`` or ``mdy``, for dates such as 01/02/2026.
    decimal : str
        ``point`` or ``comma``.
    sheet : str
        Sheet of a workbook; the first with a table by default.
    """

    time_zone: str = ''
    date_order: str = ''
    decimal: str = ''
    sheet: str = ''

    def __post_init__(self) -> None:
        if self.date_order not in ('', *DATE_ORDERS):
            raise InputError(f"--date-order must be dmy, mdy or ymd, not '{self.date_order}'.")
        if self.decimal not in ('', *DECIMALS):
            raise InputError(f"--decimal must be point or comma, not '{self.decimal}'.")


AS_SEEN = TableOptions()
