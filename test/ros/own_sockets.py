# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which sockets a process holds, and where they are bound, from /proc.

As a program: make a node, and print them.
"""

from __future__ import annotations

import ipaddress
import json
import os
import struct
import sys
import time
from pathlib import Path


def bound(pid: int | str) -> list[tuple[str, str, int]]:
    """Return protocol, address and port of each internet socket of one process."""
    own = set()
    for entry in Path(f'/proc/{pid}/fd').iterdir():
        try:
            target = os.readlink(entry)
        except FileNotFoundError:
            continue
        if target.startswith('socket:['):
            own.add(target[8:-1])
    found = []
    for protocol in ('udp', 'udp6', 'tcp', 'tcp6', 'udplite', 'raw'):
        table = Path(f'/proc/{pid}/net/{protocol}')
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            fields = line.split()
            if fields[9] in own:
                address, port = fields[1].split(':')
                found.append((protocol, readable(address), int(port, 16)))
    return sorted(found)


def readable(text: str) -> str:
    """Return an address as people write it; the kernel writes words of its own byte order."""
    words = struct.unpack(f'>{len(text) // 8}I', bytes.fromhex(text))
    packed = struct.pack(f'={len(words)}I', *words)
    return str(ipaddress.ip_address(packed))


def family(pid: int) -> list[int]:
    """Return a process and its children."""
    found = [pid]
    for task in Path(f'/proc/{pid}/task').iterdir():
        for child in (task / 'children').read_text().split():
            found += family(int(child))
    return found


if __name__ == '__main__':
    import rclpy
    from rclpy.node import Node

    rclpy.init()
    node = Node('sockets')
    time.sleep(0.5)
    json.dump(bound('self'), sys.stdout)
    rclpy.shutdown()
