# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The simulated plant as an OPC UA server on this machine, with history: for demo and tutorial.

python -m valveflow_ros.opcua.plant_server [--port 4840] [--hours 6] [--seed 1]
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Sequence
from typing import Any

from valveflow_ros.errors import ValveflowError
from valveflow_ros.opcua.session import check_installed, in_words, to_datetime
from valveflow_ros.plant.simulator import simulate_parts
from valveflow_ros.records import NS_PER_S, SIGNALS

NAMESPACE = 'urn:valveflow:plant'
_LIVE_DAYS, _PART_S = 1.0, 6 * 3600.0


async def serve(port: int, hours: float, seed: int) -> None:
    """Serve the plant: ``hours`` of history, then one row per second, until it is cancelled."""
    from asyncua import Server, ua

    server = Server()
    await server.init()
    server.set_endpoint(f'opc.tcp://127.0.0.1:{port}')
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    index = await server.register_namespace(NAMESPACE)
    start_ns = (time.time_ns() // NS_PER_S - round(3600.0 * hours)) * NS_PER_S
    rows = (
        row
        for part in simulate_parts(
            hours / 24.0 + _LIVE_DAYS, seed, start_ns=start_ns, part_s=_PART_S
        )
        for row in zip(part.table.time_ns.tolist(), part.table.values.tolist(), strict=True)
    )
    nodes = []
    for info in SIGNALS:
        name = ua.NodeId(info.topic, index)
        nodes.append(await server.nodes.objects.add_variable(name, f'{index}:{info.topic}', 0.0))
    await server.start()
    storage = server.iserver.history_manager.storage
    for node in nodes:
        await storage.new_historized_node(node.nodeid, None)

    def values(time_ns: int, row: Sequence[float]) -> list[Any]:
        stamp = to_datetime(time_ns)
        return [ua.DataValue(ua.Variant(v), SourceTimestamp=stamp) for v in row]

    told = False
    for time_ns, row in rows:
        if not told and time_ns >= time.time_ns():
            print(f'The plant is at opc.tcp://127.0.0.1:{port}', flush=True)
            told = True
        await asyncio.sleep(max(0.0, (time_ns - time.time_ns()) / NS_PER_S))
        for node, data in zip(nodes, values(time_ns, row), strict=True):
            await storage.save_node_value(node.nodeid, data)
            if told:
                await node.write_value(data)


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until Ctrl-C; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n')[0])
    parser.add_argument('--port', type=int, default=4840)
    parser.add_argument('--hours', type=float, default=6.0, help='of history')
    parser.add_argument('--seed', type=int, default=1, help='of the plant')
    options = parser.parse_args(arguments)
    try:
        check_installed()
        asyncio.run(serve(options.port, options.hours, options.seed))
    except KeyboardInterrupt:
        pass
    except (ValveflowError, OSError) as error:
        print(f'plant_server: {in_words(error)}.', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
