# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Under a limit of memory a person gets a sentence, never a process that died of a signal."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

MIB = 1 << 20


@pytest.mark.parametrize('limit_mib', [300, 700, pytest.param(1100, marks=pytest.mark.long), 2000])
@pytest.mark.parametrize('verb', ['info', 'identify'])
def test_a_limited_process_works_or_says_what_it_needs(
    verb: str, limit_mib: int, tmp_path: Path
) -> None:
    log = tmp_path / 'log.csv'
    rows = [f'{t},{50 + t % 7},{12},{540},{200 + t % 7}' for t in range(300)]
    names = 'time,valve_opening,main_steam_pressure,main_steam_temperature,generated_power'
    log.write_text('\n'.join([names, *rows]))

    more = ['-o', str(tmp_path / 'out')] if verb == 'identify' else []

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (limit_mib * MIB, limit_mib * MIB))

    command = [sys.executable, '-m', 'valveflow_ros.cli.main', verb, str(log), *more]
    done = subprocess.run(
        command, preexec_fn=limited, capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode in (0, 1), 'it died of a signal'
    if done.returncode:
        assert f'may use {limit_mib} MiB of address space' in done.stderr
        assert done.stderr.count('\n') == 1
