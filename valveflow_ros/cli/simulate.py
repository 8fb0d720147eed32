"""``valveflow simulate``: the paper's plant, with effects."""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.report.terminal.text import number, whole

if TYPE_CHECKING:
    from valveflow_ros.plant.simulator import SimulatedLog
    from valveflow_ros.plant.spec import EffectSpec

_DESCRIPTION = """\
Simulate the unit of the paper's study: a 300 MW unit under load control, with sliding
pressure, primary-frequency pulses and noise, written down once a second. Effects make it
misbehave in a known way, to see whether that is found.

example:
  valveflow simulate -o plant.mcap --days 10 --seed 1 --effect gain_drift

"valveflow simulate --effects" lists the effects and their parameters."""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow simulate -o LOG [options]'
    parser.add_argument(
        '-o', '--output', metavar='LOG', type=Path,
        help='where to write: .mcap, .csv, .parquet, or a folder as ros2 bag makes it',
    )  # fmt: skip
    parser.add_argument(
        '--days', metavar='D', type=number('a number of days', 0, 400, '--days 10', above=True),
        default=10.0, help='how many days of operation, such as 0.5 (default 10)',
    )  # fmt: skip
    parser.add_argument(
        '--seed', metavar='N', type=whole('a whole number', 0, None, '--seed 1'), default=1,
        help='the same seed gives the same log (default 1)',
    )  # fmt: skip
    parser.add_argument(
        '--effect', action='append', default=[], metavar='NAME[:KEY=VALUE,...]',
        help='switch an effect on; may be given several times',
    )  # fmt: skip
    parser.add_argument(
        '--truth', metavar='FILE', type=Path,
        help='also write what is true of the plant, as JSON; the log itself does not tell',
    )  # fmt: skip
    parser.add_argument('--effects', action='store_true', help='list the effects, then stop')
    parser.add_argument('--overwrite', action='store_true', help='replace a log that is there')


def run(options: Namespace, console: Console) -> Outcome:
    """Simulate and write."""
    from valveflow_ros.cli.outputs import check_log, write_log
    from valveflow_ros.cli.usage import UsageError
    from valveflow_ros.errors import InputError
    from valveflow_ros.plant.spec import EffectSpec

    if options.effects:
        return _catalogue()
    if options.output is None:
        raise UsageError('Where to? Name the log with -o LOG.')
    check_log(options.output, overwrite=options.overwrite)
    console.progress(0.0, 'simulating')
    try:
        effects = [EffectSpec.parse(text) for text in options.effect]
        log = _simulated(options, effects, console)
    except InputError as error:
        raise UsageError(str(error)) from None
    console.progress(0.6, 'writing')
    written = write_log(log.table, options.output, overwrite=options.overwrite)
    truth = _truth(log, options)
    if options.truth is not None:
        _write_truth(options.truth, truth)
    return Outcome(_text(log, options, written), {'log': str(written), 'rows': len(log), **truth})


def _simulated(options: Namespace, effects: list[EffectSpec], console: Console) -> SimulatedLog:
    """Simulate day by day, which gives the same as all at once and can be watched."""
    from valveflow_ros.plant.simulator import SimulatedLog, simulate_parts

    parts: list[SimulatedLog] = []
    for part in simulate_parts(options.days, options.seed, effects=effects):
        parts.append(part)
        console.progress(min(0.6, 0.6 * len(parts) / options.days), 'simulating')
    return SimulatedLog.joined(parts)


def _write_truth(path: Path, truth: dict[str, Any]) -> None:
    from valveflow_ros.cli.files import whole_file

    with whole_file(path) as draft:
        draft.write_text(json.dumps(truth, indent=2) + '\n', encoding='utf-8')


def _catalogue() -> Outcome:
    from valveflow_ros.plant.effects import catalogue
    from valveflow_ros.plant.spec import describe

    effects = catalogue().values()
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
    return Outcome('\n\n'.join(describe(e) for e in effects), data)


def _truth(log: SimulatedLog, options: Namespace) -> dict[str, Any]:
    """Return what was simulated; infinite becomes null."""
    unit = log.unit
    regions = [
        {
            'power_to': r.power_to_mw if r.power_to_mw < 1e9 else None,
            'time_constant_s': r.time_constant_s,
            'delay_s': r.delay_s,
        }
        for r in unit.regions
    ]
    return {
        'days': options.days,
        'seed': options.seed,
        'sample_period_s': unit.sample_period_s,
        'pressure_exponent': unit.pressure_exponent,
        'pieces': [
            {'u_from': a, 'u_to': b, 'slope': k, 'intercept': c}
            for a, b, k, c in zip(
                unit.curve.knots[:-1].tolist(), unit.curve.knots[1:].tolist(),
                unit.curve.slopes.tolist(), unit.curve.intercepts.tolist(), strict=True,
            )
        ],
        'dynamics': regions,
        'effects': [{'name': e.name, 'parameters': e.parameters} for e in log.active],
    }  # fmt: skip


def _text(log: SimulatedLog, options: Namespace, written: Path) -> str:
    from valveflow_ros.report.words import count, counted, duration, plain

    curve = log.unit.curve
    lines = [
        f'Simulated {counted_days(options.days)} with seed {options.seed}: {count(len(log))} '
        f'rows, one every {duration(log.unit.sample_period_s)}.',
        f'  curve    {counted(len(curve.slopes), "piece")}, slopes '
        + ', '.join(plain(float(k)) for k in curve.slopes)
        + ', knots '
        + ', '.join(plain(float(k)) for k in curve.knots),
    ]
    for k, region in enumerate(log.unit.regions):
        to = f'up to {plain(region.power_to_mw)} MW' if region.power_to_mw < 1e9 else 'above'
        head = '  dynamics' if k == 0 else '          '
        lines.append(f'{head} T {region.time_constant_s:g} s, tau {region.delay_s:g} s {to}')
    lines += [f'  effect   {effect}' for effect in log.active] or ['  effects  none']
    lines.append(f'Wrote {written}' + (f' and {options.truth}' if options.truth else '') + '.')
    return '\n'.join(lines)


def counted_days(days: float) -> str:
    """Return '1 day', '10 days', '0.5 days'."""
    return f'{days:g} day{"" if days == 1.0 else "s"}'
