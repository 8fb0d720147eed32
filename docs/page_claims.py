# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What was measured, read from the results of the studies: no figure of ours is typed by hand."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from docs.page_tables import table

RESULTS = Path(__file__).resolve().parent.parent / 'benchmarks' / 'results'


def result(name: str) -> dict[str, Any]:
    """Return the result of a study."""
    return dict(json.loads((RESULTS / f'{name}.json').read_text()))


def _row(question: str, answer: str, name: str, command: str = '') -> tuple[str, str, str]:
    return question, answer, f'`{command or result(name)["command"]}`'


def _count(number: int) -> str:
    return f'{number:,}'.replace(',', ' ')


def _paper() -> list[tuple[str, str, str]]:
    study = result('paper_study_2001_2020')
    said = dict(line.split(': ', 1) for line in study['summary'])
    return [
        _row("the curve on the paper's plant, ten days, exact partition and eq. (24) alone",
             said['partition'].replace('knee', 'breakpoint'), 'paper_study_2001_2020'),
        _row('the same with errors, regions and breakpoints refined together',
             said['published'].replace('knee', 'breakpoint'), 'paper_study_2001_2020'),
    ]  # fmt: skip


def _partition() -> list[tuple[str, str, str]]:
    ours = result('partition')['result']['ours']
    valve = max((r for r in ours if r['kind'] == 'valve'), key=lambda r: r['samples'])
    (proof,) = result('partition_certified')['result']
    return [
        _row(f'one to ten pieces through {_count(valve["samples"])} samples',
             f'{valve["whole"]["wall_s"]:.1f} s, certified exact', 'partition'),
        _row(f'the same against every break, {_count(proof["samples"])} samples',
             f'the same optimum in all {proof["layers"]} layers, the plain search took '
             f'{proof["plain_wall_s"]:.0f} s' if proof['agree'] else 'not the same',
             'partition_certified'),
    ]  # fmt: skip


def _coverage() -> list[tuple[str, str, str]]:
    name = 'coverage_9500_9699'
    s = result(name)['summary']
    held = ', '.join(
        f'{word} {100.0 * s[key]["covered_95"]:.0f} %'
        for key, word in (('slope', 'slopes'), ('knee', 'breakpoints'),
                          ('time_constant', 'time constants'), ('delay', 'delays'))
    )  # fmt: skip
    return [_row(f'{s["plants"]} random plants: 95 % intervals that hold the truth', held, name)]


def _rivals() -> list[tuple[str, str, str]]:
    name = 'compare_study_paper_1_5'
    lines = [line for line in result(name)['summary'] if line.startswith('curve against truth')]
    return [
        _row("the curve's error against the truth, by method",
             '; '.join(line.removeprefix('curve against truth, ') for line in lines), name),
    ]  # fmt: skip


_KIND_WORDS = {
    'choked': 'choked', 'sequence': 'valves in sequence', 'integrated_input': "the paper's form",
}  # fmt: skip
_RECORDINGS = {
    'minute_701_800': 'means over a minute', '1s_701_730': 'every second',
    'compressed_701_730': 'exceptions alone',
}  # fmt: skip


def _slopes(s: dict[str, Any]) -> str:
    """Return the percentage of slopes of all kinds inside their 95 % interval."""
    held, of = (sum(s[kind]['slopes_held'][k] for kind in _KIND_WORDS) for k in (0, 1))
    return f'{100.0 * held / of:.0f}'


def _thermal() -> list[tuple[str, str, str]]:
    """Return how right curves are on units built from physics."""
    rows = []
    for name, recorded in _RECORDINGS.items():
        s = result(f'thermal_curves_{name}')['summary']
        units = next(iter(s.values()))['units']
        errors = ', '.join(
            f'{words} {s[kind]["error_mw"]["median"]:.2f}, {s[kind]["error_mw"]["p90"]:.2f}, '
            f'{s[kind]["error_mw"]["largest"]:.2f} MW'
            for kind, words in _KIND_WORDS.items()
        )
        right = sum(s[kind]['right_axis'] for kind in _KIND_WORDS)
        rows.append(_row(
            f'{units} units of each kind built from physics, sliding pressure, eight days as '
            f'{recorded}: error of the curve (median, nine of ten, largest), axis, 95 % intervals '
            'of slopes that contain the true value',
            f'{errors}; the right axis on {right} of {units * len(_KIND_WORDS)}; {_slopes(s)} %',
            f'thermal_curves_{name}',
        ))  # fmt: skip
    return rows


