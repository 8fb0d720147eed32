"""Finishes in the background what runs that died left unfinished."""

from __future__ import annotations

import queue
import re
import threading
from pathlib import Path

from valveflow_ros.errors import ValveflowError
from valveflow_ros.logs import recover_leftovers
from valveflow_ros.logs.part_file import PART_SUFFIX
from valveflow_ros.ros.diagnostics import Level


class Leftovers:
    """Looks once through this unit's other recordings; a living recorder's files stay.

    Parameters
    ----------
    own : Path
        The recording at hand, which is seen to by its own recorder.
    tag : str
        The unit's part of the folders' names; those of other units are theirs.
    """

    def __init__(self, own: Path, tag: str) -> None:
        self._own = own
        self._mine = re.compile(rf'valveflow_\d{{8}}T\d{{6}}Z_{re.escape(tag)}(_\d+)?')
        self._news: queue.SimpleQueue[tuple[Level, str]] = queue.SimpleQueue()
        threading.Thread(target=self._run, name='leftovers', daemon=True).start()

    def news(self) -> list[tuple[Level, str]]:
        """Return what there is to say since the last time, each with how grave it is."""
        found: list[tuple[Level, str]] = []
        while not self._news.empty():
            found.append(self._news.get())
        return found

    def _run(self) -> None:
        own = self._own.resolve()
        try:
            parts = own.parent.glob(f'valveflow_*/*.mcap{PART_SUFFIX}')
            found = {part.parent for part in parts} - {own}
        except OSError:
            return
        for folder in sorted(f for f in found if self._mine.fullmatch(f.name)):
            try:
                reports = recover_leftovers(folder)
            except ValveflowError as error:
                self._news.put((Level.WARN, str(error)))
                continue
            for report in reports:
                self._news.put(
                    (
                        Level.OK,
                        f'{report.out} was left unfinished by an earlier run and is whole now: '
                        f'{report.messages} messages.',
                    )
                )
