"""Finds the definition of a message type, complete with everything it is made of."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.mcap.bundled import BUNDLED
from valveflow_ros.logs.mcap.layout import LayoutError
from valveflow_ros.logs.mcap.msgdef import (
    SEPARATOR,
    Fields,
    collect,
    full_name,
    parse_fields,
    short_name,
)
from valveflow_ros.logs.mcap.type_hash import type_hash

OWN_PACKAGE = 'valveflow_msgs'
MAX_FILE_BYTES = 1 << 20


class Definitions:
    """Looks types up in installed packages, then in this one, then among the stock types.

    Parameters
    ----------
    prefixes : sequence of Path, optional
        Install prefixes in order of preference; by default those of
        ``AMENT_PREFIX_PATH``.
    """

    def __init__(self, prefixes: Sequence[Path] | None = None) -> None:
        if prefixes is None:
            named = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
            prefixes = [Path(name) for name in named if name]
        self._prefixes = tuple(prefixes)
        self._texts: dict[str, str] = {}
        self._fields: dict[str, Fields] = {}

    def text(self, type_name: str) -> str:
        """Return the definition of a type followed by those of all types it needs.

        Raises
        ------
        RecordingError
            If a definition is not found or cannot be understood.
        """
        main, *others = self._needed(type_name)
        parts = [self._texts[main]]
        for name in others:
            parts.append(f'{SEPARATOR}\nMSG: {short_name(name)}\n{self._texts[name]}')
        return '\n'.join(parts)

    def type_hash(self, type_name: str) -> str:
        """Return the RIHS01 hash of a type; raises like `text`."""
        self._needed(type_name)
        return type_hash(type_name, self._fields)

    def _needed(self, type_name: str) -> list[str]:
        try:
            name = full_name(type_name)
            self._learn(name)
            return collect(name, self._fields)
        except LayoutError as error:
            raise RecordingError(f"message type '{type_name}'", str(error)) from None

    def _learn(self, type_name: str) -> None:
        waiting = [type_name]
        while waiting:
            name = waiting.pop()
            if name not in self._fields:
                text = self._find(name)
                fields = parse_fields(text, name.split('/')[0])
                self._texts[name], self._fields[name] = text, fields
                waiting += [f.type for f in fields if '/' in f.type]

    def _find(self, name: str) -> str:
        package, _, stem = name.split('/')
        places = self._places(package, stem)
        for place in places:
            try:
                with place.open(encoding='utf-8') as stream:
                    text = stream.read(MAX_FILE_BYTES)
            except (OSError, UnicodeDecodeError):
                continue
            return text if text.endswith('\n') else f'{text}\n'
        if name in BUNDLED:
            return BUNDLED[name]
        looked = ', '.join(str(place.parent) for place in places) or 'nowhere'
        raise LayoutError(f"the definition of '{name}' was not found (looked in {looked})")

    def _places(self, package: str, stem: str) -> list[Path]:
        folders = [prefix / 'share' / package / 'msg' for prefix in self._prefixes]
        if package == OWN_PACKAGE:
            # The node's package carries a copy, for where the messages are not built.
            folders += [prefix / 'share/valveflow_ros/msg' for prefix in self._prefixes]
            folders += [Path(__file__).parents[2] / 'msg']
            folders += [Path(sys.prefix) / 'share/valveflow_ros/msg']
        return [folder / f'{stem}.msg' for folder in folders]