def _alarm() -> list[tuple[str, str, str]]:
    name = 'alarm_run_length_6100_6129'
    days = [row['days_per_alarm'] for row in result(name)['noise']]
    rows = [
        _row('days between false alarms, 30 asked for, AR(1) noise with phi 0 to 0.995',
             f'{min(days):.0f} to {max(days):.0f}', name),
    ]  # fmt: skip
    for study, question in _MONITOR.items():
        told = ', '.join(
            f'{_KIND_WORDS.get(kind, "the unit of the paper")} {s["alarms"]} alarms on '
            f'{s["with_alarm"]} of {s["units"]}, {s["standing_at_the_end"]} with one at the end, '
            f'the same one at most {s["most_occurrences"]} times'
            for kind, s in result(study)['summary'].items()
        )
        rows.append(_row(question, told, study))
    name = 'monitor_wear_1_441_441'
    (worn,) = result(name)['rows']
    rows.append(_row(
        'the same on the unit of the paper over a year in which it loses 1 MW a month',
        f'{worn["wear"]:+.2f} MW a month told, '
        f'{sum(len(a["raised_days"]) for a in worn["alarms"].values())} alarms', name,
    ))  # fmt: skip
    for name, question in (
        ('monitor_wear_1_471_473', 'units built from physics over 60 days in which each loses '
         '1 MW a month'),
        ('monitor_wear_1_vacuum_471_473', 'the same units; the model of the first ten days, with '
         'the condenser pressure, is given to the monitor'),
    ):  # fmt: skip
        worn = result(name)['rows']
        told = ', '.join(f'{row["wear"]:+.2f}' for row in worn)
        alarms = sum(len(a['raised_days']) for row in worn for a in row['alarms'].values())
        rows.append(_row(question, f'{told} MW a month told; alarms: {alarms}', name))
    return rows


_MONITOR = {
    'monitor_healthy_441_448': 'the monitor on healthy units, 20 days each, means over a minute',
    'monitor_all_times_3_451_453': 'the same with an effect of three times its default from day '
    '10 on, three units an effect; alarms since then',
}


def _diagnosis() -> list[tuple[str, str, str]]:
    rows = []
    for name, question in (
        ('diagnosis_hidden_27000_27005_5d', 'one hidden effect: named, and no other'),
        ('diagnosis_null_29000_29149_5d', 'nothing wrong: nothing named'),
        (
            'diagnosis_slow_29000_29009_5d',
            'a slow change of 1 to 2 % in a shape that no cause has (two steps, fouling, late '
            'drift, drift then wash, random walk, two changes over hours; an offset that switches '
            'may be named): told as a change in time, and nothing named',
        ),
        ('diagnosis_confounded_29000_29003_5d', 'two causes that look alike'),
        ('diagnosis_pair_29000_29003_5d', 'two causes at once: both named'),
        ('diagnosis_triple_30000_30003_5d', 'three causes at once: all named'),
        ('diagnosis_outside_29000_29002_5d', 'effects outside the catalogue: none named'),
    ):
        r = result(name)
        if name.startswith('diagnosis_outside'):
            wrong = r['named_with_confidence_wrongly']
            text = (
                f'{r["right"]} of {r["records"]} said to be unexplained, {wrong} named with '
                'confidence'
            )
        else:
            text = f'{r["right"]} of {r["records"]}'
        rows.append(_row(question, text, name))
    return [*rows, _small(), _healthy_names(), _since_model()]


def _small() -> tuple[str, str, str]:
    """Return what is said of effects that are hardly detectable."""
    name = 'diagnosis_hidden_30000_30002_5d'
    r = result(name)
    silent = sum(not row['names'] for row in r['rows'])
    beside = r['records'] - r['right'] - silent
    return _row(
        'one hidden effect of 1 to 1.5 times the smallest detectable size',
        f'named in {r["right"]} of {r["records"]}, none named in {silent}, another one named in '
        f'{beside}; in {beside - r["named_with_confidence_wrongly"]} of these the true one is '
        'told as possible too', name,
    )  # fmt: skip


