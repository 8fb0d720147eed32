# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Saved states of objects that process a stream, as plain values.

``snapshot()`` returns numbers, texts, lists, dicts and copies of arrays. ``restore()`` writes them
into a new object with the same settings, whose later results are then identical, bit for bit, to
those of the first one. A state that does not fit is refused: a partial state would be worse.
"""

from __future__ import annotations

import enum
import hashlib
import io
import json
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import DataError

State = dict[str, Any]
_LARGEST = 2**128  # largest integer: that of the state of a random number generator


class Memory:
    """Save the attributes listed in `REMEMBERED`, under their names without underscores.

    Arrays are copied and restored in place. An attribute that is a `Memory` saves and restores
    its own state. Enumerations, named tuples and None keep their type.
    """

    REMEMBERED: ClassVar[tuple[str, ...]] = ()

    def snapshot(self) -> State:
        """Return the state to be saved."""
        return {name.lstrip('_'): _plain(getattr(self, name)) for name in self.REMEMBERED}

    def restore(self, saved: State) -> None:
        """Continue from a saved state.

        Raises `DataError` if the state does not fit; the object must not be used then.
        """
        own = {name.lstrip('_'): getattr(self, name) for name in self.REMEMBERED}
        put_back(
            {key: value for key, value in own.items() if isinstance(value, np.ndarray)}, saved
        )
        for name in self.REMEMBERED:
            key = name.lstrip('_')
            if key not in saved:
                raise DataError(f"The saved state lacks '{key}'.")
            value = _of_kind(own[key], saved[key], key)
            if value is not own[key]:
                setattr(self, name, value)


def _plain(value: Any) -> Any:
    """Return a value in the form of a state."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if hasattr(value, 'snapshot'):
        return value.snapshot()
    if isinstance(value, enum.IntEnum):
        return int(value)
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value


def _of_kind(own: Any, saved: Any, key: str) -> Any:
    """Return a saved value with the type of the object's present value."""
    if isinstance(own, np.ndarray):
        return own  # restored in place
    if hasattr(own, 'restore') != isinstance(saved, dict) or not _fits(own, saved, key):
        raise DataError(f"The saved state has '{key}' of another kind.")
    if hasattr(own, 'restore'):
        own.restore(saved)
        return own
    try:
        if isinstance(own, enum.IntEnum):
            return type(own)(saved)
        if isinstance(own, tuple):
            return type(own)(*saved) if hasattr(own, '_fields') else tuple(saved)
    except (TypeError, ValueError):
        raise DataError(f"The saved state has '{key}' of another kind.") from None
    return saved


def _fits(own: Any, saved: Any, key: str) -> bool:
    """Return True if a saved value may replace the present value of an object."""
    if own is None:
        # If the present value is None, the name shows that it is a time.
        return not key.endswith('_ns') or saved is None or type(saved) is int
    if isinstance(own, bool | str):
        return isinstance(saved, type(own))
    if isinstance(own, int | float):
        return type(saved) is int or (isinstance(own, float) and isinstance(saved, float))
    return isinstance(saved, list) or not isinstance(own, tuple | list)


def perhaps(saved: State, key: str, kind: type) -> Any:
    """Return the value of a key, None or of one type; raises `DataError`."""
    if saved[key] is not None and type(saved[key]) is not kind:
        raise DataError(f"The saved state has '{key}' of another kind.")
    return saved[key]


def copies(arrays: Mapping[str, NDArray[Any]]) -> State:
    """Return copies of arrays under their names."""
    return {name: array.copy() for name, array in arrays.items()}


def put_back(arrays: Mapping[str, NDArray[Any]], saved: State) -> None:
    """Overwrite arrays with the saved ones of the same names.

    Raises `DataError` if an array is missing, or has another type or shape.
    """
    for name, array in arrays.items():
        given = saved.get(name)
        if not isinstance(given, np.ndarray):
            raise DataError(f"The saved state lacks '{name}'.")
        if given.dtype != array.dtype or given.shape != array.shape:
            raise DataError(
                f"The saved state has '{name}' as {given.dtype} {given.shape}, "
                f'{array.dtype} {array.shape} is wanted.'
            )
    for name, array in arrays.items():
        np.copyto(array, saved[name])


# A state as bytes with a checksum; reading it executes no code.

FORMAT = b'valveflow-state'
VERSION = 2
_READ = (b'1', b'2')  # version 1 is read, too: the owners of its parts convert them
_ARRAY = '$array'
_DIGEST = 64


def to_bytes(state: State) -> bytes:
    """Return a state as a line with format, version and SHA-256, and an .npz archive.

    Parameters
    ----------
    state : dict
        Contains numbers, texts, lists, dicts with text keys, and arrays.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_flat(state, arrays), separators=(',', ':'))
    archive = io.BytesIO()
    named = {f'a{k}': array for k, array in enumerate(arrays)}
    np.savez(archive, tree=np.frombuffer(text.encode(), dtype=np.uint8), **named)  # type: ignore[arg-type]
    content = archive.getbuffer()
    digest = hashlib.sha256(content).hexdigest()
    return b'%s %d %s\n' % (FORMAT, VERSION, digest.encode()) + content


def from_bytes(data: bytes) -> State:
    """Return the state in bytes from `to_bytes`.

    Raises `DataError` if the bytes are incomplete, changed, of another version, or no state.
    """
    line, _, content = data.partition(b'\n')
    words = line.split(b' ')
    if len(words) != 3 or words[0] != FORMAT or len(words[2]) != _DIGEST:
        raise DataError('The saved state is none, or its beginning is damaged.')
    if words[1] not in _READ:
        version = words[1][:20].decode(errors='replace')
        raise DataError(f'The saved state has version {version}, this program reads {VERSION}.')
    if hashlib.sha256(content).hexdigest().encode() != words[2]:
        raise DataError('The saved state is damaged: its checksum is another one.')
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            tree = json.loads(archive['tree'].tobytes())
            state = _full(tree, archive)
    except DataError:
        raise
    except Exception as error:  # noqa: BLE001 - zip, numpy and json raise many types
        reason = type(error).__name__
        raise DataError(f'The saved state cannot be read ({reason}).') from None
    if not isinstance(state, dict):
        raise DataError('The saved state is none.')
    return state


def _flat(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """Return a value with its arrays moved to a separate list."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {_ARRAY: len(arrays) - 1}
    if isinstance(value, dict):
        return {str(key): _flat(item, arrays) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_flat(item, arrays) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return value


def _full(value: Any, archive: Any) -> Any:
    """Return a value with its arrays inserted again."""
    if isinstance(value, dict):
        if value.keys() == {_ARRAY}:
            return archive[f'a{int(value[_ARRAY])}']
        return {key: _full(item, archive) for key, item in value.items()}
    if isinstance(value, list):
        return [_full(item, archive) for item in value]
    if isinstance(value, int) and abs(value) >= _LARGEST:
        raise DataError('The saved state cannot be read: it has a number that nothing counts to.')
    return value
