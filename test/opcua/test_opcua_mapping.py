# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The mapping file: what it gives, and the sentence for each thing that cannot be used."""

import copy
from pathlib import Path

import pytest
import yaml
from opcua_server import mapping, signals, write_mapping

from valveflow_ros.errors import ValveflowError
from valveflow_ros.opcua.mapping import read_mapping_file
from valveflow_ros.records import Signal

ROOT = Path(__file__).resolve().parents[2]


def test_a_unit_stands_above_what_is_common(tmp_path):
    content = mapping(4840, period=2.0)
    content['units'].append({
        'namespace': '/u2', 'tag': 'U2', 'period': 0.5, 'endpoint': 'opc.tcp://[::1]:4841/x',
        'signals': signals(),
    })  # fmt: skip
    first, second = read_mapping_file(write_mapping(tmp_path, content)).units
    assert (first.period_ns, second.period_ns) == (2_000_000_000, 500_000_000)
    assert first.endpoint == 'opc.tcp://127.0.0.1:4840'
    assert second.endpoint == 'opc.tcp://[::1]:4841/x'
    pressure = next(n for n in first.nodes if n.signal == Signal.MAIN_STEAM_PRESSURE)
    # Gauge pressures become absolute ones.
    assert 120.0 * pressure.unit.scale + pressure.unit.offset == pytest.approx(12.101325)


def test_the_example_is_one_that_is_taken(tmp_path):
    content = (ROOT / 'config/opcua.yaml').read_text()
    path = tmp_path / 'opcua.yaml'
    path.write_text(content)
    for name in ('gateway.der', 'gateway.pem', 'server.der', 'dcs.der'):
        (tmp_path / name).write_bytes(b'')
    (tmp_path / 'password.txt').write_text('secret\n')
    found = read_mapping_file(path)
    assert found.units[0].user.password == 'secret'
    assert len(found.units[0].nodes) == 5
    assert found.server is not None
    assert found.server.security.trusted == (tmp_path / 'dcs.der',)


def changed(*keys, to):
    content = copy.deepcopy(mapping(4840))
    place = content
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = to
    return content


OPENING = ('units', 0, 'signals', 'valve_opening')
REFUSED = [
    ([], 'keys with values are expected'),
    (changed('units', to=[]), "'units' must be a list"),
    (changed('endpont', to='x'), "'endpont' is unknown; did you mean 'endpoint'?"),
    (changed('endpoint', to='http://x'), "'endpoint' must be such as opc.tcp://"),
    (changed('period', to=0), "'period' must be from 0.05 to 3600 s, not 0"),
    (changed('period', to=float('nan')), "'period' must be from"),
    (changed('units', 0, 'tag', to=''), "'tag' must be a text"),
    (changed('units', 0, 'namespace', to='u 1'), "'namespace' must be such as /u1"),
    (changed('units', 0, 'signals', to={}), "'valve_opening' is missing"),
    (changed(*OPENING, 'unit', to='bar'), "Unit 'bar' is unknown for valve_opening"),
    (changed(*OPENING, 'unit', to=''), "'unit' must be named, such as %, percent, fraction"),
    (changed(*OPENING, 'node', to='HV101'), "'HV101' is no node id such as ns=2;s=HV101.ZT"),
    (changed(*OPENING, 'dead_band', to='1'), "'dead_band' must be a number"),
    (changed('security', to={'policy': 'None'}), 'policy None encrypts nothing; choose another'),
    (changed('security', to={'policy': 'Basic128'}), "'policy' must be one of Basic256Sha256"),
    (changed('security', to={'mode': 'Sign'}), 'mode Sign encrypts nothing'),
    (changed('security', to={}), "'certificate' is missing"),
    (changed('security', to={'certificate': 'no.der'}), 'cannot be read as certificate'),
    (changed('user', to={'name': 'x'}), "'password_file' is missing"),
    (
        changed('server', to={'endpoint': 'opc.tcp://127.0.0.1:1'}),
        "server, security: 'certificate'",
    ),
    ({**mapping(1), 'units': mapping(1)['units'] * 2}, "two units have the namespace '/u1'"),
]


def test_what_cannot_be_used_is_refused_in_words(tmp_path):
    path = tmp_path / 'opcua.yaml'
    with pytest.raises(ValveflowError, match='cannot be read'):
        read_mapping_file(path)
    texts = [(yaml.safe_dump(content).encode(), sentence) for content, sentence in REFUSED]
    texts += [(b'units: [\n', 'is no YAML in line 2'), (b'\xff\xfe', 'is no YAML')]
    for text, sentence in texts:
        path.write_bytes(text)
        with pytest.raises(ValveflowError) as refused:
            read_mapping_file(path)
        assert sentence in str(refused.value)
        assert str(refused.value).startswith(str(tmp_path))
        assert str(refused.value).endswith('.')
