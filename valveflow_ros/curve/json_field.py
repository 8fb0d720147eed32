"""Reading JSON that somebody else may have written: every error names its place."""

from __future__ import annotations

import math

from valveflow_ros.errors import DataError

_LARGEST = 1e30  # no number of a plant is larger; products of two still are finite


class Field:
    """A place in the JSON that knows its path, so that an error can name it."""

    def __init__(self, value: object, path: str, whole: str = 'characteristic') -> None:
        self._value = value
        self._path = path
        self._whole = whole

    def fail(self, problem: str) -> DataError:
        """Return the error that says what is wrong with this place."""
        return DataError(f"The {self._whole} cannot be used: '{self._path}' {problem}.")

    def key(self, name: str) -> Field:
        """Return the member of this object that has to be there."""
        path = f'{self._path}.{name}' if self._path else name
        if not isinstance(self._value, dict):
            raise self.fail('is not an object')
        if name not in self._value:
            raise Field(None, path, self._whole).fail('is missing')
        return Field(self._value[name], path, self._whole)

    def may_have(self, name: str) -> Field | None:
        """Return a member, or None."""
        present = isinstance(self._value, dict) and name in self._value
        return self.key(name) if present else None

    def items(self) -> list[Field]:
        """Return the members of this list."""
        if not isinstance(self._value, list):
            raise self.fail('is not a list')
        return [Field(v, f'{self._path}[{k}]', self._whole) for k, v in enumerate(self._value)]

    def members(self) -> list[tuple[str, Field]]:
        """Return the members of this object with their names."""
        if not isinstance(self._value, dict):
            raise self.fail('is not an object')
        return [(str(name), self.key(name)) for name in self._value]

    def real(self, low: float = -math.inf, high: float = math.inf) -> float:
        """Return a number inside limits."""
        value = self._value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fail('is not a number')
        if not low <= value <= high or abs(value) > _LARGEST:
            raise self.fail('is out of range')
        return float(value)

    def real_or_nan(self, low: float = -math.inf) -> float:
        """Return a number, NaN for null."""
        return math.nan if self._value is None else self.real(low)

    def whole(self) -> int:
        """Return a whole number, 0 or more."""
        value = self._value
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise self.fail('is not a count')
        return value

    def flag(self) -> bool:
        """Return true or false."""
        if not isinstance(self._value, bool):
            raise self.fail('is neither true nor false')
        return self._value

    def text(self) -> str:
        """Return a text."""
        if not isinstance(self._value, str):
            raise self.fail('is not a text')
        return self._value

    def by_pieces(self) -> dict[int, float]:
        """Return an object whose keys are numbers of pieces."""
        if not isinstance(self._value, dict):
            raise self.fail('is not an object')
        table = {}
        for name in self._value:
            if not (isinstance(name, str) and name.isdecimal()):
                raise self.fail('has a key that is no number of pieces')
            table[int(name)] = self.key(name).real_or_nan()
        return table
