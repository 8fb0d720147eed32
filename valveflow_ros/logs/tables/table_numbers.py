"""Tells from samples what kind of times a column of numbers holds."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from valveflow_ros.records import NS_PER_S, FloatArray

# Numbers above these cannot be seconds (year 5138), milliseconds, microseconds of our age.
_SCALES = ((1e11, 's', NS_PER_S), (1e14, 'ms', 1_000_000), (1e17, 'us', 1000))
# Days of a workbook are counted from here; 36526 is the year 2000, 73050 the year 2100.
_EXCEL_DAYS = (36526.0, 73050.0)


def as_numbers(samples: list[str]) -> FloatArray:
    """Return the samples as numbers if most of them are."""
    numbers = []
    text = [cell.strip() for cell in samples if cell.strip()]
    for cell in text:
        try:
            numbers.append(float(cell if '.' in cell else cell.replace(',', '.')))
        except ValueError:
            continue
    return np.array(numbers if 2 * len(numbers) >= len(text) else [], dtype=np.float64)


def is_excel(numbers: FloatArray) -> bool:
    """Tell whether numbers are days of a workbook: in our age, and close to each other."""
    finite = numbers[np.isfinite(numbers)]
    if not len(finite):
        return False
    low, high = _EXCEL_DAYS
    inside = bool(((finite >= low) & (finite <= high)).all())
    steps = np.abs(np.diff(finite))
    fine = not len(steps) or float(np.median(steps)) < 0.5
    return inside and fine and bool((finite % 1.0 != 0.0).any())


def scale(numbers: FloatArray) -> tuple[str, int]:
    """Return the unit of numbers since 1970, and its nanoseconds."""
    finite = np.abs(numbers[np.isfinite(numbers)])
    typical = float(np.median(finite)) if len(finite) else 0.0
    for bound, unit, factor in _SCALES:
        if typical < bound:
            return unit, factor
    return 'ns', 1


def descending(samples: list[str]) -> bool:
    """Tell whether the samples stand newest first, as far as texts of one form can tell."""
    text = [cell.strip() for cell in samples if cell.strip()]
    # Within a day the clock decides, whatever the order of day, month and year.
    pairs = [(a, b) for a, b in pairwise(text) if a[:10] == b[:10]]
    falling = sum(a > b for a, b in pairs)
    return 2 * falling > len(pairs)
