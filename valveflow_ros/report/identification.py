# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The report of an identification: the result first, then the evidence."""

from __future__ import annotations

from collections.abc import Iterator

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.fit.static_test import STATIC_RULE
from valveflow_ros.fit.step_test import RULE
from valveflow_ros.parameters import PARAMETERS, Settings
from valveflow_ros.records import FLOW_UNITS
from valveflow_ros.report import page as html
from valveflow_ros.report import words as say
from valveflow_ros.report.answer import (
    answer_words,
    breakpoints_cells,
    choice_figure,
    confidence_table,
    dynamics_cells,
    dynamics_figure,
    gain_table,
    pieces_table,
    temperature_words,
    window_words,
)
from valveflow_ros.report.curve import (
    curve_figure,
    opening_figure,
    segments_figure,
    shift_section,
    surface_figure,
)
from valveflow_ros.report.data import (
    coverage_figure,
    presence_figure,
    quality_table,
    quality_words,
    signals_figure,
)
from valveflow_ros.report.history import history_sections
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.page import Page, Section

# Intervals of the monitor; and a unit, which the page would write in both columns.
_NOT_SHOWN = 'refit_', 'generated_power_unit'


def identification_report(data: Identified) -> str:
    """Return ``report.html``: one self-contained page that opens without a network."""
    return identification_page(data).to_html()


def identification_page(data: Identified) -> Page:
    """Return the report: the result and its figure first, then the evidence."""
    c = data.characteristic
    tag = data.settings.text('unit_tag')
    named = tag != PARAMETERS['unit_tag'].default
    of_steam = 'Valve' if c.output_unit in FLOW_UNITS else 'Main steam valve'
    title = f'Flow characteristic of {tag}' if named else f'{of_steam} flow characteristic'
    times = say.period(c.source.window_start_ns, c.source.window_end_ns)
    sections = [
        html.section(
            'The answer', html.notice(html.text(data.mixture)) if data.mixture else None,
            answer_words(data), gain_table(data), curve_figure(data), opening_figure(data),
            pieces_table(data), html.table(*breakpoints_cells(data.shown)),
        ),
        shift_section(data),
        *history_sections(data.history),
        html.section(
            'The special segments', signals_figure(data), segments_figure(data),
            surface_figure(data),
        ),
        _choice(c),
        _dynamics(c),
        html.section(
            'The data', quality_words(data), quality_table(data), presence_figure(data),
            coverage_figure(data), *_read(data),
        ),
        html.section('How it was made', _settings(data.settings)),
    ]  # fmt: skip
    end_of_page = html.foot(
        f'Curve <code>{html.text(c.model_id)}</code>; the same numbers without rounding are in '
        'characteristic.json beside this page.'
    )
    lead = html.where(data.source, f'{times} ({window_words(c)})')
    return Page(title, lead, [s for s in sections if s], end_of_page, 'identify')


def _choice(c: Characteristic) -> Section:
    """Return the choice of the number of pieces; without turning angles there is no figure."""
    title, choice = 'Why this number of pieces', c.choice
    if not choice.turning_angle and choice.rule in (RULE, STATIC_RULE):
        return html.section(title, html.paragraph(html.text(choice.note)))
    figure = choice_figure(choice, max(1, len(c.pieces)))
    return html.section(title, figure, confidence_table(choice))


def _dynamics(c: Characteristic) -> Section:
    title = 'How fast the unit answers'
    if not c.dynamics:
        none = 'Time constants and delays were not estimated for this curve.'
        return html.section(title, html.paragraph(none))
    table = html.table(*dynamics_cells(c.dynamics))
    return html.section(title, table, dynamics_figure(c.dynamics))


def _read(data: Identified) -> Iterator[str]:
    c = data.characteristic
    yield html.paragraph(html.text(temperature_words(data)))
    yield html.paragraph(
        f'Noise used for the thresholds, as standard deviation of block means: '
        f'{say.plain(data.shown.residuals.input_noise, 3)} in '
        f'{say.input_name(data.shown.pressure_exponent)}, '
        f'{say.plain(c.residuals.power_noise_mw, 3)} MW in power.'
    )
    yield html.bullets(map(html.text, data.notes)) if data.notes else ''


def _settings(settings: Settings) -> str:
    rows = [
        [html.text(cell) for cell in (
            name, _shown(settings[name]) + (f' {row.unit}' if row.unit else ''),
            _shown(row.default),
        )]
        for name, row in PARAMETERS.items()
        if settings[name] != row.default and not name.startswith(_NOT_SHOWN)
    ]  # fmt: skip
    if not rows:
        return html.paragraph('Every parameter has its default value.')
    return html.paragraph('Parameters that differ from their default:') + html.table(
        ['parameter', 'value', 'default'], rows
    )


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'{value:g}' if isinstance(value, float) else str(value)