def _healthy_names() -> tuple[str, str, str]:
    name = 'thermal_names_minute_801_825'
    counts = ', '.join(
        f'{_KIND_WORDS[kind]} {s["named"]} of {s["units"]} named'
        for kind, s in result(name)['summary'].items()
    )
    return _row(
        'healthy units built from physics, means over a minute, eight days, no covariate', counts,
        name,
    )  # fmt: skip


def _since_model() -> tuple[str, str, str]:
    """Return how well a diagnosis tells what changed since the model that it is given."""
    name = 'reference_26101_26105'
    kinds = list(result(name)['summary'].values())
    of = {what: [s[what] for s in kinds] for what in kinds[0]}
    one = [s for what in ('gain', 'offset', 'input') for s in of[what]]
    held, told = (sum(int(s['intervals_hold'].split()[k]) for s in one) for k in (0, 2))
    right, tried = (
        [sum(s[key] for s in group) for group in (one, of['curve'], of['none'])]
        for key in ('right', 'records')
    )
    text = (
        f'gain, zero or input named rightly in {right[0]} of {tried[0]} (otherwise mostly '
        f'silent), the interval right in {held} of {told}; another curve told in {right[1]} of '
        f'{tried[1]}; no change told in {right[2]} of {tried[2]} unchanged units'
    )
    return _row(
        'a unit changed by 1 to 4 % since the model given was found (four kinds of plant, means '
        'over a minute, six days)', text, name,
    )  # fmt: skip


def _loops() -> list[tuple[str, str, str]]:
    told = result('refinery_valves')
    simulated, horch = (told['simulated']['all'][k] for k in ('verdict', 'horch'))

    def words(s: dict[str, Any]) -> str:
        return f'{100 * s["found"]:.0f} % found, {100 * s["falsely_named"]:.0f} % false'

    rows = [_row(
        f'`valveflow loop` from command and process value, {simulated["sticky"]} sticking and '
        f'{simulated["sound"]} sound simulated loops',
        f"{words(simulated)} ({words(horch)} by Horch's test)", 'refinery_valves',
    )]  # fmt: skip
    if isinstance(told['measured'], dict):
        ours, horch = (told['measured']['per_valve'][k] for k in ('verdict', 'horch'))
        counts = [f'{s["found"] * s["sticky"]:.0f} of {s["sticky"]} found, '
                  f'{s["falsely_named"] * s["sound"]:.0f} of {s["sound"]} false'
                  for s in (ours, horch)]  # fmt: skip
        rows.append(
            _row('the same on valves of a refinery, known while the method was made',
                 f"{counts[0]}, {ours['open']} not judged ({counts[1]} by Horch's test)",
                 'refinery_valves')
        )  # fmt: skip
    return rows


def _fleet() -> list[tuple[str, str, str]]:
    """Return what a fleet costs beside its work, and what it survives."""
    speed, faults = result('fleet_speed'), result('fleet_faults')
    tiny = max(r['wall_ms_per_task'] for r in result('fleet_scheduling')['runs'])
    beside = speed['beside_work_ms_per_task'] + tiny
    return [
        _row(f'a log of a fleet, {speed["cpu_s_per_task"]:.1f} s of processor time: needed beside '
             'the work', f'{beside:.0f} ms', 'fleet_speed'),
        _row(f'{faults["logs_compared"]} logs on two workers, {faults["workers_killed"]} workers '
             f'killed, {faults["broken_logs"]} broken logs, the command killed after '
             f'{faults["command_killed_after_tasks"]}',
             f'{faults["rows_of_broken_logs"]} rows with a sentence, results '
             + ('identical' if faults['identical'] else 'not identical')
             + ' to those of an undisturbed run', 'fleet_faults'),
    ]  # fmt: skip


def _speed() -> list[tuple[str, str, str]]:
    name = 'ten_days'
    steps = {step['step']: step for step in result(name)['steps']}
    values = steps['read MCAP']['what'].replace(',', ' ')
    info = result('reading')
    return [
        _row(f'ten days, {values}: read from MCAP', f'{steps["read MCAP"]["wall_s"]:.1f} s', name),
        _row('the same: read, aligned, segmented, fitted and reported, in a process that has '
             'compiled and loaded everything', f'{result(name)["total_wall_s"]:.0f} s, of which '
             f'{steps["fit"]["wall_s"]:.0f} s the fit', name),
        _row(f'`valveflow info` on {_count(info["results"]["file"]["messages"])} messages, '
             'with a start of its own',
             f'{info["results"]["info mcap"]["wall_s"]:.1f} s', 'reading'),
    ]  # fmt: skip


