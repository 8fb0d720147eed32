# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A browser without a head, spoken to through a pipe: what a person would see and do."""

import base64
import fcntl
import json
import os
import select
import shutil
import signal
import time
from pathlib import Path
from typing import Any

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome', 'chrome')
_LONGEST_S = 60.0
_HIGH = 20  # the browser's own ends are 3 and 4; ours must not stand in the way


def installed() -> str | None:
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


def _high(fd: int) -> int:
    moved = fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, _HIGH)
    os.close(fd)
    return moved


class Chromium:
    """One browser with one page; everything it asks for and complains of is kept."""

    def __init__(self, path: str, folder: Path) -> None:
        theirs_in, self._out = map(_high, os.pipe())
        self._in, theirs_out = map(_high, os.pipe())
        log = os.open(folder / 'chromium.log', os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o600)
        words = [
            path, '--headless', '--no-sandbox', '--disable-gpu', '--no-first-run',
            '--disable-background-networking', '--disable-dev-shm-usage', '--hide-scrollbars',
            f'--user-data-dir={folder / "profile"}', '--remote-debugging-pipe', 'about:blank',
        ]  # fmt: skip
        actions = [
            (os.POSIX_SPAWN_DUP2, log, 1), (os.POSIX_SPAWN_DUP2, log, 2),
            (os.POSIX_SPAWN_DUP2, theirs_in, 3), (os.POSIX_SPAWN_DUP2, theirs_out, 4),
        ]  # fmt: skip
        self._pid = os.posix_spawn(path, words, os.environ, file_actions=actions, setpgroup=0)
        for fd in (theirs_in, theirs_out, log):
            os.close(fd)
        self._waiting, self._number, self._session = b'', 0, ''
        self.said: list[str] = []  # on the console, as an exception or in the log
        self.asked: list[str] = []  # addresses outside the page
        pages = self.call('Target.getTargets')['targetInfos']
        target = next(t['targetId'] for t in pages if t['type'] == 'page')
        answer = self.call('Target.attachToTarget', targetId=target, flatten=True)
        self._session = answer['sessionId']
        for domain in ('Page', 'Runtime', 'Log', 'Network'):
            self.call(f'{domain}.enable')

    def close(self) -> None:
        self._session = ''
        try:
            self.call('Browser.close')
        except (OSError, RuntimeError):
            os.killpg(self._pid, signal.SIGKILL)
        os.close(self._out)
        os.close(self._in)
        os.waitpid(self._pid, 0)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {'id': self._number, 'method': method, 'params': parameters}
        if self._session:
            message['sessionId'] = self._session
        os.write(self._out, json.dumps(message).encode() + b'\0')
        until = time.monotonic() + _LONGEST_S
        # Events go on coming where the answer does not.
        while time.monotonic() < until:
            got = self._receive()
            if got.get('id') != self._number:
                self._keep(got)
            elif 'error' in got:
                raise RuntimeError(f'{method}: {got["error"]["message"]}')
            else:
                return dict(got['result'])
        raise RuntimeError(f'{method}: no answer within {_LONGEST_S:.0f} s')

    def _receive(self) -> dict[str, Any]:
        until = time.monotonic() + _LONGEST_S
        while b'\0' not in self._waiting:
            left = until - time.monotonic()
            ready, _, _ = select.select([self._in], [], [], max(0.0, left))
            part = os.read(self._in, 1 << 20) if ready else b''
            if not part:
                raise RuntimeError('the browser does not answer')
            self._waiting += part
        first, _, self._waiting = self._waiting.partition(b'\0')
        return dict(json.loads(first))

    def _keep(self, event: dict[str, Any]) -> None:
        what, about = event.get('method'), event.get('params', {})
        if what == 'Runtime.executionContextsCleared':
            # The page before has gone; what it still had to say is not of this one.
            self.said.clear()
        if what == 'Runtime.consoleAPICalled':
            self.said.append(str([a.get('value') for a in about['args']]))
        elif what == 'Runtime.exceptionThrown':
            self.said.append(str(about['exceptionDetails']))
        elif what == 'Log.entryAdded':
            self.said.append(about['entry']['text'])
        elif what == 'Network.requestWillBeSent' and about['type'] != 'Document':
            # What stands in the page itself goes nowhere.
            url = about['request']['url']
            self.asked += [] if url.startswith(('data:', 'blob:')) else [url]

    def ask(self, script: str) -> Any:
        """Return the value of an expression, waited for where it is a promise."""
        answer = self.call(
            'Runtime.evaluate', expression=script, returnByValue=True, awaitPromise=True
        )
        if 'exceptionDetails' in answer:
            raise RuntimeError(str(answer['exceptionDetails']))
        return answer['result'].get('value')

    def look(self, width: int, *, dark: bool = False, height: int = 900) -> None:
        """Take a window of that width, and light or dark."""
        self.call(
            'Emulation.setDeviceMetricsOverride', width=width, height=height,
            deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip
        scheme = {'name': 'prefers-color-scheme', 'value': 'dark' if dark else 'light'}
        self.call('Emulation.setEmulatedMedia', features=[scheme])

    def open(self, path: Path) -> None:
        """Open a file and wait until the page says that everything is drawn."""
        self.visit(path.resolve().as_uri())

    def visit(self, url: str) -> None:
        """Open an address and wait until the page says that everything is drawn."""
        self.said.clear()
        self.asked.clear()
        self.call('Page.navigate', url=url)
        until = time.monotonic() + _LONGEST_S
        while self.ask('document.documentElement?.dataset.drawn') != 'yes':
            if time.monotonic() > until:
                raise RuntimeError('the page was not drawn')
            time.sleep(0.05)

    def settle(self) -> None:
        """Wait until the browser has painted twice."""
        frame = 'requestAnimationFrame'
        self.ask(f'new Promise((done) => {frame}(() => {frame}(() => done(1))))')

    def paper(self) -> bytes:
        """Return the page as PDF on A4."""
        inch = 2.54
        pdf = self.call('Page.printToPDF', paperWidth=21.0 / inch, paperHeight=29.7 / inch)
        return base64.b64decode(pdf['data'])

    def hover(self, x: float, y: float) -> None:
        self.call('Input.dispatchMouseEvent', type='mouseMoved', x=x, y=y)
        self.settle()
