"""Type hashes RIHS01: the SHA-256 of a type's description (ROS Enhancement Proposal 2011)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from valveflow_ros.logs.mcap.msgdef import PRIMITIVES, Field, Fields, collect, full_name

_NESTED = 1
_IDS = {
    'int8': 2,
    'uint8': 3,
    'int16': 4,
    'uint16': 5,
    'int32': 6,
    'uint32': 7,
    'int64': 8,
    'uint64': 9,
    'float32': 10,
    'float64': 11,
    # A char of a .msg file is an unsigned byte, unlike the description's own char.
    'char': 3,
    'bool': 15,
    'byte': 16,
    'string': 17,
    'wstring': 18,
}
_BOUNDED_TEXT = 4
_ARRAY_STEP = {'': 0, 'fixed': 48, 'bounded': 96, 'unbounded': 144}
# A message without fields gets one, as C knows no empty structures.
_FILLER: Fields = (Field('structure_needs_at_least_one_member', 'uint8'),)


def type_hash(type_name: str, types: Mapping[str, Fields]) -> str:
    """Return ``RIHS01_`` and 64 hexadecimal digits.

    Raises
    ------
    LayoutError
        If the definition of a type it needs is missing.
    """
    main, *others = collect(type_name, types)
    description = {
        'type_description': _describe(main, types),
        'referenced_type_descriptions': [_describe(name, types) for name in sorted(others)],
    }
    text = json.dumps(description, separators=(', ', ': '), ensure_ascii=True)
    return f'RIHS01_{hashlib.sha256(text.encode()).hexdigest()}'


def _describe(name: str, types: Mapping[str, Fields]) -> dict[str, Any]:
    fields = types[full_name(name)] or _FILLER
    return {'type_name': name, 'fields': [_field(field) for field in fields]}


def _field(field: Field) -> dict[str, Any]:
    primitive = field.type in PRIMITIVES
    number = _IDS[field.type] if primitive else _NESTED
    if field.text_bound:
        number += _BOUNDED_TEXT
    return {
        'name': field.name,
        'type': {
            'type_id': number + _ARRAY_STEP[field.array],
            'capacity': field.length,
            'string_capacity': field.text_bound,
            'nested_type_name': '' if primitive else field.type,
        },
    }
