# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A command or a webhook for each alarm change: bounded queue, retries, never blocking."""

from __future__ import annotations

import http.client
import json
import os
import shlex
import signal
import socket
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from urllib.parse import urlsplit

from valveflow_ros import __version__
from valveflow_ros.errors import UsageError
from valveflow_ros.page.unit import AlarmChange
from valveflow_ros.records import NS_PER_S

# Maximum number of waiting notices; a new one replaces the oldest, which is counted.
MOST_WAITING = 64
# Time limit of one attempt, and the pauses before each further attempt.
LIMIT_S = 10.0
PAUSES_S = (2.0, 10.0, 60.0)
_LAST_S = 1.0
STATES = ('normal', 'unacknowledged', 'acknowledged', 'returned_unacknowledged', 'shelved',
           'suppressed', 'out_of_service')  # fmt: skip


class DeliveryError(Exception):
    """An attempt has failed; the text says why."""


Deliver = Callable[[bytes], None]


def notice(change: AlarmChange) -> bytes:
    """Return the notice for a change: a JSON object, UTF-8.

    Its fields: ``unit``, ``monitor``, ``alarm``, ``state``, ``previous_state`` (null: unknown),
    ``sentence``, ``time`` and ``raised`` (ISO 8601, UTC; null: none).
    """
    previous = change.previous
    content = {
        'unit': change.unit, 'monitor': change.monitor, 'alarm': change.alarm.name,
        'state': _state(change.alarm.state),
        'previous_state': None if previous is None else _state(previous),
        'sentence': change.alarm.sentence, 'time': _time(change.time_ns),
        'raised': _time(change.alarm.raised_ns),
    }  # fmt: skip
    return json.dumps(content, ensure_ascii=False).encode()


def _state(number: int) -> str:
    return STATES[number] if 0 <= number < len(STATES) else f'state_{number}'


