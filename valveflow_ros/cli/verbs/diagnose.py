# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow diagnose``: errors of the simulation, their cause, and the gain of a new model."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from valveflow_ros.cli import command

if TYPE_CHECKING:
    from valveflow_ros.interface.diagnose import DiagnosisResult

USAGE = 'LOG -o DIR [options]'
DESCRIPTION = """\
Compare the simulation (flow characteristic and regional dynamics, run on the measured opening
and pressure) with the measured power, name the physical cause of what differs, extend the model
by it, and measure on blocks of time that were not used for fitting how much the error falls. DIR
gets diagnosis.json, extended_model.json and report.html.

example:
  valveflow diagnose plant.mcap -o result

against the curve of an earlier record:
  valveflow diagnose plant.mcap -o result --model last_year/characteristic.json

with the condenser pressure, which the power follows too:
  valveflow diagnose plant.csv -o result --covariate vacuum=condenser_pressure_kpa"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    command.add_analysis(parser)
    command.add_file(
        parser,
        '--model',
        'characteristic.json or extended_model.json of an earlier log, to compare with '
        'this one; without it the curve is found from this log',
    )
    command.add_covariate(parser)
    command.add_analysis_options(parser)


def run(options: Namespace, console: command.Console) -> command.VerbResult:
    """Open the log, diagnose, write."""
    covariates = command.covariates_of(options)
    log = command.log_of(options, console)
    from valveflow_ros.diagnosis.result import to_json
    from valveflow_ros.interface.diagnose import diagnose

    found = diagnose(
        log, parameters=command.checked_parameters(options), model=options.model,
        covariates=covariates or None, progress=console,
    )  # fmt: skip
    console(0.95, 'writing the report')
    return command.write_results(found, options, _text(found), to_json(found.diagnosis))


def _text(found: DiagnosisResult) -> str:
    from valveflow_ros.diagnosis.result import NOTHING
    from valveflow_ros.report.diagnosis import by_reason, cells
    from valveflow_ros.report.words import VERDICT_WORDS, advice, floor_words, level

    d = found.diagnosis
    rows = [
        [c.name, key, *cells(e, found.form.input_exponent)]
        for c in d.causes
        for key, e in c.parameters.items()
    ]
    blind = 'cannot be judged'
    unchecked = [
        f'  {", ".join(names)}: {why.removeprefix(blind).lstrip(": ")}'
        for why, names in by_reason(d.rejected).items()
        if why.startswith(blind)
    ]
    # The sentence of the verdict 'nothing' begins with it.
    verdict = '' if d.verdict == NOTHING else f'{VERDICT_WORDS[d.verdict]}. '
    return command.lines(
        f'{found.data.source}: {verdict}{d.sentence}',
        *(advice(c.name, c.meaning, c.to_do) for c in d.causes),
        command.table(['cause', 'parameter', 'value', '95 % interval'], rows),
        *(f'What would tell them apart: {e}' for e in d.experiments),
        'Error (RMSE) on blocks of time that nothing was fitted to: simulation '
        f'{level(d.rmse_simulation, 3)} MW, extended model {level(d.rmse_extended, 3)} MW. '
        f'{floor_words(d.disturbance is not None)} would give about '
        f'{level(d.rmse_noise_floor, 3)} MW.',
        '\n'.join(['Could not be checked:', *unchecked]) if unchecked else '',
        *d.notes,
    )
