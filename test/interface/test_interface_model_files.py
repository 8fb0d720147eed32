# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files of curves and models with one thing changed, through every door that reads them."""

import copy
import itertools
import json
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from valveflow_ros.baselines.truth import Truth
from valveflow_ros.curve.characteristic import (
    Characteristic,
    ChartDesign,
    Choice,
    FittedData,
    HeldCause,
    Piece,
    RegionDynamics,
    ResidualStatistics,
    Support,
)
from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.diagnosis.result import model_from_json, model_to_json
from valveflow_ros.errors import DataError, ParameterError, RecordingError
from valveflow_ros.interface.models import load_characteristic, load_extended, load_truth
from valveflow_ros.interface.parameter_files import given_model, given_reference
from valveflow_ros.parameters import Settings

sys.path.insert(0, str(Path(__file__).parents[1]))

from extended_file import extended_json

PIECES = (
    Piece(900.0, 1200.0, 0.2, -60.0, 0.01, 12.0, 400),
    Piece(1200.0, 1900.0, 0.1, 60.0, 0.002, 3.0, 900),
    Piece(1900.0, 2300.0, 0.05, 155.0, math.nan, math.nan, 80),
)
CURVE = to_json(
    Characteristic(
        pressure_exponent=1.125,
        pieces=PIECES,
        breakpoint_intervals=((1190.0, 1210.0), (math.nan, math.nan)),
        choice=Choice('paper', {1: 9.0, 2: 3.0}, {2: 0.4}, 'why', {1: 0.1, 2: 0.9}),
        source=FittedData(10**18, 2 * 10**18, 8, 3, 1380, 539.0, 2.0, False),
        residuals=ResidualStatistics(
            2.5, 0.4, 300.0, 0.7, 0.3, 4.9,
            ChartDesign(60.0, 0.3, 0.2, (0.2, 1.0), (9.0, 3.0), 30.0),
        ),
        dynamics=(
            RegionDynamics(120.0, 240.0, 10.0, 3.0, 0.5, 0.1, 2.0),
            RegionDynamics(240.0, 270.0, 80.0, 10.0, 2.0, math.nan),
        ),
        partition_pieces=PIECES,
        notes=('one', 'two'),
        support=tuple(Support(2, 1, p.samples, (p.u_from + 1.0, p.u_to), True) for p in PIECES),
        held=(HeldCause('backlash', (('w_percent', 0.5),), 'It sticks.'),),
    ).with_id()
)  # fmt: skip
MODEL = extended_json(
    backlash={'w_percent': 1.2}, reheater={'alpha': 0.3, 'time_s': 9.0},
    gain_step={'g': 0.02, 't0_days': 3.0},
)  # fmt: skip
MODEL['causes'][2]['switches_s'] = [10.0, 20.0]
MODEL['on_top_of'] = extended_json(input_drift={'g': 0.01})
VALUES = [math.nan, math.inf, -math.inf, -1, 0, 10**400, 1e300, 'x', None, [], {}, True]


