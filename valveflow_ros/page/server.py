# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The web server of the page: its address, its access control, and its limits."""

from __future__ import annotations

import errno
import gzip
import io
import ipaddress
import logging
import socket
import threading
import time
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from valveflow_ros.errors import (
    DataError,
    InputError,
    RecordingError,
    UsageError,
    ValveflowError,
    listed,
)

if TYPE_CHECKING:
    from datetime import tzinfo

    # A verb that only lists the options does not need it.
    from valveflow_ros.page.unit import Shown

PORT = 8350
# Numbers of open connections above which the answer is 503, and above which none is accepted.
MOST_CONNECTIONS, _MOST_ACCEPTED = 256, 320
# Time limits of a connection that is idle or stuck in a request or an answer; time limit of a
# whole answer.
IDLE_S, _LONGEST_S = 20, 120.0
_SWEEP_S = 5.0
_MOST_HEAD, _MOST_BODY = 16384, 65536
_THREADS = 4
_MOST_FILES = 64
_TELL_S = 60.0
_STATIC = '/_dash-component-suites/'
_PATHS = {'/': 'GET', '/_dash-layout': 'GET', '/_dash-dependencies': 'GET', '/metrics': 'GET',
          '/_dash-update-component': 'POST'}  # fmt: skip
_NEEDS = {'dash': 'dash', 'prometheus_client': 'prometheus_client', 'waitress': 'waitress'}
_MOST_TOKEN = 1024
_LEAST_TOKEN = 8

Start = Callable[..., Any]
Wsgi = Callable[[dict[str, Any], Start], Iterable[bytes]]


def check_installed() -> None:
    """Raise `DataError` if a package that only the page needs is missing."""
    missing = [name for module, name in _NEEDS.items() if find_spec(module) is None]
    if missing:
        raise DataError(
            f'The page needs {listed(missing)}, not installed here: '
            f'pip install {" ".join(missing)}.'
        )


def page_arguments(parser: ArgumentParser) -> None:
    """Add the options on the address of the page and its notices."""
    parser.add_argument(
        '--host', metavar='ADDRESS', default='127.0.0.1',
        help='address to listen on (default 127.0.0.1: this machine only)',
    )  # fmt: skip
    parser.add_argument(
        '--port', metavar='N', type=_port, default=PORT, help=f'port (default {PORT})'
    )
    parser.add_argument(
        '--name', metavar='NAME', action='append', default=[],
        help='a further name by which browsers and Prometheus reach this machine',
    )  # fmt: skip
    parser.add_argument(
        '--token-file', metavar='FILE', type=Path,
        help='let a browser that knows the token in this file acknowledge and shelve alarms',
    )  # fmt: skip
    parser.add_argument(
        '--on-alarm', metavar='COMMAND',
        help='run this for each change of an alarm, with the change as JSON on its input',
    )  # fmt: skip
    parser.add_argument(
        '--webhook', metavar='URL', help='send each change of an alarm there, as JSON by POST'
    )


