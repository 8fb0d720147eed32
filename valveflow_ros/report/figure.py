"""A picture as plain data: what plotly draws, with colours by name.

A colour is written ``token:steady``; the page looks it up in its style sheet
when it draws, so that the same picture suits light, dark and paper.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Spec = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture of the page.

    Attributes
    ----------
    name : str
        Letters and dashes; the element's id.
    caption : str
        HTML that says what to look for.
    description : str
        Plain text for those who cannot see the picture.
    traces : list
        plotly traces.
    layout : dict
        What differs from the page's base layout.
    height : int
        In pixels.
    """

    name: str
    caption: str
    description: str
    traces: list[Spec]
    layout: Spec = field(default_factory=dict)
    height: int = 420

    def to_json(self) -> str:
        """Return the picture for the page's script; safe inside a script element."""
        content = {'data': self.traces, 'layout': {**self.layout, 'height': self.height}}
        text = json.dumps(_clean(content), separators=(',', ':'), allow_nan=False)
        return text.replace('<', '\\u003c').replace('>', '\\u003e').replace('&', '\\u0026')


def without_tags(html: str) -> str:
    """Return HTML without its tags, powers with a caret: ``MPa^(9/8)``; signs stay escaped."""
    html = re.sub(r'<sup>([^<]*/[^<]*)</sup>', r'^(\1)', html)
    html = re.sub(r'<sup>([^<]*)</sup>', r'^\1', html)
    return re.sub(r'<[^>]+>', '', html)


def token(name: str) -> str:
    """Return a colour by its name in the style sheet."""
    return f'token:{name}'


def rounded(values: NDArray[Any], digits: int = 5) -> list[float | None]:
    """Return values for the eye: so many significant digits of the largest; NaN is a gap."""
    values = np.asarray(values, dtype=np.float64)
    good = np.isfinite(values)
    largest = float(np.abs(values[good]).max()) if good.any() else 0.0
    places = digits - 1 - math.floor(math.log10(largest)) if largest > 0.0 else 0
    return [
        round(v, places) if ok else None
        for v, ok in zip(values.tolist(), good.tolist(), strict=True)
    ]


def packed(values: NDArray[Any]) -> Spec:
    """Return an array in plotly's binary form, exact and compact; NaN stays a gap."""
    data = np.ascontiguousarray(values, dtype='<f8')
    return {'dtype': 'f8', 'bdata': base64.b64encode(data.tobytes()).decode()}


def _clean(value: Any) -> Any:
    """Turn numpy scalars into Python's and what is not finite into null."""
    if isinstance(value, Mapping):
        return {str(k): _clean(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
