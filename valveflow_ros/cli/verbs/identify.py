# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow identify``: identify the flow characteristic from a log."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from valveflow_ros.cli import command

if TYPE_CHECKING:
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
    return command.lines(
        f'{found.source}: {moment(c.source.window_start_ns)} to {moment(c.source.window_end_ns)}',
        answer.doubt(found),
        f'The flow characteristic has {counted(len(c.pieces), "piece")} and explains '
        f'{percent(answer.explained(found))} of the variance of the power.',
        answer.pieces_doubt(c),
        answer.range_words(found),
        answer.form_words(found),
        command.table(*answer.gain_cells(found)),
        command.table(*answer.pieces_cells(found)),
        command.table(*answer.breakpoints_cells(found.shown)),
        command.table(*answer.dynamics_cells(c.dynamics)),
        'Behind ± stands half of the 95 % interval.',
        f'Found in {counted(c.source.steady, "steady-state segment")} and '
        f'{counted(c.source.slope_response, "slope-response segment")}, '
        f'{counted(c.source.samples, "sample")}. Typical difference '
        f'{plain(c.residuals.rmse_mw, 2)} MW.',
        answer.temperature_words(found),
        held_words(c.held),
        *c.notes,
        '' if found.shift is None else f'Against the reference: {found.shift.sentence}',
        command.table(*answer.reference_cells(found)),
        command.rejected_words(found.counts) if rejected(found.counts) else '',
    )
