# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What has to be compiled first is known by numba's cache."""

from __future__ import annotations

import os
import subprocess
import sys

import numba
import pytest

from valveflow_ros.report import first_run


def test_the_first_run_is_known_by_the_empty_cache(tmp_path):
    code = (
        'from valveflow_ros.report.first_run import is_first_run, must_compile_to_fit;'
        'print(is_first_run(), must_compile_to_fit())'
    )

    def ask(**changes):
        done = subprocess.run(
            [sys.executable, '-c', code], capture_output=True, text=True, check=True,
            env={**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path), **changes},
        )  # fmt: skip
        return done.stdout.strip()

    assert ask(NUMBA_DISABLE_JIT='0') == 'True True'
    assert ask(NUMBA_DISABLE_JIT='1') == 'False False'


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
@pytest.mark.parametrize(('cold', 'expected'), [('partition', True), ('no such', False)])
def test_a_fit_must_compile_where_only_its_own_part_is_cold(monkeypatch, cold, expected):
    monkeypatch.setattr(first_run, '_is_cold', lambda found: cold in found.__module__)
    assert first_run.must_compile_to_fit() == expected
    assert not first_run.is_first_run()
