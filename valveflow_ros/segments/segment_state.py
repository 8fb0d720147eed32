"""Special segments as plain values, for a saved state."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from valveflow_ros.errors import DataError
from valveflow_ros.records import SegmentKind, SpecialSegment
from valveflow_ros.segments.segmenter import FoundSegment

_NAMES = [field.name for field in fields(SpecialSegment)]


def segment_values(segment: SpecialSegment) -> list[int | float]:
    """Return a segment's fields in their order."""
    return [getattr(segment, name) for name in _NAMES]


def segment_of(values: list[Any]) -> SpecialSegment:
    """Return the segment of such values; raises `DataError` if they make none."""
    try:
        given = dict(zip(_NAMES, values, strict=True))
        return SpecialSegment(**{**given, 'kind': SegmentKind(given['kind'])})
    except (TypeError, ValueError):
        raise DataError('The saved state has a special segment that is none.') from None


def found_values(found: FoundSegment) -> list[Any]:
    """Return a segment's rows and fields."""
    return [found.first_row, found.end_row, *segment_values(found.segment)]


def found_of(values: list[Any]) -> FoundSegment:
    """Return the segment of such values; raises `DataError` if they make none."""
    return FoundSegment(segment_of(values[2:]), values[0], values[1])
