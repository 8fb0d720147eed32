# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow identify``: identify the flow characteristic from a log."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from valveflow_ros.cli import command

if TYPE_CHECKING:
    from valveflow_ros.curve.characteristic import Characteristic
    from valveflow_ros.interface.identify import Identification
    from valveflow_ros.report.identified import Identified

USAGE = 'LOG -o DIR [options]'
DESCRIPTION = """\
Find the flow characteristic of the valve in a log of ordinary operation: steady states and
steady ramps are selected, and a curve of straight pieces is fitted to them. DIR gets
report.html for people and characteristic.json for programs. The sampling interval is found
automatically.

example:
  valveflow identify plant.mcap -o result

and for a table with names of your own:
  valveflow identify history.csv -o result --column valve_opening=CV_POS
      --column main_steam_pressure=PT_100:bar --column generated_power=MW_GROSS
      --constant main_steam_temperature=540

without the effect of causes that diagnose found in an earlier log:
  valveflow identify plant.mcap -o result --model earlier/extended_model.json"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    command.add_analysis(parser)
    command.add_file(
        parser,
        '--model',
        'an extended_model.json of diagnose: its causes are kept fixed, curve and dynamics '
        'are found anew',
    )
    command.add_covariate(
        parser, 'the column of a covariate of --model, if this log calls it otherwise'
    )
    command.add_file(
        parser,
        '--reference',
        'a characteristic.json to judge the curve against: DIR gets shift.json',
    )
    parser.add_argument(
        '--step-test', action='store_true',
        help='the log is a manual test: pressure constant, the opening in steps, each held',
    )  # fmt: skip
    command.add_analysis_options(parser)


def run(options: Namespace, console: command.Console) -> command.VerbResult:
    """Open the log, identify, write."""
    log = command.log_of(options, console)
    from valveflow_ros.interface.identify import identify

    given = command.checked_parameters(options)
    # A parameter file of the node may contain a model too.
    found = identify(
        log, parameters=given, model=options.model or given.get('model_file') or None,
        covariates=command.covariates_of(options),
        reference=options.reference, step_test=options.step_test, progress=console,
    )  # fmt: skip
    console(0.9, 'writing the report')
    return command.write_results(found, options, _text(found.data), _data(found))


def _data(found: Identification) -> dict[str, Any]:
    from valveflow_ros.curve.characteristic_json import to_json
    from valveflow_ros.curve.shift import shift_json
    from valveflow_ros.records import SIGNALS
    from valveflow_ros.report.answer import explained

    data, log = found.data, found.log
    return {
        **to_json(data.characteristic),
        'explained': explained(data),
        'readings': data.counts,
        'sample_period_s': data.settings.real('sample_period'),
        'inputs': {SIGNALS[s].topic: name for s, name in log.contents.signals.items()},
        'constants': {SIGNALS[s].topic: value for s, value in log.constants.items()},
        'reading_notes': list(data.notes),
        **({} if data.shift is None else {'shift': shift_json(data.shift)}),
    }


def _text(found: Identified) -> str:
    from valveflow_ros.report import answer
    from valveflow_ros.report.data import rejected
    from valveflow_ros.report.words import counted, held_words, moment, percent, plain

    c = found.characteristic
    loads, gains = answer.gain_cells(found)
    compared, against = answer.reference_cells(found)
    return command.lines(
        f'{found.source}: {moment(c.source.window_start_ns)} to {moment(c.source.window_end_ns)}',
        answer.doubt(found),
        f'The flow characteristic has {counted(len(c.pieces), "piece")} and explains '
        f'{percent(answer.explained(found))} of the variance of the power.',
        answer.pieces_doubt(c),
        answer.range_words(found),
        answer.form_words(found),
        command.table(gains, loads),
        _pieces(found),
        _breakpoints(found.shown),
        _dynamics(c),
        'Behind ± stands half of the 95 % interval.',
        f'Found in {counted(c.source.steady, "steady-state segment")} and '
        f'{counted(c.source.slope_response, "slope-response segment")}, '
        f'{counted(c.source.samples, "sample")}. Typical difference '
        f'{plain(c.residuals.rmse_mw, 2)} MW.',
        answer.temperature_words(found),
        held_words(c.held),
        *c.notes,
        '' if found.shift is None else f'Against the reference: {found.shift.sentence}',
        command.table(against, compared),
        command.rejected_words(found.counts) if rejected(found.counts) else '',
    )


def _pieces(found: Identified) -> str:
    from valveflow_ros.report import words

    c = found.shown
    rows = [
        [
            str(k),
            words.span(piece.u_from, piece.u_to, 1),
            words.with_error(piece.slope, piece.slope_stderr),
            words.with_error(piece.intercept, piece.intercept_stderr),
            words.count(piece.samples),
        ]
        for k, piece in enumerate(c.pieces, 1)
    ]
    m = c.pressure_exponent
    head = ['piece', f'{words.input_name(m)} ({words.input_unit_plain(m)})',
            f'slope{found.at_pressure} ({words.per_input(m)})', 'intercept (MW)',
            'samples']  # fmt: skip
    return command.columns(rows, head)


def _breakpoints(c: Characteristic) -> str:
    from valveflow_ros.report.words import input_name, interval, level

    rows = [
        [level(piece.u_to, 1), f'{interval(low, high)}', f'{level(float(value), 1)} MW']
        for piece, (low, high), value in zip(
            c.pieces[:-1], c.breakpoint_intervals, c.values()[1:-1], strict=True
        )
    ]
    head = [f'breakpoint {input_name(c.pressure_exponent)}', '95 % interval', 'power']
    return command.table(rows, head)


def _dynamics(c: Characteristic) -> str:
    from valveflow_ros.report.words import span, time_with_error

    rows = [
        [
            f'{span(d.power_from, d.power_to)} MW',
            time_with_error(d.time_constant_s, d.time_constant_stderr_s, 's'),
            time_with_error(d.delay_s, d.delay_stderr_s, 's'),
        ]
        for d in c.dynamics
    ]
    return command.table(rows, ['dynamics', 'time constant', 'delay'])
