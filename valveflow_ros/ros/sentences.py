"""Foreign errors in one line: a person is owed a sentence, not a trace."""

from __future__ import annotations

import os
import re
import traceback

_IN_C = re.compile(r',? at /\S+\.c(?:pp)?:\d+')


def one_line(error: BaseException) -> str:
    """Return the first line of an error's text, or its name if it has none.

    Where in C code it happened, as rcl writes it, tells nobody anything.
    """
    text = _IN_C.sub('', str(error)).strip().splitlines()
    return text[0] if text else type(error).__name__


def with_place(error: BaseException) -> str:
    """Return an unexpected error with where it happened, for the report of the fault."""
    found = traceback.extract_tb(error.__traceback__)
    place = f', {os.path.basename(found[-1].filename)}, line {found[-1].lineno}' if found else ''
    return f'{one_line(error)} ({type(error).__name__}{place})'
