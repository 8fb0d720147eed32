"""The report of an identification: the answer first, then the evidence."""

from __future__ import annotations

from valveflow_ros import __version__
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.fit.step_test import RULE
from valveflow_ros.parameters import PARAMETERS
from valveflow_ros.report.answer import (
    answer_words,
    breakpoints_table,
    choice_figure,
    confidence_table,
    dynamics_figure,
    dynamics_table,
    pieces_table,
    temperature_words,
    window_words,
)
from valveflow_ros.report.curve import curve_figure, segments_figure, shift_section
from valveflow_ros.report.data import (
    coverage_figure,
    presence_figure,
    quality_table,
    quality_words,
    signals_figure,
)
from valveflow_ros.report.figure import Figure
from valveflow_ros.report.history import history_sections
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.page import Page, Section, paragraph, table, text
from valveflow_ros.report.words import moment, plain


def identification_report(data: Identified) -> str:
    """Return ``report.html``: one self-contained page that opens without a network."""
    return identification_page(data).to_html()


def identification_page(data: Identified) -> Page:
    """Return the report: the answer and its picture first, then the evidence."""
    c = data.characteristic
    tag = data.settings.text('unit_tag')
    named = tag != PARAMETERS['unit_tag'].default
    title = f'Flow characteristic of {tag}' if named else 'Main steam valve flow characteristic'
    lead = paragraph(text(data.source), 'where') + paragraph(
        f'{moment(c.source.window_start_ns)} to {moment(c.source.window_end_ns)} '
        f'({window_words(c)})',
        'where',
    )
    sections = [
        _answer(data),
        *([shift] if (shift := shift_section(data)) else []),
        *history_sections(data.history),
        _moments(data),
        _choice(c),
        _dynamics(data),
        _data(data),
        Section('How it was made', [_settings(data)]),
    ]
    foot = (
        f'Made by valveflow {text(__version__)}. Curve <code>{text(c.model_id)}</code>; the same '
        'numbers, unrounded, stand in characteristic.json beside this page.'
    )
    return Page(title, lead, sections, foot, 'identify')


def _answer(data: Identified) -> Section:
    c = data.characteristic
    return Section(
        'The answer',
        [answer_words(data), curve_figure(data), pieces_table(data), breakpoints_table(c)],
    )


def _moments(data: Identified) -> Section:
    rest = segments_figure(data)
    return Section('The moments that carry it', [signals_figure(data), *([rest] if rest else [])])


def _choice(c: Characteristic) -> Section:
    """Return why there are so many pieces; without a turning angle there is nothing to draw."""
    number = max(1, len(c.pieces))
    if not c.choice.turning_angle and c.choice.rule == RULE:
        return Section('Why this number of pieces', [paragraph(text(c.choice.note))])
    return Section(
        'Why this number of pieces', [choice_figure(c.choice, number), confidence_table(c.choice)]
    )


def _dynamics(data: Identified) -> Section:
    dynamics = data.characteristic.dynamics
    if not dynamics:
        return Section(
            'How fast the unit answers',
            [paragraph('Time constants and delays were not estimated for this curve.')],
        )
    return Section(
        'How fast the unit answers', [dynamics_table(dynamics), dynamics_figure(dynamics)]
    )


def _data(data: Identified) -> Section:
    parts: list[str | Figure] = [quality_words(data), quality_table(data)]
    parts += [f for f in (presence_figure(data), coverage_figure(data)) if f is not None]
    return Section('The data', [*parts, _read(data)])


def _read(data: Identified) -> str:
    c = data.characteristic
    told = paragraph(text(temperature_words(c)))
    told += paragraph(
        f'Noise the thresholds stand on, as standard deviation of block means: '
        f'{plain(c.residuals.input_noise, 3)} in u, {plain(c.residuals.power_noise_mw, 3)} MW '
        'in power.'
    )
    if data.notes:
        told += '<ul>' + ''.join(f'<li>{text(n)}</li>' for n in data.notes) + '</ul>'
    return told


def _settings(data: Identified) -> str:
    """Return the parameters that were not left at their default."""
    rows = [
        [
            text(name),
            text(_shown(data.settings[name]) + (f' {row.unit}' if row.unit else '')),
            text(_shown(row.default)),
        ]
        for name, row in PARAMETERS.items()
        if data.settings[name] != row.default and not name.startswith('refit_')
    ]
    if not rows:
        return paragraph('Every parameter has its default value.')
    return paragraph('Parameters that differ from their default:') + table(
        ['parameter', 'value', 'default'], rows
    )


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, int | float):
        return f'{value:g}' if isinstance(value, float) else str(value)
    return str(value)