def places(raw: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield every place of nested JSON and what stands there."""
    for key, value in raw.items() if isinstance(raw, dict) else enumerate(raw):
        yield (*at, key), value
        if isinstance(value, dict | list):
            yield from places(value, (*at, key))


MISSING = object()


def changed(raw: dict[str, Any], path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    """Return the file with another value at a place, or without it."""
    content = copy.deepcopy(raw)
    inside: Any = content
    for key in path[:-1]:
        inside = inside[key]
    if value is MISSING:
        del inside[path[-1]]
    else:
        inside[path[-1]] = value
    return content


def mutations(raw: dict[str, Any]) -> Iterator[tuple[tuple[Any, ...], dict[str, Any]]]:
    """Yield the file with one thing changed, and where."""
    for path, value in places(raw):
        others = [] if isinstance(value, dict | list) else VALUES
        if isinstance(path[-1], str):
            others = [*others, MISSING]
        if isinstance(value, list):
            others = [*others, [], value[:-1], value[1:], value[::-1], [*value, *value[-1:]]]
        yield from ((path, changed(raw, path, other)) for other in others)


# --- what can be, in plain words and without the reader's own tables --------------------------


def number(value: Any, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def unknown_or(value: Any, low: float, high: float) -> bool:
    return value is None or number(value, low, high)


def count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1e19


def rises(values: list[float]) -> bool:
    return values == sorted(set(values))


def text(value: Any) -> bool:
    return isinstance(value, str)


# By the parameters an opening may be as low as -50 %, so a curve may begin a little below zero.
INPUT, POWER = (-1e6, 1e8), (-1e8, 1e8)


def piece_can_be(piece: dict[str, Any]) -> bool:
    ends = piece['u_from'], piece['u_to']
    return (
        all(number(u, *INPUT) for u in ends) and ends[0] < ends[1]
        and number(piece['slope'], -1e12, 1e12) and number(piece['intercept'], -1e16, 1e16)
        and all(number(piece['slope'] * u + piece['intercept'], *POWER) for u in ends)
        and unknown_or(piece['slope_stderr'], 0, 1e31)
        and unknown_or(piece['intercept_stderr'], 0, 1e31) and count(piece['samples'])
    )  # fmt: skip


def support_can_be(piece: dict[str, Any]) -> bool:
    support = piece.get('support')
    if support is None:
        return 'support' not in piece
    return (
        all(count(support[name]) for name in ('steady', 'slope_response', 'samples'))
        and all(number(u, *INPUT) for u in support['levels']) and rises(support['levels'])
    )  # fmt: skip


def selection_can_be(selection: dict[str, Any]) -> bool:
    return (
        text(selection['rule']) and text(selection.get('note', ''))
        and all(unknown_or(v, 0, 1e31) for v in selection['cost'].values())
        and all(unknown_or(v, -360, 360) for v in selection['turning_angle'].values())
        and all(unknown_or(v, 0, 1.001) for v in selection.get('confidence', {}).values())
    )  # fmt: skip


def dynamics_can_be(regions: list[dict[str, Any]]) -> bool:
    ends = [regions[0]['power_from'] if regions else 0.0, *(r['power_to'] for r in regions)]
    return all(number(x, *POWER) for x in ends) and rises(ends) and all(
        a['power_to'] == b['power_from'] for a, b in itertools.pairwise(regions)
    ) and all(
        number(r['time_constant_s'], 1e-9, 3600) and number(r['delay_s'], 0, 600)
        and all(
            unknown_or(r.get(name), 0, 1e31)
            for name in ('time_constant_stderr_s', 'delay_stderr_s', 'power_to_stderr_mw')
        ) for r in regions
    )  # fmt: skip


def residuals_can_be(residuals: dict[str, Any]) -> bool:
    names = 'rmse_mw', 'average_sd_mw', 'average_s', 'input_noise', 'power_noise_mw'
    if not residuals:
        return True
    chart = residuals.get('chart')
    return (
        all(number(residuals[name], 0, 1e8) for name in names)
        and unknown_or(residuals.get('width_mw'), 0, 1e31)
        and ('chart' not in residuals or (
            number(chart['block_s'], 1e-6, 1e7) and number(chart['correlation'], 0, 0.9999)
            and number(chart['innovation_mw'], 1e-15, 1e8)
            and number(chart['run_length_days'], 1e-9, 1e7)
            and all(number(chart[k]['slack'], 0, 1e9) for k in ('small', 'large'))
            and all(number(chart[k]['limit'], 1e-9, 1e12) for k in ('small', 'large'))
        ))
    )  # fmt: skip


def curve_can_be(raw: dict[str, Any]) -> bool:
    pieces, intervals = raw['pieces'], raw['breakpoint_intervals']
    window, temperature = raw.get('window', {}), raw.get('temperature', {})
    segments = raw['segments']
    return (
        raw['format'] == 'valveflow/characteristic' and raw['version'] in (1, 2)
        and text(raw.get('model_id', '')) and form_can_be(raw)
        and len(pieces) > 0 and all(map(piece_can_be, pieces)) and all(map(support_can_be, pieces))
        and all(p.get('identifiable', True) in (True, False) for p in pieces)
        and all(a['u_to'] == b['u_from'] for a, b in itertools.pairwise(pieces))
        and len(intervals) == len(pieces) - 1
        and all(
            len(i) == 2 and unknown_or(i[0], -1e31, p['u_to'])
            and unknown_or(i[1], p['u_to'], 1e31)
            for i, p in zip(intervals, pieces, strict=False)
        )
        and selection_can_be(raw['selection']) and dynamics_can_be(raw['dynamics'])
        and residuals_can_be(raw.get('residuals', {}))
        and all(count(segments[name]) for name in ('steady', 'slope_response', 'samples'))
        and (not window or (count(window['start_ns']) and count(window['end_ns'])
                            and window['start_ns'] <= window['end_ns']))
        and (not temperature or (
            unknown_or(temperature['mean_degc'], -50, 1000)
            and unknown_or(temperature['spread_k'], 0, 1e4)
            and isinstance(temperature['flag'], bool)
        ))
        and all(map(piece_can_be, raw.get('partition', {'pieces': []})['pieces']))
        and rises([p['u_from'] for p in raw.get('partition', {'pieces': []})['pieces']])
        and all(map(text, raw.get('notes', [])))
        and all(
            text(h['name']) and text(h['sentence'])
            and all(number(v, -1e15, 1e15) for v in h['values'].values())
            for h in raw.get('held', [])
        )
        and isinstance(raw.get('optimal', True), bool)
    )  # fmt: skip


def form_can_be(raw: dict[str, Any]) -> bool:
    axis, told = raw.get('axis', 'integrated_input'), raw.get('form')
    e, c = raw.get('pressure_scale_exponent', 0.0), raw.get('offset_mw', 0.0)
    return (
        (axis == 'integrated_input' and number(raw['pressure_exponent'], 0.5, 2) and e == c == 0)
        or (axis == 'opening' and number(raw['pressure_exponent'], 0, 2)
            and number(e, 0.5, 2) and number(c, *POWER))
    ) and unknown_or(raw.get('reference_pressure_mpa'), 1e-4, 1e3) and (told is None or (
        told['chosen'] in ('integrated_input', 'opening')
        and number(told['log_likelihood_gain'], -1e16, 1e16)
        and all(number(told[f'rmse_{k}'], 0, 1e13) for k in ('mw', 'other_mw'))
        and number(told['apart_mw'], 0, 1e13) and text(told['other'])
        and all(number(x, -1e13, 1e13) for x in told['worst'].values())
        and all(isinstance(told[k], bool) for k in ('told', 'contradicted'))
    ))  # fmt: skip


def model_can_be(raw: dict[str, Any]) -> bool:
    curve, dynamics, reference = raw['curve'], raw['dynamics'], raw['reference']
    knots, levels = curve['knots'], dynamics['levels']
    times, delays = dynamics['time_constants_s'], dynamics['delays_s']
    return (
        raw['format'] == 'valveflow/extended_model' and raw['version'] == 2
        and number(raw['pressure_exponent'], 0.5, 2) and count(raw['start_ns'])
        and all(number(u, *INPUT) for u in knots) and rises(knots) and len(knots) > 1
        and all(number(x, *POWER) for k in ('left', 'right') for x in curve[k])
        and len(curve['left']) == len(curve['right']) == len(knots) - 1
        and all(number(x, *POWER) for x in levels) and rises(levels)
        and len(times) == len(delays) == len(levels) + 1
        and all(number(t, 1e-9, 3600) for t in times) and all(number(d, 0, 600) for d in delays)
        and number(reference['span_s'], 1, 1e9)
        and number(reference['temperature_degc'], -50, 1000)
        and number(reference['log_pressure'], -50, 50)
        and all(number(reference[f'pressure_{k}'], -1e9, 1e9) for k in ('level', 'slope'))
        and number(reference.get('opening_noise', 0.0), 0, 1e3)
        and all(
            text(c['name']) and all(number(v, -1e6, 1e6) for v in c['values'].values())
            and rises(c['switches_s']) and all(number(t, -1e9, 1e9) for t in c['switches_s'])
            for c in raw['causes']
        )
        and ('on_top_of' not in raw or model_can_be(raw['on_top_of']))
    )  # fmt: skip


# --- finite answers ---------------------------------------------------------------------------


def answers(curve: Characteristic) -> None:
    u = np.linspace(curve.breakpoints[0], curve.breakpoints[-1], 50)
    assert np.isfinite(curve(u)).all()
    assert np.isfinite(curve.values()).all()
    assert np.isfinite(curve.model.slopes()).all()
    assert not np.isinf(curve.opening(curve.values(), 16.0)).any()
    assert np.isfinite(curve.model.time_constants).all()
    json.dumps(to_json(curve), allow_nan=False)


def model_answers(model: ExtendedModel) -> None:
    answers(model.characteristic())


def truth_answers(truth: Truth) -> None:
    assert np.isfinite(truth(truth.knots)).all()


def truth_can_be(raw: dict[str, Any]) -> bool:
    more = {'slope_stderr': None, 'intercept_stderr': None, 'samples': 0}
    pieces = [{**piece, **more} for piece in raw['pieces']]
    return number(raw.get('pressure_exponent', 1.125), 0.5, 2) and all(map(piece_can_be, pieces))


TRUTH = {
    'pressure_exponent': 1.125,
    'pieces': [
        {name: piece[name] for name in ('u_from', 'u_to', 'slope', 'intercept')}
        for piece in CURVE['pieces']
    ],
}
# The file, what reads it, whether it can be, what it must answer, and the node's own door.
DOORS: dict[str, tuple[Any, ...]] = {
    'curve': (CURVE, load_characteristic, curve_can_be, answers, 'reference_file'),
    'model': (MODEL, load_extended, model_can_be, model_answers, 'model_file'),
    'truth': (TRUTH, load_truth, truth_can_be, truth_answers, ''),
}
NODE: dict[str, Any] = {'reference_file': given_reference, 'model_file': given_model}


@pytest.mark.parametrize(('raw', 'write'), [(CURVE, to_json), (MODEL, model_to_json)])
def test_what_was_not_changed_is_read(tmp_path: Path, raw: dict[str, Any], write: Any) -> None:
    path = tmp_path / 'given.json'
    path.write_text(json.dumps(raw))
    _, read, can_be, answer, _ = DOORS['curve' if raw is CURVE else 'model']
    assert can_be(raw)
    assert write(read(path)) == raw
    answer(read(path))


@pytest.mark.parametrize('kind', DOORS)
def test_one_change_is_refused_or_possible_at_every_door(tmp_path: Path, kind: str) -> None:
    file, read, can_be, answer, door = DOORS[kind]
    path, tried, refused = tmp_path / 'given.json', 0, 0
    given = {door: str(path)} if door else {}
    settings = Settings({**given, 'pressure_exponent': 1.125})
    for where, raw in mutations(file):
        path.write_text(json.dumps(raw))
        tried += 1
        try:
            found = read(path)
        except RecordingError as error:
            refused, said = refused + 1, str(error)
            assert str(path) in said
            assert '\n' not in said
            assert len(said) < 600, said
            assert f"'{where[0]}" in said or 'has version' in said, where
            if door and refused % 5 == 0:
                with pytest.raises(ParameterError, match=re.escape(str(path))):
                    NODE[door](settings)
            continue
        assert can_be(raw), (where, raw)
        answer(found)
        if kind == 'curve' and found.pressure_exponent == 1.125:
            assert given_reference(settings) is not None
    assert tried > {'curve': 1500, 'model': 800, 'truth': 100}[kind]
    assert refused > 0.5 * tried


def test_numbers_of_pieces_that_cannot_be_are_refused(tmp_path: Path) -> None:
    path = tmp_path / 'given.json'
    for name in ('0', '101', '9' * 5000, '٣', '1.0', ''):
        path.write_text(json.dumps(changed(CURVE, ('selection', 'cost', name), 1.0)))
        with pytest.raises(RecordingError, match=r"'selection\.cost' has a key"):
            load_characteristic(path)


def test_models_on_top_of_one_another_end(tmp_path: Path) -> None:
    raw = extended_json()
    for _ in range(200):
        raw = {**extended_json(), 'on_top_of': raw}
    with pytest.raises(DataError, match='models deep'):
        model_from_json(raw)
