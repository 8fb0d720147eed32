"""Runs the tests that concern a module against a copy of the tree with one mistake in it."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import resource
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

# Copied for each run; of the rest the tests need nothing.
_PARTS = ('valveflow_ros', 'test', 'config', 'pyproject.toml', 'setup.cfg', 'package.xml')
# Loaded once and inherited by every run, which saves it seconds; nothing of the project is in it.
_LOADED = (
    'pytest', 'hypothesis', 'numba', 'numpy', 'scipy.special', 'yaml', 'mcap.reader',
    'mcap.writer', 'mcap_ros2.decoder', 'rosbags.highlevel', 'zstandard', 'lz4.frame', 'rclpy',
    'psutil',
)  # fmt: skip
# How long a test waits for a recorder's thread; the ordinary figure is for a very busy machine.
PATIENCE_S = 8.0
_MOST_BYTES = 12 << 30
_ERRORS = re.compile(r'^(?:FAILED|ERROR) (\S+)', re.MULTILINE)


@dataclass(frozen=True)
class Run:
    """What came of a run of tests: the first that failed, empty if none did."""

    failed: str
    seconds: float
    text: str


class Ground:
    """A copy of the tree, in which modules are changed and changed back."""

    def __init__(self, root: Path, place: Path) -> None:
        self.root, self.place = root, place
        for name in _PARTS:
            source, target = root / name, place / name
            if source.is_dir():
                ignored = shutil.ignore_patterns('*.pyc', '.hypothesis')
                shutil.copytree(source, target, ignore=ignored, symlinks=True)
            elif source.exists():
                shutil.copy2(source, target)
        for name in _LOADED:
            with contextlib.suppress(ImportError):
                importlib.import_module(name)

    def with_text(self, module: str, text: str, tests: Sequence[str], limit_s: float) -> Run:
        """Run tests while a module reads otherwise."""
        path = self.place / module
        right = path.read_text('utf-8')
        path.write_text(text, 'utf-8')
        try:
            return self.run(tests, limit_s)
        finally:
            path.write_text(right, 'utf-8')

    def run(self, tests: Sequence[str], limit_s: float, keep_compiled: bool = False) -> Run:
        """Run tests until one fails; what takes longer than the limit has failed.

        What Python compiles is kept only of the tree as it is: a file that was changed twice
        within a second might be taken for the compiled one.
        """
        said = self.place / 'said.txt'
        begun_s = time.monotonic()
        sys.stdout.flush()
        child = os.fork()
        if not child:
            self._be_the_child(tests, said, keep_compiled)
        status = _waited(child, begun_s + limit_s)
        seconds = time.monotonic() - begun_s
        text = said.read_text('utf-8', 'replace')
        if status is None:
            return Run(f'nothing for {limit_s:.0f} s', seconds, text)
        if status == 0:
            return Run('', seconds, text)
        first = _ERRORS.search(text)
        return Run(first[1] if first else f'status {status}', seconds, text)

    def _be_the_child(self, tests: Sequence[str], said: Path, keep_compiled: bool) -> None:
        """Become the process that runs the tests; never returns."""
        status = 70
        try:
            os.setsid()
            descriptor = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            for stream in (1, 2):
                os.dup2(descriptor, stream)
            resource.setrlimit(resource.RLIMIT_AS, (_MOST_BYTES, _MOST_BYTES))
            os.chdir(self.place)
            paths = [p for p in sys.path if p and Path(p).resolve() != self.root]
            sys.path[:] = [str(self.place), *paths]
            sys.dont_write_bytecode = not keep_compiled
            os.environ.update(
                PYTHONPATH=os.pathsep.join([str(self.place), os.environ.get('PYTHONPATH', '')]),
                PYTHONDONTWRITEBYTECODE='1',
                VALVEFLOW_TEST_PATIENCE_S=str(PATIENCE_S),
            )
            pytest = importlib.import_module('pytest')
            words = ['-x', '-q', '--no-header', '--tb=line', '-p', 'no:cacheprovider', *tests]
            status = int(pytest.main(words))
            here = sys.modules.get('valveflow_ros')
            if here is not None and not str(here.__file__).startswith(str(self.place)):
                print('the tests ran against another tree')
                status = 71
        finally:
            sys.stdout.flush()
            os._exit(status)


def _waited(child: int, until_s: float) -> int | None:
    """Return the status with which a process ended; None if it had to be ended."""
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            # What the tests have started and left.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until_s:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(0.01)
