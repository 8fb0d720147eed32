# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow monitor``: run the monitor on a log."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from valveflow_ros.cli import command

if TYPE_CHECKING:
    from valveflow_ros.interface.monitor import MonitorResult

USAGE = 'LOG -o DIR [options]'
DESCRIPTION = """\
Run the monitor over a recorded log, as fast as possible: the curves, alarms and diagnoses that
the live monitor would have given. Use it to choose alarm parameters before the monitor runs
live. DIR gets report.html for people and monitor.json for programs.

example:
  valveflow monitor plant.mcap -o result

faster, without the diagnoses:
  valveflow monitor plant.mcap -o result --no-diagnosis --set alarm_floor=2.0

fastest, with a curve that exists already, without a fit:
  valveflow monitor plant.mcap -o result --reference health/characteristic.json \\
      --no-diagnosis --set refit_period=0 --set refit_segments=0 --set alarm_on_delay=600

with the condenser pressure, which the diagnoses try as a cause:
  valveflow monitor plant.csv -o result --covariate vacuum=condenser_pressure_kpa"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    command.add_analysis(parser)
    command.add_file(
        parser,
        '--model',
        'an extended_model.json of diagnose: the effects of its causes are removed from the '
        'rows first',
    )
    command.add_file(parser, '--reference', 'a characteristic.json of the healthy plant')
    parser.add_argument(
        '--no-diagnosis', action='store_true',
        help='leave out the diagnoses, each of which takes as long as `valveflow diagnose`',
    )  # fmt: skip
    command.add_covariate(parser)
    command.add_analysis_options(parser)


def run(options: Namespace, console: command.Console) -> command.VerbResult:
    """Open the log, run the monitor, write."""
    covariates = command.covariates_of(options)
    log = command.log_of(options, console)
    from valveflow_ros.interface.monitor import monitor

    found = monitor(
        log, parameters=command.checked_parameters(options), model=options.model,
        reference=options.reference, diagnose=not options.no_diagnosis,
        covariates=covariates or None, progress=console,
    )  # fmt: skip
    console(0.95, 'writing the report')
    return command.write_results(found, options, _text(found), found.to_json())


def _text(found: MonitorResult) -> str:
    from valveflow_ros.report.words import VERDICT_WORDS, counted, moment

    content = found.to_json()
    alarms = [
        [
            alarm['name'],
            moment(alarm['raised']),
            '-' if alarm['cleared'] is None else moment(alarm['cleared']),
            alarm['state'].replace('_', ' '),
        ]
        for alarm in content['alarms']
    ]
    diagnoses = [
        [moment(at), VERDICT_WORDS[d['verdict']], ', '.join(c['name'] for c in d['causes']) or '-']
        for at, d in found.diagnoses
    ]
    return command.lines(
        f'{found.source}: {moment(found.start_ns)} to {moment(found.end_ns)}',
        f'{counted(len(content["curves"]), "curve")}, {counted(len(alarms), "alarm")}, '
        f'{counted(len(content["diagnoses"]), "diagnosis", "diagnoses")}.',
        command.table(['alarm', 'raised', 'cleared', 'state at the end'], alarms),
        *(sentence for _, sentence in found.standing),
        found.evidence_words,
        command.table(['diagnosis', 'verdict', 'causes'], diagnoses),
        *found.named,
        *(f'The last diagnosis: {d["sentence"]}' for _, d in found.diagnoses[-1:]),
        *found.advice,
        found.reference_words,
        found.wear_words,
    )
