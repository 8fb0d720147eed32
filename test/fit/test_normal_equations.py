from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from valveflow_ros.fit.kernels import square_sum
from valveflow_ros.fit.whitening import normal_equations, whitened


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.integers(0, 60),
    columns=st.integers(1, 4),
    order=st.integers(0, 5),
    blocks=st.integers(1, 7),
)
def test_they_are_the_products_of_whitened_columns(seed, rows, columns, order, blocks):
    rng = np.random.default_rng(seed)
    table = rng.normal(0.0, 1.0, (rows, columns))
    residual = rng.normal(0.0, 1.0, rows)
    weight = (rng.random(rows) < 0.9).astype(np.uint8)
    ar = rng.normal(0.0, 0.3, order)
    sums, scores, count = normal_equations(table, residual, weight, ar, blocks)
    both = whitened(np.column_stack([table, residual]), weight, ar)
    assert count == len(both)
    assert sums == pytest.approx(both.T @ both, abs=1e-9)
    assert scores.shape == (blocks, columns)
    assert scores.sum(axis=0) == pytest.approx(sums[:-1, -1], abs=1e-9)
    assert square_sum(residual, weight, ar) == pytest.approx(sums[-1, -1], abs=1e-9)


def test_a_block_holds_the_rows_of_its_time():
    residual = np.arange(12.0)
    weight = np.ones(12, dtype=np.uint8)
    table = np.ones((12, 1))
    _, scores, _ = normal_equations(table, residual, weight, np.empty(0), 3)
    assert scores[:, 0].tolist() == [0 + 1 + 2 + 3, 4 + 5 + 6 + 7, 8 + 9 + 10 + 11]


@pytest.mark.parametrize('rows', [0, 1, 4, 5, 6])
def test_fewer_rows_than_the_memory_give_nothing(rows):
    ar = np.full(5, 0.1)
    residual, weight = np.ones(rows), np.ones(rows, dtype=np.uint8)
    sums, scores, count = normal_equations(np.ones((rows, 2)), residual, weight, ar, 3)
    assert count == max(0, rows - 5)
    assert square_sum(residual, weight, ar) == pytest.approx(0.25 * count)
    assert sums == pytest.approx(np.full((3, 3), 0.25 * count))
    assert scores.sum() == pytest.approx(0.5 * count)
