# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What was measured, read from the results of the studies: no figure of ours is typed by hand."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from docs.page_tables import table

RESULTS = Path(__file__).resolve().parent.parent / 'benchmarks' / 'results'
Row = tuple[str, str, str]


def result(name: str) -> dict[str, Any]:
    """Return the result of a study."""
    return dict(json.loads((RESULTS / f'{name}.json').read_text()))


def _row(question: str, answer: str, name: str) -> Row:
    return question, answer, f'`{result(name)["command"]}`'


def _count(number: int) -> str:
    return f'{number:,}'.replace(',', ' ')


def _lines(name: str) -> dict[str, str]:
    """Return the summary of a study that is told in lines, by what stands before the colon."""
    return dict(line.split(': ', 1) for line in result(name)['summary'])


def _total(groups: Iterable[dict[str, Any]], key: str) -> int:
    return sum(group[key] for group in groups)


_PAPER = 'paper_study_2001_2020'
_COVERAGE = {
    'coverage_9500_9699': '', 'coverage_minute_38000_38099': ' in means over a minute',
}  # fmt: skip
_RIVALS = 'compare_study_paper_1_5'
_RUN_LENGTH = 'alarm_run_length_6100_6129'
_HEALTHY, _FAULTY = 'monitor_healthy_441_448', 'monitor_all_times_3_451_453'
_HIDDEN, _NULL = 'hidden_75400_75402', 'null_75800_75899'
_PAIRS, _TRIPLES = 'pair_74600_74603', 'triple_74500_74504'
_SMALL = 'diagnosis_hidden_55340_55341_5d'
_MINUTE = 'diagnosis_hidden_minute_38200_38219_5d'
_NAMES = {
    'every second': 'thermal_names_1s_98501_98508',
    'means over a minute': 'thermal_names_minute_98601_98617',
    'compressed by exception': 'thermal_names_compressed_3301_3308',
}
_KIND_WORDS = {
    'choked': 'choked', 'sequence': 'valves in sequence', 'integrated_input': "the paper's form",
}  # fmt: skip


def _kind_words(kind: str) -> str:
    sliding = kind.removesuffix('_fixed')
    return _KIND_WORDS[sliding] + (' at fixed pressure' if sliding != kind else '')


_RECORDINGS = {
    'minute_9401_9500': 'means over a minute', '1s_5201_5210': 'every second',
    'compressed_1401_1410': 'exceptions alone',
}  # fmt: skip


def _curve() -> list[Row]:
    """Return how right the curve of the paper's plant is, and how long its partition takes."""
    said = {k: words.replace('knee', 'breakpoint') for k, words in _lines(_PAPER).items()}
    ours = result('partition')['result']['ours']
    valve = max((r for r in ours if r['kind'] == 'valve'), key=lambda r: r['samples'])
    (proof,) = result('partition_certified')['result']
    agreed = (f'the same optimum in all {proof["layers"]} layers, the plain search took '
              f'{proof["plain_wall_s"]:.0f} s')  # fmt: skip
    rivals = [
        line for line in result(_RIVALS)['summary'] if line.startswith('curve against truth')
    ]
    return [
        _row("the curve on the paper's plant, ten days, exact partition and eq. (24) alone",
             said['partition'], _PAPER),
        _row('the same with errors, regions and breakpoints refined together',
             said['published'], _PAPER),
        _row(f'one to ten pieces through {_count(valve["samples"])} samples',
             f'{valve["whole"]["wall_s"]:.1f} s, certified exact', 'partition'),
        _row(f'the same against every break, {_count(proof["samples"])} samples',
             agreed if proof['agree'] else 'not the same', 'partition_certified'),
        *(_row(f'{result(name)["summary"]["plants"]} random plants{recorded}: 95 % intervals that '
               'hold the truth', _covered(name), name) for name, recorded in _COVERAGE.items()),
        _row("the curve's error against the truth, by method",
             '; '.join(line.removeprefix('curve against truth, ') for line in rivals), _RIVALS),
    ]  # fmt: skip