def _port(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= 65535:
        raise ArgumentTypeError(f"must be a port from 1 to 65535, such as {PORT}; '{text}' is not")
    return int(text)


def read_token(path: Path) -> str:
    """Return the token in a file: its first line.

    Raises `RecordingError` if it cannot be read, `InputError` if the token is too short.
    """
    try:
        with path.open(encoding='utf-8') as file:
            token = file.readline(_MOST_TOKEN).strip()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(path, f'cannot be read ({getattr(error, "strerror", "")})') from None
    if len(token) < _LEAST_TOKEN:
        raise InputError(f'{path}: a token has at least {_LEAST_TOKEN} characters.')
    return token


# Access control.


class Guard:
    """Answers requests of the page itself and of Prometheus, and rejects all others.

    A page of another site may be open in the same browser, also under a host name that its owner
    directs to this machine (DNS rebinding). So the requested host must be one of ours, and a
    request with an origin must have ours. It complains at most once a minute if a request could
    not be answered.
    """

    def __init__(
        self, application: Wsgi, policy: str, metrics: Callable[[], bytes], names: Sequence[str],
        connections: Callable[[], int], complain: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._application, self._metrics = application, metrics
        host = socket.gethostname().lower()
        self._names = {'localhost', host, *(name.lower() for name in names)}
        self._connections, self._complain = connections, complain
        self._told_s = -_TELL_S
        self._static: dict[str, tuple[list[tuple[str, str]], bytes]] = {}
        self._head = [
            ('Content-Security-Policy', policy), ('X-Content-Type-Options', 'nosniff'),
            ('X-Frame-Options', 'DENY'), ('Referrer-Policy', 'no-referrer'),
            ('Cross-Origin-Resource-Policy', 'same-origin'),
            ('Cross-Origin-Opener-Policy', 'same-origin'),
        ]  # fmt: skip
        self.refused = 0

    def __call__(self, environ: dict[str, Any], start: Start) -> Iterable[bytes]:
        """Answer a request."""
        try:
            refusal = self._refusal(environ)
        except ValueError:  # an invalid address
            refusal = ('403 Forbidden', 'This request does not come from the page.')
        if refusal is not None:
            self.refused += 1
            return self._say(start, *refusal)

        def begin(status: str, head: list[tuple[str, str]], *more: Any) -> Any:
            kept = [(k, v) for k, v in head if k.lower() != 'server']
            return start(status, kept + self._head, *more)

        path = str(environ.get('PATH_INFO', ''))
        try:
            if path == '/metrics':
                text = self._metrics()
                begin('200 OK', [
                    ('Content-Type', 'text/plain; version=0.0.4; charset=utf-8'),
                    ('Content-Length', str(len(text))),
                ])  # fmt: skip
                return [text]
            if path.startswith(_STATIC):
                return self._file(path, environ, begin, start)
            return self._asked(environ, begin, start)
        except Exception as error:  # noqa: BLE001 - whatever a strange request brings about
            self.refused += 1
            if time.monotonic() - self._told_s >= _TELL_S:
                self._told_s = time.monotonic()
                what = f'{type(error).__name__}: {str(error)[:200]}'
                self._complain(f'A request of {path[:80]} was not answered ({what}).')
            return self._say(start, '400 Bad Request', 'This request cannot be answered.')

    def _refusal(self, environ: dict[str, Any]) -> tuple[str, str] | None:
        host, path = str(environ.get('HTTP_HOST', '')), str(environ.get('PATH_INFO', ''))
        wanted = 'GET' if path.startswith(_STATIC) else _PATHS.get(path)
        method, origin = environ.get('REQUEST_METHOD'), environ.get('HTTP_ORIGIN')
        if self._connections() > MOST_CONNECTIONS:
            return '503 Service Unavailable', 'Too many connections; try again.'
        if not self._ours(host):
            return '403 Forbidden', 'The page has no such name; --name adds one.'
        site = environ.get('HTTP_SEC_FETCH_SITE', 'none')
        if (origin is not None and urlsplit(str(origin)).netloc.lower() != host.lower()) or (
            path != '/' and site not in ('none', 'same-origin')
        ):
            return '403 Forbidden', 'Only the page itself may ask.'
        if wanted is None:
            return '404 Not Found', 'There is nothing of this name.'
        if method != wanted and not (method == 'HEAD' and wanted == 'GET'):
            return '405 Method Not Allowed', f'Only {wanted} is answered here.'
        return None

    def _ours(self, host: str) -> bool:
        try:
            name = urlsplit(f'//{host}').hostname or ''
        except ValueError:
            return False
        if name in self._names:
            return True
        # An IP address cannot be redirected by DNS.
        with suppress(ValueError):
            return bool(ipaddress.ip_address(name))
        return False

    def _say(self, start: Start, status: str, sentence: str) -> list[bytes]:
        body = f'{sentence}\n'.encode()
        head = [('Content-Type', 'text/plain; charset=utf-8'), ('Content-Length', str(len(body)))]
        if status.startswith('503'):
            head.append(('Retry-After', '10'))
        start(status, head)
        return [body]

    def _asked(self, environ: dict[str, Any], begin: Start, start: Start) -> Iterable[bytes]:
        """Return the answer of the library; if it is an error, its status and a sentence."""
        status, head, body = _whole(self._application, environ)
        if status[0] in '45':
            self.refused += 1
            return self._say(start, status, 'This request cannot be answered.')
        begin(status, head)
        return [body]

    def _file(
        self, path: str, environ: dict[str, Any], begin: Start, start: Start
    ) -> Iterable[bytes]:
        """Return a file of the library; each is compressed and stored once for all readers."""
        if 'gzip' not in str(environ.get('HTTP_ACCEPT_ENCODING', '')):
            return self._asked(environ, begin, start)
        if path not in self._static:
            whole = {**environ, 'REQUEST_METHOD': 'GET'}
            status, head, body = _whole(self._application, whole)
            if not status.startswith('200') or len(self._static) > _MOST_FILES:
                return self._asked(environ, begin, start)
            packed = gzip.compress(body, 6, mtime=0)
            kept = [(k, v) for k, v in head if k.lower() not in ('content-length', 'server')]
            more = [('Content-Encoding', 'gzip'), ('Content-Length', str(len(packed)))]
            self._static[path] = (kept + more, packed)
        head, packed = self._static[path]
        begin('200 OK', head)
        return environ['wsgi.file_wrapper'](io.BytesIO(packed))  # type: ignore[no-any-return]


def _whole(application: Wsgi, environ: dict[str, Any]) -> tuple[str, Any, bytes]:
    kept: list[Any] = []

    def start(status: str, head: list[tuple[str, str]], *_: Any) -> None:
        kept[:] = [status, head]

    answer = application(environ, start)
    try:
        body = b''.join(answer)
    finally:
        close = getattr(answer, 'close', None)
        if close is not None:
            close()
    return str(kept[0]), kept[1], body


# The server.


class PageServer:
    """Serves the page and the metrics in separate threads; port 0 is any free port.

    ``names`` are further names of this machine, ``asking`` an `Asking` for requests of authorised
    users to a monitor. Raises `ValveflowError` if the address cannot be used.
    """

    def __init__(
        self, shown: Shown, host: str = '127.0.0.1', port: int = PORT, names: Sequence[str] = (),
        asking: Any = None, counters: Callable[[], dict[str, tuple[str, float]]] = dict,
        complain: Callable[[str], None] = lambda _: None, zone: tzinfo | None = None,
    ) -> None:  # fmt: skip
        # Check the port first: loading the libraries takes time.
        listener = _listener(host, port)
        try:
            from waitress.server import create_server

            from valveflow_ros.page.metrics import Metrics
            from valveflow_ros.page.view import make_app

            _quiet()
            app, policy = make_app(shown, asking, zone)
            self._sockets: dict[int, Any] = {}
            refused = 'valveflow_page_requests_refused'
            metrics = Metrics(
                shown, lambda: counters() | {refused: ('Requests refused.', self.guard.refused)}
            )
            # The guard reports errors as a sentence.
            app.server.config['PROPAGATE_EXCEPTIONS'] = True
            self.guard = Guard(app.server, policy, metrics.text, names, self.connections, complain)
            self._server = create_server(
                self.guard, map=self._sockets, sockets=[listener], threads=_THREADS,
                connection_limit=_MOST_ACCEPTED, channel_timeout=IDLE_S,
                cleanup_interval=max(1, round(_SWEEP_S)),
                max_request_header_size=_MOST_HEAD, max_request_body_size=_MOST_BODY,
                asyncore_use_poll=True, ident=None, log_socket_errors=False, backlog=128,
                clear_untrusted_proxy_headers=True,
            )  # fmt: skip
        except BaseException:
            listener.close()
            raise
        self.host, self.port = host, listener.getsockname()[1]
        self._ended = threading.Event()
        self._threads = [
            threading.Thread(target=self._run, name='page', daemon=True),
            threading.Thread(target=self._sweep, name='page sweep', daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def address(self) -> str:
        """Return the address of the page for a browser on this machine."""
        host = {'0.0.0.0': '127.0.0.1', '::': '::1'}.get(self.host, self.host.strip('[]'))
        return f'http://{f"[{host}]" if ":" in host else host}:{self.port}/'

    def connections(self) -> int:
        """Return the number of open connections."""
        return sum(1 for channel in list(self._sockets.values()) if hasattr(channel, 'requests'))

    def close(self) -> None:
        """Stop; open connections are closed."""
        self._ended.set()
        # Done in the thread that waits for the sockets, so that no further waiting is needed.
        with suppress(OSError):
            self._server.trigger.pull_trigger(self._close_all)
        for thread in self._threads:
            thread.join(timeout=2.0)

    def _close_all(self) -> None:
        self._server.task_dispatcher.shutdown(cancel_pending=True, timeout=1)
        for channel in list(self._sockets.values()):
            channel.close()
        self._sockets.clear()

    def _run(self) -> None:
        # At the end the sockets are closed during the wait.
        with suppress(OSError, ValueError):
            self._server.run()

    def _sweep(self) -> None:
        """Close connections that hold a request or an answer for too long."""
        since: dict[int, tuple[object, float]] = {}
        while not self._ended.wait(_SWEEP_S):
            now_s, still = time.monotonic(), {}
            for channel in list(self._sockets.values()):
                stuck = getattr(channel, 'request', None)
                slow = getattr(channel, 'total_outbufs_len', 0) > 0
                if stuck is None and not slow:
                    continue
                what, begun_s = since.get(id(channel), (None, now_s))
                begun_s = begun_s if what is (stuck or channel) else now_s
                still[id(channel)] = (stuck or channel, begun_s)
                idle = time.time() - channel.last_activity > IDLE_S
                limit_s = _LONGEST_S if slow else float(IDLE_S)
                if now_s - begun_s > limit_s or (slow and idle):
                    # The thread of the server then detects the end and cleans up.
                    with suppress(OSError):
                        channel.socket.shutdown(socket.SHUT_RDWR)
            since = still


def _listener(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host.strip('[]'), port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError):
        raise UsageError(f"--host must be an address of this machine; '{host}' is none.") from None
    made = socket.socket(family, kind, protocol)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
        # With SO_REUSEADDR a second socket on the port fails here, not at bind.
        made.listen(128)
    except OSError as error:
        made.close()
        if error.errno == errno.EADDRINUSE:
            raise ValveflowError(
                f'Port {port} of {host} is in use, perhaps by another page; '
                'choose one with --port.'
            ) from None
        said = error.strerror or str(error)
        raise ValveflowError(f'{host}, port {port}: cannot be listened on ({said}).') from None
    return made


def _quiet() -> None:
    """Suppress log messages of the libraries; relevant errors are counted and reported here."""
    for name in ('waitress', 'waitress.queue', 'werkzeug', 'valveflow_page', 'dash'):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
