# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page of a diagnosis: the answer with its doubts first, then the four steps."""

import re
from dataclasses import replace

from report_stories import diagnosed, diagnosis, words_of

from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.diagnosis import causes
from valveflow_ros.report.diagnosis import axis_titles, diagnosis_page, points_to
from valveflow_ros.report.figure import plain_text
from valveflow_ros.report.words import decimals, held_words


def test_the_answer_names_the_cause_its_rival_and_the_experiment_then_come_the_steps():
    page, d = diagnosis_page(diagnosed()), diagnosis()
    assert [s.title for s in page.sections] == [
        'The answer', '1. What is wrong', '2. Why', '3. The extended model',
        '4. Check on held-out data', 'How the curve moved', 'What the monitor said',
    ]  # fmt: skip
    first = ' '.join(p for p in page.sections[0].parts if isinstance(p, str))
    rmse = (d.rmse_simulation, d.rmse_extended, d.rmse_noise_floor)
    for part in (d.sentence, 'tell gain_step and input_step apart', 'Weigh the coal.',
                 *(decimals(value, 2) for value in rmse)):  # fmt: skip
        assert part in first
    words = words_of(page.to_html())
    assert '2023-11-15 10:10 UTC' in words
    assert not re.search(r'\b(nan|None|inf)\b', words)
    for figure in page.figures:
        assert figure.caption.startswith('<b>')
        assert len(words_of(f'<body>{figure.caption}<script')) > 60, figure.name


def test_the_one_picture_is_the_variable_that_shows_most():
    data = diagnosed()
    strong = tuple(
        replace(s, share_before=0.9 if s.variable == 'time' else 0.1) for s in data.signatures
    )
    names = [f.name for f in diagnosis_page(replace(data, signatures=strong)).figures]
    assert names[0] == 'residual-time'
    assert len(names) == len(set(names)), 'every picture stands once'
    assert {'residual-u', 'fast-moves', 'map-time', 'segments', 'history', 'alarms'} < set(names)


def test_every_variable_has_an_axis_and_a_hint():
    for name in (
        'u', 'pressure given u', 'temperature', 'time', 'time of day', 'ramp', 'direction'
    ):  # fmt: skip
        titles = axis_titles(name, 1.125)
        assert titles['text'] != name
        assert len(plain_text(titles.get('short', titles['text']))) < 36
        assert points_to(name)
        # Of a curve over the opening, u is the opening.
        assert not re.search(r'\bu\b', plain_text(axis_titles(name, 0.0)['text']))


def test_a_held_cause_is_told_and_what_changes_with_time_is_counted_from_the_mean():
    step = HeldCause('gain_step', (('g', 0.0057), ('t0_days', 1.986)), 'From 2023-11-16 on.')
    told = held_words((step,))
    assert 'gain_step (g = 0.0057)' in told
    assert 't0_days' not in told
    assert 'From 2023-11-16 on.' in told
    for name, cause in causes.catalogue().items():
        changes = 'ramp' in cause.act.__code__.co_names or name == 'intervals'
        told = held_words((HeldCause(name, (('x', 0.3),), 'It is so.'),))
        assert ('curve contains the mean effect' in told) == changes, name
        assert ('without it' in told) == (not changes), name