def _covered(name: str) -> str:
    s = result(name)['summary']
    words = {'slope': 'slopes', 'knee': 'breakpoints', 'time_constant': 'time constants',
             'delay': 'delays'}  # fmt: skip
    return ', '.join(f'{word} {100.0 * s[k]["covered_95"]:.0f} %' for k, word in words.items())


def _slopes(s: dict[str, Any]) -> str:
    """Return the percentage of slopes of all kinds inside their 95 % interval."""
    held, of = (sum(s[kind]['slopes_held'][k] for kind in _KIND_WORDS) for k in (0, 1))
    return f'{100.0 * held / of:.0f}'


def _thermal() -> list[Row]:
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


def _alarm() -> list[Row]:
    days = [row['days_per_alarm'] for row in result(_RUN_LENGTH)['noise']]
    rows = [
        _row('days between false alarms, 30 asked for, AR(1) noise with phi 0 to 0.995',
             f'{min(days):.0f} to {max(days):.0f}', _RUN_LENGTH),
    ]  # fmt: skip
    for study, question in (
        (_HEALTHY, 'the monitor on healthy units, 20 days each, means over a minute'),
        (_FAULTY, 'the same with an effect of three times its default from day '
         '10 on, three units an effect; alarms since then'),
    ):  # fmt: skip
        told = ', '.join(
            f'{_KIND_WORDS.get(kind, "the unit of the paper")} {s["alarms"]} alarms on '
            f'{s["with_alarm"]} of {s["units"]}, {s["standing_at_the_end"]} with one at the end, '
            f'the same one at most {s["most_occurrences"]} times'
            for kind, s in result(study)['summary'].items()
        )
        rows.append(_row(question, told, study))
    for name, question in (
        ('1_441_441',
         'the same on the unit of the paper over a year in which it loses 1 MW a month'),
        ('1_471_473', 'units built from physics over 60 days in which each loses 1 MW a month'),
        ('1_vacuum_471_473', 'the same units; the model of the first ten days, with '
         'the condenser pressure, is given to the monitor'),
    ):  # fmt: skip
        worn = result(f'monitor_wear_{name}')['rows']
        told = ', '.join(f'{row["wear"]:+.2f}' for row in worn)
        alarms = sum(len(a['raised_days']) for row in worn for a in row['alarms'].values())
        words = f'{alarms} alarms' if len(worn) == 1 else f'alarms: {alarms}'
        mark = ',' if len(worn) == 1 else ';'
        told = f'{told} MW a month told{mark} {words}'
        rows.append(_row(question, told, f'monitor_wear_{name}'))
    return rows


def _diagnosis() -> list[Row]:
    rows = []
    for name, question in (
        (_HIDDEN, 'one hidden effect: named, and no other'),
        (_NULL, 'nothing wrong: nothing named, and nothing said to be unexplained'),
        ('slow_74700_74703',
         'a slow change of 1 to 2 % in a shape that no cause has (two steps, fouling, late '
         'drift, drift then wash, random walk, two changes over hours; an offset that switches '
         'may be named): told as a change in time, and nothing named'),
        ('confounded_47300_47303', 'two causes that look alike'),
        (_PAIRS, 'two causes at once: both named'),
        (_TRIPLES, 'three causes at once: all named'),
        ('outside_74300_74302',
         "effects outside the catalogue, with a quarter of the noise's sd: none named"),
        ('outside_74350_74352',
         "effects outside the catalogue, with 0.15 of the noise's sd: none named"),
    ):  # fmt: skip
        r = result(f'diagnosis_{name}_5d')
        text = f'{r["right"]} of {r["records"]}'
        if name.startswith('outside'):
            wrong = r['named_with_confidence_wrongly']
            text += f' said to be unexplained, {wrong} named with confidence'
        if name.startswith(('hidden', 'pair', 'triple')):
            text += f' ({_bends(r)})' + _at_best(r)
        rows.append(_row(question, text, f'diagnosis_{name}_5d'))
    r = result(_SMALL)
    silent = sum(not row['names'] for row in r['rows'])
    beside = r['records'] - r['right'] - silent
    healthy = [_of_healthy_units(words, name) for words, name in _NAMES.items()]
    return [
        *rows,
        _row(
            'one hidden effect of 1 to 1.5 times the smallest detectable size',
            f'named in {r["right"]} of {r["records"]}, none named in {silent}, another one in '
            f'{beside}; in {sum(map(_listed, r["rows"]))} of these the true one is listed as not '
            'told apart from it', _SMALL,
        ),
        _in_minutes(),
        _learners(),
        *healthy,
        _since_model(),
    ]  # fmt: skip


