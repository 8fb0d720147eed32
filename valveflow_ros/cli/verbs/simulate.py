# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow simulate``: simulate the plant of the paper or another one, with effects."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from valveflow_ros.cli.command import Console, VerbResult, add_file, add_output, time_ns
from valveflow_ros.errors import InputError, UsageError, listed
from valveflow_ros.interface.files import check_log
from valveflow_ros.report.terminal.text import number, whole

if TYPE_CHECKING:
    from valveflow_ros.interface.simulate import Simulation
    from valveflow_ros.plant.simulator import SimulatedLog
    from valveflow_ros.plant.thermal_plant import ThermalLog

USAGE = '-o LOG [options]'
DESCRIPTION = """\
Simulate the unit of the paper's study: a 300 MW unit under load control, with sliding
pressure, pulses of the primary frequency control and noise, recorded once a second. An effect
is a known fault of the unit, to see whether the program finds it.

--unit chooses another unit, of about 330 MW, with boiler, governor, AGC, reheater and condenser:
  choked            one group of valves; the pressure behind them never reduces the flow (choked
                    flow, p^m f(V)), sliding pressure. The effect of this name is the opposite
  sequence          three or four valves that open one after the other, sliding pressure
  integrated_input  the paper's form g(V p^m), sliding pressure
and choked_fixed, sequence_fixed, integrated_input_fixed at fixed pressure. "choked:number=7" is
another unit of the kind; vacuum_per_kpa and temperature_per_k are further options.

--recording says how such a unit is recorded: 1s (every sample), minute (means), compressed
(exception compression, values at their own times; compressed:resample_s=60 holds the last value).
Further options: band_percent, scan_low_s, scan_high_s, longest_s, dropouts_per_day,
dropout_minutes.

example:
  valveflow simulate -o plant.mcap --days 10 --seed 1 --effect gain_drift
  valveflow simulate -o plant.csv --days 2 --unit choked --recording minute --truth truth.json

"valveflow simulate --effects" lists the effects and their parameters; with --unit those of
that unit."""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    told = 'where to write: .mcap, .csv, .parquet, or a folder as ros2 bag makes it'
    add_output(parser, 'LOG', told, required=False)
    parser.add_argument(
        '--days', metavar='D', type=number('a number of days', 0, 400, '--days 10', above=True),
        default=10.0, help='how many days of operation, such as 0.5 (default 10)',
    )  # fmt: skip
    parser.add_argument(
        '--start', metavar='TIME',
        help='time of the first row, such as 2026-02-01 or 2026-02-01T06:00Z (default 2023-11-15)',
    )  # fmt: skip
    parser.add_argument(
        '--seed', metavar='N', type=whole('a whole number', 0, None, '--seed 1'), default=1,
        help='the same seed gives the same log (default 1)',
    )  # fmt: skip
    parser.add_argument(
        '--unit', metavar='UNIT[:KEY=VALUE,...]', default='paper',
        help='the unit (default: paper)',
    )  # fmt: skip
    parser.add_argument(
        '--recording', metavar='HOW[:KEY=VALUE,...]', default='1s',
        help="how a unit other than the paper's is recorded (default: 1s)",
    )  # fmt: skip
    parser.add_argument(
        '--effect', action='append', default=[], metavar='NAME[:KEY=VALUE,...]',
        help='simulate this effect (a fault); may be given several times',
    )  # fmt: skip
    add_file(
        parser,
        '--truth',
        'also write the true values of the plant, as JSON; the log does not contain them',
    )
    parser.add_argument('--effects', action='store_true', help='list the effects, then stop')
    parser.add_argument('--overwrite', action='store_true', help='replace a log that is there')


