"""The drawing library, packed into the page so that it opens without a network."""

from __future__ import annotations

import base64
import functools
import gzip
from importlib import resources
from importlib.util import find_spec
from pathlib import Path

from valveflow_ros.errors import InputError


def read_text(name: str) -> str:
    """Return a file that lies beside this module."""
    return resources.files('valveflow_ros.report').joinpath(name).read_text(encoding='utf-8')


@functools.cache
def packed_plotly() -> str:
    """Return plotly.js, gzip-compressed, in base64 (about 2 MB instead of 5).

    The file is read without importing plotly's Python side, which takes longer
    than the whole report.

    Raises
    ------
    InputError
        plotly is not installed.
    """
    spec = find_spec('plotly')
    if spec is None or spec.origin is None:
        raise InputError(
            "The report needs the Python package 'plotly', which is not installed: "
            'pip install plotly.'
        )
    source = Path(spec.origin).parent / 'package_data' / 'plotly.min.js'
    try:
        script = source.read_bytes()
    except OSError:
        raise InputError(
            f"The installed package 'plotly' is incomplete: {source} is missing; install it again."
        ) from None
    return base64.b64encode(gzip.compress(script, 9, mtime=0)).decode()