def _of_healthy_units(words: str, name: str) -> Row:
    """Return what is named in healthy units built from physics."""
    days = 'five' if '--days 5' in result(name)['command'] else 'eight'
    kinds = result(name)['summary'].items()
    named = ', '.join(f'{_kind_words(k)} {s["named"]} of {s["units"]} named' for k, s in kinds)
    names = sorted({n for _, s in kinds for n in s['names']})
    return _row(
        f'healthy units built from physics, {words}, {days} days, no covariate',
        named + (f': {", ".join(names)}' if names else ''), name,
    )  # fmt: skip


def _at_best(r: dict[str, Any]) -> str:
    """Return what was told where the true causes show, and the gain against that of the truth."""
    best = r.get('visible_at_best')
    if best is None:
        return ''
    share = best['share']
    return (
        f'; right but for one name whose true one is listed as not told apart from it: '
        f'{sum(map(_listed, r["rows"]))} more; where each true cause gains at least 8 in '
        f'log-likelihood beside the others: {best["right"]} of {best["records"]} right, in '
        f'{best["wrong_and_likelier"]} of the others what was named fits better than the truth; '
        f'in records answered rightly, reduction of the squared error on held-out blocks relative '
        f'to that by the true causes: median {share["median"]:.2f}, one in ten below '
        f'{share["worst_tenth"]:.2f}'
    )


def _listed(row: dict[str, Any]) -> bool:
    """Return True if one name is wrong and the right one stands beside it."""
    true, names = set(row['label'].split('+')), set(row['names'])
    missed = true - names
    return (
        len(missed) == 1 == len(names - true) and not row['right']
        and missed <= set(row['not_told_apart'])
    )  # fmt: skip


def true_causes() -> list[tuple[float, bool, bool]]:
    """Return every true cause of the studies of one (also a small one), two and three causes.

    Returns
    -------
    list of tuple
        Its size relative to its standard error, which is the root of twice the log-likelihood
        that it gains beside the other true causes; whether it was named; whether it was named or
        listed as not told apart from a name.
    """
    out = []
    large = (f'diagnosis_{study}_5d' for study in (_HIDDEN, _PAIRS, _TRIPLES))
    for study in (_SMALL, *large):
        for row in result(study)['rows']:
            told = set(row['names'])
            if 'curve_change' in told:
                told.add('curve_shape')  # a bend is also a change of the curve
            for name, gain in row['best']['each'].items():
                listed = name in told or name in row['not_told_apart']
                out.append((math.sqrt(2.0 * max(gain, 0.0)), name in told, listed))
    return out


def _in_minutes() -> Row:
    """Return what means over a minute tell of an effect of the temperature and of a backlash."""
    found = result(_MINUTE)
    warm = found['table']['temperature']
    held, of = warm['covered'].split('/')
    slack = [r['rejected'].get('backlash', '') for r in found['rows'] if r['label'] == 'backlash']
    unseen = sum(why.startswith('cannot be judged at this sampling') for why in slack)
    return _row(
        'means over a minute: an effect of the temperature, and a backlash',
        f'the first named in {warm["right"]} of {warm["records"]}, its interval right in {held} '
        f'of {of}; the second cannot be judged at this sampling in {unseen} of {len(slack)}',
        _MINUTE,
    )  # fmt: skip


