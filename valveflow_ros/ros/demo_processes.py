"""The demo's processes: started with their output in files, and ended in order."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from valveflow_ros.errors import ValveflowError

_PATIENCE_S = 10.0


def ros_arguments(parameters: Mapping[str, object]) -> list[str]:
    """Return parameters as they follow a node's command."""
    words = ['--ros-args']
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        words += ['-p', f'{name}:={text}']
    return words


class Process:
    """A module of ours as a process of its own.

    Parameters
    ----------
    name : str
        For sentences and the name of the log file.
    module : str
    arguments : list of str
    folder : Path
        Where the log file goes.
    environment : mapping
    """

    def __init__(
        self,
        name: str,
        module: str,
        arguments: list[str],
        folder: Path,
        environment: Mapping[str, str],
    ) -> None:
        self.name = name
        self.log = folder / f'{name}.log'
        with self.log.open('wb') as out:
            self._process = subprocess.Popen(
                [sys.executable, '-m', module, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                env=dict(environment),
                # Ctrl-C comes to the demo alone, which then ends the others in order.
                start_new_session=True,
            )

    @property
    def status(self) -> int | None:
        """Return the exit status, None while it runs."""
        return self._process.poll()

    def must_run(self) -> None:
        """Raise `ValveflowError` with its last words if it has ended with an error."""
        if self.status:
            raise ValveflowError(
                f'The process {self.name} ended with status {self.status}: {self.last_line()}'
            )

    def last_line(self) -> str:
        """Return the last line of its output."""
        lines = self.log.read_text(errors='replace').strip().splitlines()
        return lines[-1] if lines else f'it said nothing (see {self.log})'

    def end(self) -> int:
        """Ask it to end, wait, and return its exit status; doing it again changes nothing."""
        if self.status is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
        return self._process.returncode