def _time(time_ns: int) -> str | None:
    if not time_ns:
        return None
    with suppress(OverflowError, OSError, ValueError):
        return datetime.fromtimestamp(time_ns // NS_PER_S, tz=timezone.utc).isoformat()
    return None


class Sender:
    """Delivers notices in order, in a separate thread.

    ``deliver`` raises `DeliveryError` and must not block without limit. After the last of the
    pauses before each further attempt the notice is dropped; each failure is complained of.
    """

    def __init__(
        self, deliver: Deliver, pauses_s: Sequence[float] = PAUSES_S,
        complain: Callable[[str], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self._deliver, self._complain = deliver, complain
        self._pauses_s = tuple(pauses_s)
        self._ready = threading.Condition()
        self._waiting: deque[bytes] = deque()
        self._closing = threading.Event()
        self.sent = self.failed = self.dropped = 0
        self._thread = threading.Thread(target=self._work, name='notices', daemon=True)
        self._thread.start()

    def put(self, content: bytes) -> None:
        """Queue a notice without waiting; if the queue is full, the oldest one is dropped."""
        with self._ready:
            if len(self._waiting) >= MOST_WAITING:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(content)
            self._ready.notify()

    def close(self, patience_s: float = 0.0) -> None:
        """Stop; notices that are not delivered within ``patience_s`` are lost."""
        with self._ready:
            self._ready.notify()
            self._ready.wait_for(lambda: not self._waiting, timeout=patience_s)
            self._closing.set()
            self._ready.notify()
        self._thread.join(timeout=patience_s)

    def _work(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(lambda: self._waiting or self._closing.is_set())
                if self._closing.is_set():
                    return
                content = self._waiting.popleft()
                self._ready.notify_all()
            self._try(content)

    def _try(self, content: bytes) -> None:
        for pause_s in (*self._pauses_s, None):
            try:
                self._deliver(content)
                self.sent += 1
                return
            except DeliveryError as error:
                again = 'given up' if pause_s is None else f'next try in {pause_s:g} s'
                self._complain(f'A notice of an alarm was not delivered ({again}): {error}.')
            if pause_s is None or self._closing.wait(pause_s):
                break
        self.failed += 1


def command(line: str, limit_s: float = LIMIT_S) -> Deliver:
    """Return a function that runs a command with the notice on its standard input, without shell.

    Raises `UsageError` if the line cannot be parsed as a command.
    """
    try:
        words = shlex.split(line)
    except ValueError as error:
        raise UsageError(f'--on-alarm cannot be read as a command ({error}): {line}') from None
    if not words:
        raise UsageError('--on-alarm names no command.')

    def deliver(content: bytes) -> None:
        try:
            process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise DeliveryError(f'{words[0]}: {error.strerror or error}') from None
        try:
            process.communicate(content, timeout=limit_s)
        except subprocess.TimeoutExpired:
            # Including its child processes.
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise DeliveryError(f'{words[0]} took longer than {limit_s:g} s') from None
        if process.returncode:
            raise DeliveryError(f'{words[0]} ended with status {process.returncode}')

    return deliver


def webhook(url: str, limit_s: float = LIMIT_S) -> Deliver:
    """Return a function that sends the notice by HTTP POST; redirections are not followed.

    Raises `UsageError` if it is not an address of HTTP or HTTPS.
    """
    wrong = f"--webhook must be an address such as https://host/path; '{url}' is not."
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        raise UsageError(wrong) from None
    if parts.scheme not in ('http', 'https') or not host or parts.username is not None:
        raise UsageError(wrong)
    kind = http.client.HTTPSConnection if parts.scheme == 'https' else http.client.HTTPConnection
    target = (parts.path or '/') + (f'?{parts.query}' if parts.query else '')
    head = {'Content-Type': 'application/json', 'User-Agent': f'valveflow/{__version__}'}

    def deliver(content: bytes) -> None:
        connection = kind(host, port, timeout=limit_s)
        late = threading.Event()

        def end() -> None:
            # Limits the total time, also if the peer sends single bytes slowly.
            late.set()
            if connection.sock is not None:
                with suppress(OSError):
                    connection.sock.shutdown(socket.SHUT_RDWR)

        timer = threading.Timer(limit_s, end)
        timer.daemon = True
        timer.start()
        try:
            connection.request('POST', target, body=content, headers=head)
            status = connection.getresponse().status
        except (OSError, http.client.HTTPException) as error:
            slow = late.is_set() or isinstance(error, TimeoutError)
            said = str(error) or type(error).__name__
            said = f'no answer within {limit_s:g} s' if slow else said
            raise DeliveryError(f'{host}: {said}') from None
        finally:
            timer.cancel()
            connection.close()
        if not 200 <= status < 300:
            raise DeliveryError(f'{host} answered with status {status}')

    return deliver


class Notices:
    """Reports each alarm change to a command, to a webhook, to both or to none.

    Raises `UsageError` if the command or the address is invalid.
    """

    def __init__(self, line: str | None, url: str | None, complain: Callable[[str], None]) -> None:
        makers = [
            make(given) for make, given in ((command, line), (webhook, url)) if given is not None
        ]
        self._senders = [Sender(deliver, complain=complain) for deliver in makers]

    def tell(self, changes: Iterable[AlarmChange]) -> None:
        """Queue changes; returns immediately."""
        for content in map(notice, changes):
            for sender in self._senders:
                sender.put(content)

    def counters(self) -> dict[str, tuple[str, float]]:
        """Return counters of the notices by name: help text and value."""
        return {
            f'valveflow_notices_{name}': (
                f'Notices of alarms {about}.', float(sum(getattr(s, name) for s in self._senders))
            )
            for name, about in (('sent', 'delivered'), ('failed', 'given up after all tries'),
                                ('dropped', 'dropped because too many waited'))
        }  # fmt: skip

    def close(self) -> None:
        """Stop; waiting notices have a short time for delivery."""
        for sender in self._senders:
            sender.close(_LAST_S)