def _learners() -> Row:
    """Return how the extended model compares with learners that know no cause."""
    named = result('learners_35000_35000')['named']
    best, less = named['at_least_as_good_as'], named['median_reduction']
    return _row(
        f'the extended model of {named["records"]} records with a named effect, against a '
        'Gaussian process and gradient boosting that learn the residual, on blocks kept out',
        f'at least as good in {best["gaussian_process"]} and {best["boosting"]}; median reduction '
        f'of the error {100.0 * less["extended"]:.1f} %, {100.0 * less["gaussian_process"]:.1f} % '
        f'and {100.0 * less["boosting"]:.1f} %', 'learners_35000_35000',
    )  # fmt: skip


def _bends(study: dict[str, Any]) -> str:
    """Return in how many of the records with a bend of the curve everything was named."""
    bends = [row['right'] for row in study['rows'] if 'curve_shape' in row['label']]
    return (
        f'{sum(bends)} of the {len(bends)} with a bend of the curve, told as a bend or as a '
        'change since the model given'
    )


def _since_model() -> Row:
    """Return how well a diagnosis tells what changed since the model that it is given."""
    name = 'reference_26201_26203'
    kinds = list(result(name)['summary'].values())
    of = {what: [s[what] for s in kinds] for what in kinds[0]}
    one = [s for what in ('gain', 'offset', 'input') for s in of[what]]
    held, told = (sum(int(s['intervals_hold'].split()[k]) for s in one) for k in (0, 2))
    right, tried = (
        [_total(group, key) for group in (one, of['curve'], of['none'])]
        for key in ('right', 'records')
    )
    return _row(
        'a unit changed by 1 to 4 % since the model given was found (four kinds of plant, means '
        'over a minute, six days)',
        f'gain, zero or input named rightly in {right[0]} of {tried[0]} (otherwise mostly '
        f'silent), the interval right in {held} of {told}; another curve told in {right[1]} of '
        f'{tried[1]}; no change told in {right[2]} of {tried[2]} unchanged units', name,
    )  # fmt: skip


def _loops() -> list[Row]:
    told = result('refinery_valves')
    simulated = told['simulated']['all']
    sticky, sound = (simulated['verdict'][key] for key in ('sticky', 'sound'))
    shares = [f'{100 * s["found"]:.0f} % found, {100 * s["falsely_named"]:.0f} % false'
              for s in (simulated['verdict'], simulated['horch'])]  # fmt: skip
    rows = [_row(
        f'`valveflow loop` from command and process value, {sticky} sticking and {sound} sound '
        'simulated loops', f"{shares[0]} ({shares[1]} by Horch's test)", 'refinery_valves',
    )]  # fmt: skip
    if isinstance(told['measured'], dict):
        ours, horch = (told['measured']['per_valve'][k] for k in ('verdict', 'horch'))
        counts = [f'{s["found"] * s["sticky"]:.0f} of {s["sticky"]} found, '
                  f'{s["falsely_named"] * s["sound"]:.0f} of {s["sound"]} false'
                  for s in (ours, horch)]  # fmt: skip
        rows.append(
            _row('the same on valves of a refinery, known while the method was made',
                 f"{counts[0]}, {ours['open']} not judged ({counts[1]} by Horch's test, which "
                 'names a level valve by set-point steps alone)',
                 'refinery_valves')
        )  # fmt: skip
    levels = told['simulated']['horch_on_levels']
    rows.append(_row(
        "Horch's test on simulated sound level loops whose set point changes; its author does not "
        'apply it to them', f'sticking in {levels["named"]} of {levels["loops"]}',
        'refinery_valves',
    ))  # fmt: skip
    return rows