def run(options: Namespace, console: Console) -> VerbResult:
    """Simulate and write the log."""
    if options.effects:
        return _catalogue(options.unit)
    if options.output is None:
        raise UsageError('Where to? Name the log with -o LOG.')
    check_log(options.output, overwrite=options.overwrite)
    from valveflow_ros.interface.simulate import simulate
    from valveflow_ros.logs.mcap.folder import METADATA_NAME
    from valveflow_ros.logs.mcap.importing import tells_of
    from valveflow_ros.plant.simulator import DEFAULT_START_NS

    start_ns = DEFAULT_START_NS if options.start is None else time_ns(options.start)
    console(0.0, 'simulating')
    try:
        found = simulate(
            options.days, options.seed, options.effect,
            unit=options.unit, recording=options.recording, start_ns=start_ns, progress=console,
        )  # fmt: skip
    except InputError as error:
        raise UsageError(str(error)) from None
    console(0.6, 'writing')
    log = found.write(options.output, truth=options.truth, overwrite=options.overwrite)
    data = {'log': str(log), 'rows': len(found.data), **found.to_json()}
    written = [log, log.with_name(METADATA_NAME), options.truth]
    if not (written[1].is_file() and tells_of(written[1], log.name)):
        del written[1]  # that of another recording stays as it is
    wrote = f'Wrote {listed([str(path) for path in written if path])}.'
    return VerbResult(wrote if options.quiet else f'{_text(found)}\n{wrote}', data)


def _catalogue(unit: str) -> VerbResult:
    from valveflow_ros.plant.effects import catalogue
    from valveflow_ros.plant.spec import describe
    from valveflow_ros.plant.thermal_effects import thermal_catalogue

    effects = (catalogue() if unit == 'paper' else thermal_catalogue()).values()
    data = {
        'effects': {
            e.name: {
                'summary': e.summary,
                'parameters': {
                    row.name: {'default': row.default, 'unit': row.unit, 'meaning': row.sentence}
                    for row in e.parameters
                },
            }
            for e in effects
        }
    }
    return VerbResult('\n\n'.join(describe(e) for e in effects), data)


def _text(found: Simulation) -> str:
    from valveflow_ros.plant.thermal_plant import ThermalLog
    from valveflow_ros.report.words import count, duration

    log = found.data
    days = f'{found.days:g} day{"" if found.days == 1.0 else "s"}'
    begin = f'Simulated {days} with seed {found.seed}: {count(len(log))} rows'
    if isinstance(log, ThermalLog):
        lines = [f'{begin}.', *_thermal_lines(log)]
    else:
        lines = [f'{begin}, one every {duration(log.unit.sample_period_s)}.', *_paper_lines(log)]
    lines += [f'  effect   {effect}' for effect in log.active] or ['  effects  none']
    return '\n'.join(lines)


def _paper_lines(log: SimulatedLog) -> list[str]:
    from valveflow_ros.report.words import counted, plain

    curve = log.unit.curve
    lines = [
        f'  curve    {counted(len(curve.slopes), "piece")}, slopes '
        + ', '.join(plain(float(k)) for k in curve.slopes)
        + ', ends of pieces at u = '
        + ', '.join(plain(float(k)) for k in curve.knots),
    ]
    for k, region in enumerate(log.unit.regions):
        to = f'up to {plain(region.power_to_mw)} MW' if region.power_to_mw < 1e9 else 'above'
        head = '  dynamics' if k == 0 else '          '
        times = f'time constant {region.time_constant_s:g} s, delay {region.delay_s:g} s'
        lines.append(f'{head} {times} {to}')
    return lines


def _thermal_lines(log: ThermalLog) -> list[str]:
    from valveflow_ros.report.words import plain

    unit = log.unit
    flow = 'p^m f(V)' if unit.on_opening else 'g(V p^m)'
    low, high = unit.pressure_low_mpa, unit.pressure_rated_mpa
    pressure = f'{plain(low)} to {plain(high)}' if low < high else plain(high)
    return [
        f'  unit     {unit.kind}: flow {flow}, m = {plain(unit.exponent)}, '
        f'no-load flow worth {plain(unit.no_load_mw)} MW',
        f'  boiler   {pressure} MPa, full flow empties it in {plain(unit.storage_s)} s',
        f'  dynamics valve {plain(unit.actuator_s)} s, {plain(unit.high_pressure_share)} of the '
        f'power after {plain(unit.high_pressure_s)} s, the rest behind a reheater of '
        f'{plain(unit.reheater_s)} s',
        f'  recorded {log.historian.recording}',
    ]
