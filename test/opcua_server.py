# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A real OPC UA server in a process of its own, which does what a test tells it."""

import argparse
import asyncio
import contextlib
import datetime
import ipaddress
import json
import logging
import queue
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

URI = 'urn:plant'
# In the units of the mapping below.
VALUES = {'opening': 0.5, 'pressure': 120.0, 'temperature': 1000.0, 'power': 150_000.0}
UNITS = {'opening': 'fraction', 'pressure': 'barg', 'temperature': 'degF', 'power': 'kW'}
TOPICS = {'opening': 'valve_opening', 'pressure': 'main_steam_pressure',
          'temperature': 'main_steam_temperature', 'power': 'generated_power'}  # fmt: skip
# The same in the monitor's units.
ENGINE = {'valve_opening': 50.0, 'main_steam_pressure': 12.101325,
          'main_steam_temperature': 537.7777777777778, 'generated_power': 150.0}  # fmt: skip


def free_port() -> int:
    with socket.create_server(('127.0.0.1', 0)) as free:
        return int(free.getsockname()[1])


def signals(**different: Any) -> dict[str, Any]:
    """The part `signals` of a mapping of this server."""
    return {
        topic: {'node': f'nsu={URI};s={name}', 'unit': UNITS[name]}
        for name, topic in TOPICS.items()
    } | different  # fmt: skip


def mapping(port: int, **different: Any) -> dict[str, Any]:
    """A mapping of one unit without security, quick enough for a test."""
    return {
        'endpoint': f'opc.tcp://127.0.0.1:{port}',
        'security': {'policy': 'None', 'allow_unencrypted': True},
        'period': 0.2, 'publishing_interval': 0.1, 'sampling_interval': 0.05,
        'reconnect_longest': 0.5,
        'units': [{'namespace': '/u1', 'tag': 'U1', 'signals': signals()}],
    } | different  # fmt: skip


def write_mapping(folder: Path, content: dict[str, Any], name: str = 'opcua.yaml') -> Path:
    """JSON is YAML."""
    path = folder / name
    path.write_text(json.dumps(content))
    return path


def certificate(folder: Path, name: str, days: float = 30.0) -> tuple[str, str]:
    """A self-signed certificate and its key as files; days below 0: it has expired."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import rsa
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.timezone.utc)
    alternatives = x509.SubjectAlternativeName([
        x509.UniformResourceIdentifier(f'urn:test:{name}'),
        x509.DNSName('localhost'), x509.IPAddress(ipaddress.ip_address('127.0.0.1')),
    ])  # fmt: skip
    usage = x509.KeyUsage(True, True, True, True, False, True, False, False, False)
    extended = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
    made = (
        x509.CertificateBuilder().subject_name(subject).issuer_name(subject)
        .public_key(key.public_key()).serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=100))
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(alternatives, critical=False).add_extension(usage, critical=False)
        .add_extension(x509.ExtendedKeyUsage(extended), critical=False)
        .sign(key, hashes.SHA256())
    )  # fmt: skip
    paths = folder / f'{name}.der', folder / f'{name}.pem'
    paths[0].write_bytes(made.public_bytes(serialization.Encoding.DER))
    paths[1].write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )  # fmt: skip
    return str(paths[0]), str(paths[1])


class OpcUaServer:
    """Starts the server and tells it what to do."""

    def __init__(self, port: int, *words: str) -> None:
        self.port, self._words = port, words
        self.process = self._start()

    def _start(self) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, __file__, str(self.port), *self._words],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == 'ready\n'
        return process

    def set(self, name: str, value: Any, **more: Any) -> None:
        """Write a value: status, kind of the Variant."""
        stdin, stdout = self.process.stdin, self.process.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(json.dumps({'name': name, 'value': value, **more}) + '\n')
        stdin.flush()
        assert stdout.readline() == 'done\n'

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def restart(self) -> None:
        self.kill()
        self.process = self._start()


class Relay:
    """A TCP relay before a server: the wire that a test cuts, or in which everything is stuck."""

    def __init__(self, to: int) -> None:
        self._to = to
        self._listener = socket.create_server(('127.0.0.1', 0))
        self.port = int(self._listener.getsockname()[1])
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._open, self._flows = True, threading.Event()
        self._flows.set()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                if not self._open:
                    near.close()
                    continue
                far = socket.create_connection(('127.0.0.1', self._to))
                self._pairs.append((near, far))
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=self._pump, args=pair, daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self._flows.wait()
                sink.sendall(data)

    def cut(self) -> None:
        """Close what is open and accept nothing."""
        self._open = False
        for pair in self._pairs:
            for end in pair:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
                end.close()
        self._pairs.clear()

    def hold(self) -> None:
        """Let nothing through; connections stay open and new ones are accepted."""
        self._flows.clear()

    def mend(self) -> None:
        """Let everything through again."""
        self._open = True
        self._flows.set()

    def close(self) -> None:
        self.cut()
        self._listener.close()


class Users:
    """Who is let in: whose certificate and password are those of the options."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._user = options.user.split(':') if options.user else None
        self._trusted = Path(options.trusted).read_bytes() if options.trusted else None

    def get_user(self, _server, username=None, password=None, certificate=None):
        from asyncua.crypto.permission_rules import User, UserRole

        told = password.decode() if isinstance(password, bytes) else password
        wrong = self._user is not None and [username, told] != self._user
        if wrong or (self._trusted is not None and certificate != self._trusted):
            return None
        return User(role=UserRole.User)