def _programs() -> list[Row]:
    """Return how fast the steps are, what a fleet costs beside its work and what it survives."""
    days = result('ten_days')
    steps = {step['step']: step for step in days['steps']}
    values = steps['read MCAP']['what'].replace(',', ' ')
    info = result('reading')['results']
    speed, faults = result('fleet_speed'), result('fleet_faults')
    tiny = max(r['wall_ms_per_task'] for r in result('fleet_scheduling')['runs'])
    beside = speed['beside_work_ms_per_task'] + tiny
    same = 'identical' if faults['identical'] else 'not identical'
    return [
        _row(f'ten days, {values}: read from MCAP', f'{steps["read MCAP"]["wall_s"]:.1f} s',
             'ten_days'),
        _row('the same: read, aligned, segmented, fitted and reported, in a process that has '
             'compiled and loaded everything', f'{days["total_wall_s"]:.0f} s, of which '
             f'{steps["fit"]["wall_s"]:.0f} s the fit', 'ten_days'),
        _row(f'`valveflow info` on {_count(info["file"]["messages"])} messages, '
             'with a start of its own', f'{info["info mcap"]["wall_s"]:.1f} s', 'reading'),
        _row(f'a log of a fleet, {speed["cpu_s_per_task"]:.1f} s of processor time: needed beside '
             'the work', f'{beside:.0f} ms', 'fleet_speed'),
        _row(f'{faults["logs_compared"]} logs on two workers, {faults["workers_killed"]} workers '
             f'killed, {faults["broken_logs"]} broken logs, the command killed after '
             f'{faults["command_killed_after_tasks"]}',
             f'{faults["rows_of_broken_logs"]} rows with a sentence, results {same} to those of '
             'an undisturbed run', 'fleet_faults'),
        _killed(),
    ]  # fmt: skip


def _killed() -> Row:
    """Return what a kill of the monitor costs."""
    lost = result('torture_kill9')['measured']['most_lost_s']
    return _row(
        'a monitor is killed (kill -9) 200 times', f'at most {lost:.2f} s of data were lost',
        'torture_kill9',
    )  # fmt: skip


def measured() -> str:
    """Return what the studies found, with the command of each."""
    rows = [*_curve(), *_thermal(), *_alarm(), *_diagnosis(), *_loops(), *_programs()]
    return table(('question', 'answer', 'measured by'), rows)