_NAMING = {
    'hidden': 'an effect with a name: named, and nothing else',
    'healthy': 'healthy: nothing named',
    'outside': 'an effect without a name: said to be there, not named',
}
_NAMING_PLANTS = {
    'paper, 1s': "the paper's plant, every second", 'paper, minute': "the paper's plant, means",
    'physics, 1s': 'built from physics, every second', 'physics, minute': 'the same, means',
}  # fmt: skip


def naming() -> str:
    """Return how the methods come out in the benchmark for naming causes."""
    methods = result('naming')['summary']

    def line(words: str, of: Callable[[dict[str, Any]], str]) -> tuple[str, ...]:
        return words, *(of(s) for s in methods.values())

    def share(c: dict[str, Any], count: str, of: str) -> str:
        low, high = (100.0 * end for end in c['interval'])
        return f'{c[count]} of {c[of]} ({low:.0f} to {high:.0f} %)' if c[of] else 'none given'

    rows = [line(words, lambda s, k=kind: share(s['kinds'][k], 'right', 'records'))
            for kind, words in _NAMING.items()]  # fmt: skip
    rows += [
        *(line(f'{words}: right', lambda s, p=place: share(s['plants'][p], 'right', 'records'))
          for place, words in _NAMING_PLANTS.items()),
        line('all: right', lambda s: share(s['all'], 'right', 'records')),
        *(line(f'all: {words}', lambda s, k=key: str(s['all'][k]))
          for key, words in (('wrong', 'a wrong name'), ('silent', 'wrongly silent'),
                             ('unknown', 'wrongly "unknown"'))),
        *(line(words, lambda s, k=key: share(s[k], 'held', 'given'))
          for key, words in (('size', 'intervals of sizes that hold the truth'),
                             ('onset_hours', 'intervals of onsets that do'))),
        line('error of the onset, median and largest', _onset),
    ]  # fmt: skip
    return table(('of the sealed set', *methods), rows)


def _onset(scored: dict[str, Any]) -> str:
    s = scored['onset_hours']
    return f'{s["median_error"]:.2g} h, {s["largest_error"]:.2g} h' if s['given'] else 'none given'


def acts() -> str:
    """Return what other programs did to a running monitor, what it claimed, and what is there."""
    rows = [
        (name.replace('_', ' '), str(act['runs']), _count(act['claimed']), _count(act['found']),
         str(act['false']))
        for name, act in result('torture_adversary')['counts']['acts'].items()
    ]  # fmt: skip
    head = ('act, among others', 'runs', 'messages claimed', 'found', 'runs with a false claim')
    return table(head, rows)