async def serve(options: argparse.Namespace) -> None:
    """Listen, and do what stands on the input until it ends."""
    from asyncua import Server, ua

    logging.disable(logging.CRITICAL)
    server = Server(user_manager=Users(options))
    await server.init()
    # Other servers send whatever their sources give.
    server.iserver.aspace._is_expected_variant_type = lambda *_: True
    server.set_endpoint(f'opc.tcp://127.0.0.1:{options.port}')
    policy = options.policy or 'NoSecurity'
    if options.certificate:
        await server.load_certificate(options.certificate)
        await server.load_private_key(options.key)
    server.set_security_policy([getattr(ua.SecurityPolicyType, policy)])
    # Another namespace first: an index is not what a mapping should rest on.
    await server.register_namespace('urn:other')
    index = await server.register_namespace(URI)
    nodes = {}
    for name in (f'{name}{k or ""}' for k in range(options.units) for name in VALUES):
        value = ua.Variant(VALUES[name.rstrip('0123456789')], ua.VariantType.Double)
        nodes[name] = await server.nodes.objects.add_variable(
            ua.NodeId(name, index), f'{index}:{name}', value
        )
    await server.start()
    if options.history:
        for node in nodes.values():
            await server.historize_node_data_change(node)
    print('ready', flush=True)
    asked: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(
        target=lambda: [*map(asked.put, sys.stdin), asked.put('')], daemon=True
    ).start()
    begun_s, count = time.monotonic(), 0
    while True:
        while not asked.empty():
            line = asked.get()
            if not line:
                print(json.dumps({'count': count}), flush=True)
                return
            await _write(server, nodes, json.loads(line))
            print('done', flush=True)
        if options.ramp and time.monotonic() >= begun_s + count / options.ramp:
            count += 1
            for node in nodes.values():
                await node.write_value(ua.Variant(count / 1000.0, ua.VariantType.Double))
        await asyncio.sleep(0.005)


async def _write(server: Any, nodes: dict[str, Any], asked: dict[str, Any]) -> None:
    from asyncua import ua

    stamp = datetime.datetime.now(datetime.timezone.utc)
    kind = getattr(ua.VariantType, asked.get('kind', 'Double'))
    value = ua.Variant(float('nan') if asked['value'] == 'nan' else asked['value'], kind)
    status = ua.StatusCode(getattr(ua.StatusCodes, asked.get('status', 'Good')))
    node = nodes[asked['name']]
    data = ua.DataValue(value, status, stamp)
    await server.iserver.aspace.write_attribute_value(node.nodeid, ua.AttributeIds.Value, data)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument('port', type=int)
    for name in ('policy', 'certificate', 'key', 'user', 'trusted'):
        parser.add_argument(f'--{name}', default='')
    parser.add_argument('--history', action='store_true')
    parser.add_argument('--ramp', type=float, default=0.0)
    parser.add_argument('--units', type=int, default=1)
    asyncio.run(serve(parser.parse_args()))


if __name__ == '__main__':
    main()