def results() -> str:
    """Return what a reader of the README asks first."""
    slope, knee = re.findall(r'error median (\S+) worst', _lines(_PAPER)['published'])[:2]
    thermal = result('thermal_curves_minute_9401_9500')['summary']
    errors = [thermal[kind]['error_mw'] for kind in _KIND_WORDS]
    medians = [e['median'] for e in errors]
    healthy, faulty = (result(name)['summary'] for name in (_HEALTHY, _FAULTY))
    physics = [healthy[kind] for kind in healthy if kind != 'paper']
    tried, found, stood = (
        _total(faulty.values(), key) for key in ('units', 'with_alarm', 'standing_at_the_end')
    )
    hidden, null = (result(f'diagnosis_{n}_5d') for n in (_HIDDEN, _NULL))
    plants = result('naming')['summary']['valveflow']['plants']
    named = [of for plant, of in plants.items() if plant.startswith('physics')]
    valves = result('refinery_valves')['measured']['per_valve']['verdict']
    loops = result('refinery_valves')['simulated']['all']['verdict']
    rows = [
        ('the curve on the plant of the paper, ten days, median of 20 runs',
         f'largest slope error {slope} (the paper, on its one record: 0.008), largest '
         f'breakpoint error {knee} units of u (the paper: 36)'),
        ('95 % intervals that contain the true value, 200 random plants',
         _covered(next(iter(_COVERAGE)))),
        (f'the curve on {_total((thermal[k] for k in _KIND_WORDS), "units")} units built from '
         'physics, means over a minute',
         'root mean square error at the weather of the same days '
         f'{min(medians):.2f} to {max(medians):.2f} MW in the median, '
         f'{max(e["largest"] for e in errors):.2f} MW for the worst unit; the right form in '
         f'{_total((thermal[k] for k in _KIND_WORDS), "right_axis")}; {_slopes(thermal)} % of the '
         '95 % intervals of slopes contain the true value'),
        ('alarms in 20 days: healthy units, and units in which an effect of three times its '
         'default size begins on day 10',
         f'{healthy["paper"]["alarms"]} false ones in {20 * healthy["paper"]["units"]} days on '
         f'the plant of the paper, {_total(physics, "alarms")} in '
         f'{20 * _total(physics, "units")} days on units built from physics, on '
         f'{_total(physics, "with_alarm")} of {_total(physics, "units")} units; the effect raised '
         f'one in {found} of {tried} runs, still active on day 20 in {stood}'),
        ("plants of the paper's kind, five days: healthy, and with one hidden effect of 2 to 3 "
         'times the detection limit',
         f'nothing named in {sum(not r["names"] for r in null["rows"])} of {null["records"]}; '
         f'the effect named, and no other, in {hidden["right"]} of {hidden["records"]} '
         f'({_bends(hidden)}), another name with '
         f'confidence in {hidden["named_with_confidence_wrongly"]} of these'),
        ('units built from physics, with an effect or healthy: [a benchmark](docs/naming.md)',
         f'right answers in {_total(named, "right")} of {_total(named, "records")}, a wrong or '
         f'further name in {_total(named, "wrong")}'),
        ('valves of a refinery, each by all its records of command and process value (real data)',
         f'{valves["found"] * valves["sticky"]:.0f} of {valves["sticky"]} found, '
         f'{valves["falsely_named"] * valves["sound"]:.0f} of {valves["sound"]} sound ones '
         f'named, {valves["open"]} not judged; on simulated loops '
         f'{100.0 * loops["found"]:.0f} % found, {100.0 * loops["falsely_named"]:.0f} % of '
         'the sound ones named'),
        _killed()[:2],
    ]  # fmt: skip
    return table(('question', 'answer'), rows)


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

    def share(c: dict[str, Any], count: str = 'right', of: str = 'records') -> str:
        low, high = (100.0 * end for end in c['interval'])
        return f'{c[count]} of {c[of]} ({low:.0f} to {high:.0f} %)' if c[of] else 'none given'

    def onset(s: dict[str, Any]) -> str:
        e = s['onset_hours']
        words = f'{e["median_error"]:.2g} h, {e["largest_error"]:.2g} h' if e['given'] else ''
        return words or 'none given'

    rows = [
        *(line(words, lambda s, k=kind: share(s['kinds'][k])) for kind, words in _NAMING.items()),
        *(line(f'{words}: right', lambda s, p=place: share(s['plants'][p]))
          for place, words in _NAMING_PLANTS.items()),
        line('all: right', lambda s: share(s['all'])),
        *(line(f'all: {words}', lambda s, k=key: str(s['all'][k]))
          for key, words in (('wrong', 'a wrong name'), ('silent', 'wrongly silent'),
                             ('unknown', 'wrongly "unknown"'))),
        *(line(words, lambda s, k=key: share(s[k], 'held', 'given'))
          for key, words in (('size', 'intervals of sizes that hold the truth'),
                             ('onset_hours', 'intervals of onsets that do'))),
        line('error of the onset, median and largest', onset),
    ]  # fmt: skip
    return table(('of the sealed set', *methods), rows)


def acts() -> str:
    """Return what other programs did to a running monitor, what it claimed, and what is there."""
    rows = [
        (name.replace('_', ' '), str(act['runs']), _count(act['claimed']), _count(act['found']),
         str(act['false']))
        for name, act in result('torture_adversary')['counts']['acts'].items()
    ]  # fmt: skip
    head = ('act, among others', 'runs', 'messages claimed', 'found', 'runs with a false claim')
    return table(head, rows)


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