def results() -> str:
    """Return what a reader of the README asks first, with the command of each."""
    said = dict(line.split(': ', 1) for line in result('paper_study_2001_2020')['summary'])
    slope, knee = re.findall(r'error median (\S+) worst', said['published'])[:2]
    thermal = result('thermal_curves_minute_701_800')['summary']
    errors = [thermal[kind]['error_mw'] for kind in _KIND_WORDS]
    units = sum(thermal[kind]['units'] for kind in _KIND_WORDS)
    medians = [e['median'] for e in errors]
    healthy, faulty = (result(name)['summary'] for name in _MONITOR)
    physics = [healthy[kind] for kind in healthy if kind != 'paper']
    tried, found, stood = (
        sum(s[key] for s in faulty.values())
        for key in ('units', 'with_alarm', 'standing_at_the_end')
    )
    hidden, null = (
        result(f'diagnosis_{n}_5d') for n in ('hidden_27000_27005', 'null_29000_29149')
    )
    valves = result('refinery_valves')['measured']['per_valve']['verdict']
    loops = result('refinery_valves')['simulated']['all']['verdict']
    rows = [
        _row('the curve on the plant of the paper, ten days, median of 20 runs',
             f'largest slope error {slope} (the paper, on its one record: 0.008), largest '
             f'breakpoint error {knee} units of u (the paper: 36)', 'paper_study_2001_2020'),
        ('95 % intervals that contain the true value, 200 random plants', *_coverage()[0][1:]),
        _row(f'the curve on {units} units built from physics, means over a minute',
             f'error {min(medians):.2f} to {max(medians):.2f} MW in the median, '
             f'{max(e["largest"] for e in errors):.2f} MW at most; {_slopes(thermal)} % of the '
             '95 % intervals of slopes contain the true value',
             'thermal_curves_minute_701_800'),
        _row('false alarms on healthy units, 20 days each',
             f'{healthy["paper"]["alarms"]} in {20 * healthy["paper"]["units"]} days on the plant '
             f'of the paper, {sum(s["alarms"] for s in physics)} in '
             f'{20 * sum(s["units"] for s in physics)} days on units built from physics',
             next(iter(_MONITOR))),
        _row('an effect of three times its default size begins on day 10',
             f'an alarm in {found} of {tried} runs; on day 20 it is still active in {stood}',
             list(_MONITOR)[1]),
        _row("one hidden effect in plants of the paper's kind, 2 to 3 times the detection limit",
             f'named, and no other, in {hidden["right"]} of {hidden["records"]}; another name '
             f'with confidence in {hidden["named_with_confidence_wrongly"]}',
             'diagnosis_hidden_27000_27005_5d'),
        _row("healthy plants of the paper's kind, five days",
             f'nothing named in {null["right"]} of {null["records"]}',
             'diagnosis_null_29000_29149_5d'),
        _row('units built from physics, with an effect or healthy: [a benchmark](docs/naming.md)',
             _on_physics(), 'naming'),
        _row('sticking valves of a refinery, from command and process value (real data)',
             f'{valves["found"] * valves["sticky"]:.0f} of {valves["sticky"]} found, '
             f'{valves["falsely_named"] * valves["sound"]:.0f} of {valves["sound"]} sound ones '
             f'named, {valves["open"]} not judged; on simulated loops '
             f'{100.0 * loops["found"]:.0f} % found, {100.0 * loops["falsely_named"]:.0f} % of '
             'the sound ones named', 'refinery_valves'),
        _killed(),
    ]  # fmt: skip
    return table(('question', 'answer'), [row[:2] for row in rows])


def _on_physics() -> str:
    """Return the outcome of the naming benchmark on units built from physics."""
    plants = result('naming')['summary']['valveflow']['plants']
    physics = [of for plant, of in plants.items() if plant.startswith('physics')]
    right, wrong, all_ = (sum(p[key] for p in physics) for key in ('right', 'wrong', 'records'))
    return f'right answers in {right} of {all_}, a wrong or further name in {wrong}'


def _killed() -> tuple[str, str, str]:
    """Return what a kill of the monitor costs."""
    lost = result('torture_kill9')['measured']['most_lost_s']
    return _row(
        'a monitor is killed (kill -9) 200 times', f'at most {lost:.2f} s of data were lost',
        'torture_kill9',
    )  # fmt: skip


def measured() -> str:
    """Return what the studies found, with the command of each."""
    rows = [*_paper(), *_partition(), *_coverage(), *_rivals(), *_thermal(), *_alarm(),
            *_diagnosis(), *_loops(), *_speed(), *_fleet(), _killed()]  # fmt: skip
    return table(('question', 'answer', 'measured by'), rows)


def installed() -> str:
    """Return what an installation of the wheel takes, by Python and set of libraries."""
    names = ('numpy', 'scipy', 'pandas', 'numba')
    kept = result('install')
    rows = (
        (
            row['python'], ', '.join(row['versions'][name] for name in names),
            f'{row["install_s"]:.0f} s', f'{row["size_mb"]} MB',
            f'{row["first_identify_s"]:.0f} s', f'{row["second_identify_s"]:.1f} s',
        )
        for row in kept['results']
    )  # fmt: skip
    head = ('Python', 'NumPy, SciPy, pandas, Numba', 'installed in', 'size', 'first `identify`',
            'second')  # fmt: skip
    where = f'{kept["cpus"]} processors with a load average of {kept["load_average"]}'
    return f'{table(head, rows)}\nMeasured on {where}.\n'
