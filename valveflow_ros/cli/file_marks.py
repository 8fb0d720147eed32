"""By what a file of results tells which verb wrote it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

# The head of our pages and files, and the columns of our tables, stand well within.
_HEAD = 4096
_PAGE = re.compile(rb'<meta name="generator" content="valveflow ([a-z]+) ')
_FORMAT = re.compile(rb'\A\{\s*"format":\s*"valveflow/([a-z_]+)"')
_WRITTEN_BY = re.compile(
    rb'\A\{\s*"format":\s*"valveflow/extended_model",\s*"written_by":\s*"([a-z]+)"'
)
_FORMATS = {
    'characteristic': 'identify',
    'shift': 'identify',
    'diagnosis': 'diagnose',
    'comparison': 'compare',
    'validation': 'validate',
}
_TABLES = {
    'compare': re.compile(
        rb'\A(segment,kind,(\S*,)?proposed\.|method,piece,slope,intercept,|u,(\w+,)*proposed\b)'
    ),
    'validate': re.compile(rb'\Asegment,kind,(\S*,)?curve\.'),
}


def signed(content: Mapping[str, Any], verb: str) -> dict[str, Any]:
    """Return the content of an extended model with the verb that writes it, near its head.

    Two verbs write one, and its format alone does not tell which.
    """
    return {'format': content['format'], 'written_by': verb, **content}


def writer(path: Path) -> str:
    """Return the verb that wrote a file, empty if that is not sure."""
    try:
        with path.open('rb') as file:
            head = file.read(_HEAD)
    except OSError:
        return ''
    if path.suffix == '.html':
        found = _PAGE.search(head)
        return found[1].decode() if found else ''
    if path.suffix == '.json':
        if found := _WRITTEN_BY.match(head):
            return found[1].decode()
        found = _FORMAT.match(head)
        return _FORMATS.get(found[1].decode(), '') if found else ''
    first = head.partition(b'\n')[0]
    return next((verb for verb, columns in _TABLES.items() if columns.match(first)), '')
