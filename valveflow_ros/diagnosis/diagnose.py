# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Create a diagnosis from a record and a model."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import DAY_S, Estimate, FittedCause, SentenceValues, told
from valveflow_ros.diagnosis.causes import catalogue, causes_for
from valveflow_ros.diagnosis.causes.changes import LEAST_SWITCHES
from valveflow_ros.diagnosis.causes.since_model import CURVE, SINCE_MODEL, Change, since_model
from valveflow_ros.diagnosis.evidence import (
    LARGEST_P,
    Certainty,
    Gain,
    by_segment,
    chances_over,
    gain_of_form,
    inferred,
    more_or_less,
    noise_floor,
    rmse,
    sealed_gain,
    where_largest,
)
from valveflow_ros.diagnosis.extended import Extended, answer
from valveflow_ros.diagnosis.fitting import (
    Task,
    improve,
    search_levels,
    search_lines,
    search_onsets,
)
from valveflow_ros.diagnosis.grids import ORDER, CovariateRows, Grids, make_grids
from valveflow_ros.diagnosis.loop import actuator
from valveflow_ros.diagnosis.record_faults import Fault, faults
from valveflow_ros.diagnosis.result import (
    NAMED,
    NOTHING,
    UNEXPLAINED,
    Diagnosis,
    Disturbance,
    NamedCause,
)
from valveflow_ros.diagnosis.screening import Screening
from valveflow_ros.diagnosis.search import (
    Progress,
    SearchResult,
    add_of_family,
    in_place_of,
    put_in_place_of,
    search,
    simplified,
)
from valveflow_ros.diagnosis.slow import (
    ANOTHER_SHAPE,
    LEAST_DRIFT_MW,
    LEVELS,
    NO_SHAPE,
    OF_WANDER,
    Course,
    Drift,
    courses,
    drift,
    of_causes,
)
from valveflow_ros.diagnosis.structure import (
    Period,
    Structure,
    Wander,
    likelier_over_hours,
    period,
    structure,
    wander,
)
from valveflow_ros.errors import DataError, counted, listed
from valveflow_ros.numerics import each_in_threads
from valveflow_ros.records import BoolArray, FloatArray, IntArray, SampleTable
from valveflow_ros.signals.compression import Compression
from valveflow_ros.signals.static_form import StaticForm

# The sealed blocks are a test set, used only to confirm: the gain of each cause on them.
#
# A cause found on the open blocks is named only if the sealed blocks, to which nothing was
# fitted, confirm it at the 5 % level.


def confirm(found: SearchResult) -> None:
    """Remove causes that the sealed blocks do not confirm, the least likely first.

    One that fitted nearly as well is tried there in the place of each; the chance counts all of
    them.
    """
    while found.model.active:
        chances = _chances(found)
        worst = max(chances)
        if worst[0] <= LARGEST_P:
            return
        name = found.model.active[chances.index(worst)].name
        found.refuted.add(name)
        why = (
            'blocks of time that were kept out of the search do not confirm it (a gain as large '
            f'there has a chance of {worst[0]:.2g})'
        )
        if not _confirmed_instead(found, name, why):
            found.withdraw(name, why)


def _confirmed_instead(found: SearchResult, name: str, why: str) -> bool:
    """Replace a refuted cause by one that fitted nearly as well, if the sealed blocks confirm it.

    Return True if they do.
    """
    causes = causes_for(found.task.grids)
    concealed = {f for a in found.model.active if a.name != name for f in a.cause.conceals}
    near = {
        n for n in found.near.get(name, ())
        if n not in (*found.refuted, *found.model.names) and causes[n].family not in concealed
        and (found.task.fixed_dynamics or not causes[n].of_model)
    }  # fmt: skip
    if not near:
        return False
    without, rivals = in_place_of(found, name, near)
    rivals = [r for r in rivals if r.added.name in near]
    tested = len(found.model.active) + len(near)
    for rival in rivals:
        gain = sealed_gain(found.task, without, rival.model, found.tried, tested)
        if gain.p_value <= LARGEST_P and put_in_place_of(found, name, rival, rivals, without, why):
            return True
    return False


def steps(found: SearchResult) -> list[Extended]:
    """Return the models with one more cause each, fitted to the open blocks."""
    models = [found.plain]
    for k in range(1, len(found.model.active)):
        part = replace(found.model, active=found.model.active[:k])
        models.append(improve(found.task, part, 2)[0])
    return models + ([found.model] if found.model.active else [])


def gains_of(found: SearchResult, models: list[Extended]) -> list[Gain]:
    """Return the gain of each cause on the sealed blocks over the model with the earlier ones.

    Its chance is that of its gain over the model with all others: without them it may explain
    little, because what they leave is larger than its own effect.
    """
    gains = each_in_threads(
        lambda pair: sealed_gain(found.task, *pair, found.tried), list(itertools.pairwise(models))
    )
    if len(gains) < 2:
        return gains
    return [
        replace(gain, p_value=chance)
        for gain, (chance, _) in zip(gains, _chances(found), strict=True)
    ]


def _chances(found: SearchResult) -> list[tuple[float, float]]:
    """Return the chance of a gain as large on sealed blocks, of each cause beside the others.

    All causes that were tested there count for the smallest chance, one less for the next, and so
    on (Holm, Scand. J. Stat. 6, 1979); refuted ones come last. The second number of each cause is
    its chance alone: of equal chances the larger one is the least likely cause.
    """
    task, model = found.task, found.model
    without = each_in_threads(found.without, model.names)
    most = len(model.active) + len(found.refuted)
    table = chances_over(task, without, model, found.tried, most)
    order = np.argsort(table[:, 0])
    counted = table[order, most - 1 - np.arange(len(order))]
    together = np.empty(len(order))
    together[order] = np.maximum.accumulate(counted)
    return list(zip(together.tolist(), table[:, 0].tolist(), strict=True))


# Causes found without the model of the unit: in the actuator and in the record.

_BETWEEN = 'Between the commanded and the measured opening: '
_SLACK = (
    'After each reversal the valve moves only when the command has moved by {w_percent:.2g} %.'
)


def actuator_cause(found: SearchResult) -> tuple[NamedCause, ...]:
    """Return the fault between command and position sensor, with its size in MW of power."""
    grids = found.task.grids
    fault = actuator.judge(grids)
    if fault is None or fault.name in found.model.names:
        return ()
    cause = catalogue()[fault.name]
    units = {u.name: u.unit for u in cause.unknowns}
    base = found.model.base
    x = base.static(grids.u[grids.usable > 0], grids.scale[grids.usable > 0])
    rise = float(np.ptp(x) / max(np.ptp(grids.u[grids.usable > 0]), 1e-9))
    per_percent = rise * float(np.nanmean(grids.density))
    gain = Gain(fault.rms_before * per_percent, fault.rms_after * per_percent, fault.p_value)
    values = {k: v for k, (v, _, _) in fault.parameters.items()}
    return (
        NamedCause(
            fault.name,
            _BETWEEN
            + (
                _SLACK.format(**values)
                if 'w_percent' in values
                else cause.sentence(SentenceValues(values))
            ),
            {k: Estimate(*v, units[k]) for k, v in fault.parameters.items()},
            gain,
            cause.experiment,
        ),
    )


def record_causes(
    raw: Grids | None, found: SearchResult, wrong: tuple[Fault, ...]
) -> tuple[NamedCause, ...]:
    """Return faults of the record as causes; "before" is the RMSE with the invalid rows."""
    if raw is None:
        return ()
    before = rmse(replace(found.task, grids=raw), found.model, raw.sealed_rows)
    after = rmse(found.task, found.model, found.task.grids.sealed_rows)
    gain = Gain(before, after, float('nan'))
    out = []
    for name in dict.fromkeys(f.name for f in wrong):
        mine = [f for f in wrong if f.name == name]
        parameters = {k: v for f in mine for k, v in _fault_parameters(f).items()}
        out.append(NamedCause(name, ' '.join(f.sentence for f in mine), parameters, gain))
    return tuple(out)


def _fault_parameters(fault: Fault) -> dict[str, Estimate]:
    unknown = float('nan')
    unit = 's' if fault.name == 'flatline' else fault.signal.unit
    return {
        f'{fault.signal.topic}_rows': Estimate(float(fault.rows), unknown, unknown, 'rows'),
        f'{fault.signal.topic}_size': Estimate(fault.size, unknown, unknown, unit),
    }


def notes(grids: Grids) -> tuple[str, ...]:
    """Return what cannot be judged without a command, and what the recording may imitate."""
    said = []
    if why := actuator.hindered(grids):
        said.append(f'Faults between command and position sensor cannot be judged: {why}.')
    blur = grids.blur
    if blur.words:
        said.append(
            f'The record hides lags and delays below {blur.time_s:.0f} s and a slack of the valve '
            f'below {blur.opening_percent:.2g} %; a misfit that depends on ramps or on the travel '
            'of the valve may come from that.'
        )
    return tuple(said)


_LEAST_SPREAD = 0.01
_FAR_MORE = 8.0
_OWN_MISFIT = 0.004  # of the range of the power
# Root mean square, of the same range. The valves, the turbine and the sensors of a unit built from
# physics are no lags and straight pieces. 0.001 was fixed on units with numbers 88001 to 88040,
# by a worse fit without the cause; two true exponents of `benchmarks.diagnosis_study` explained
# 0.00096 (67311 and 67502).
_LEAST_EXPLAINED = 0.0007
# A slack shows at reversals only, where the straight pieces of a healthy valve matter less: fixed
# on the sets 88001 and 89001 of `benchmarks.naming`, where false ones explained up to 0.0003.
_LEAST_SLACK = 0.0004
_BEND = 'curve_shape'
# By this much intervals must exceed a slow disturbance, which looks much the same: on the seeds
# 55320 to 62703 of `benchmarks.diagnosis_study` true ones did by 8 to 50, one found in noise not.
_LEAST_INTERVALS = 4.0
_MOST_LEVELS = 2  # causes that change the level in time; more of them imitate any slow change
_FAMILIES = ('drift', 'step')  # families of causes that are also shapes
_LEAST_SHAPE = 5.0  # the same for a shape over a slow disturbance without a shape
_LAST_STEPS = 10  # breakpoints converge slowly near a bump
_FULL_LOAD = 0.9  # quantile of the power
# Part of a slow disturbance that a temperature may contain, as 95 % limit: fixed on units with
# numbers 1401 to 1406.
_AGREES = 0.1
# The same of the error of the form, which healthy plants have, as a part of the range of power,
# for units built from physics in means over a minute: fixed on the units 4101 to 4112.
_AGREES_OWN = 0.0003
_ACTS = 0.05  # fraction of the largest change below which there is no effect


def quiet(_share: float, _what: str) -> None:
    """Show no progress."""


@dataclass(frozen=True, slots=True)
class Record:
    """The record to be diagnosed.

    Attributes
    ----------
    table : SampleTable
    step_s : float
        Step of its rows.
    form : StaticForm
        Of the model.
    settle_s : float
        Time after a gap until the model is valid.
    spans_ns : int64 (k, 2)
        First and last time of special segments.
    measured : SampleTable, optional
        The rows as measured, if causes were removed from ``table``. Signal faults are searched for
        in these (a constant opening due to backlash is not a transmitter fault).
    compression : Compression, optional
        How the record was compressed, if it was.
    covariates : tuple of CovariateRows
        Columns beside the signals that the power may follow, on the rows of the table.
    """

    table: SampleTable
    step_s: float
    form: StaticForm
    settle_s: float
    spans_ns: IntArray
    measured: SampleTable | None = None
    compression: Compression | None = None
    covariates: tuple[CovariateRows, ...] = ()

    def faults(self) -> tuple[BoolArray, tuple[Fault, ...]]:
        """Return which values are invalid, shape (n, 5), and the faults."""
        table = self.table if self.measured is None else self.measured
        return faults(table, self.step_s, self.compression is not None)

    def grids(self, bad: BoolArray, rough: bool = False) -> Grids:
        """Return the record on the grids of a diagnosis; values marked in ``bad`` are left out."""
        return make_grids(*self.about, bad, rough, self.compression, self.covariates)

    @property
    def about(self) -> tuple[SampleTable, float, StaticForm, float]:
        """Return the first arguments of `make_grids`."""
        return self.table, self.step_s, self.form, self.settle_s


@dataclass(frozen=True, slots=True)
class _Rest:
    """What the final residual still contains."""

    wander: Wander
    structure: Structure
    period: Period
    drift: Drift
    own_misfit: str = ''
    course: Course | None = None
    start_ns: int = 0

    @property
    def disturbance(self) -> Disturbance | None:
        """Return the slow disturbance of the power; None if there is none."""
        slow, course = self.drift, self.course
        if course is not None:
            scale_s = slow.time_scale_s if slow.there else self.wander.time_scale_s
            words = course_words(course, self.start_ns)
            return Disturbance(course.rms_mw, scale_s, course.rms_mw, words)
        if slow.there:
            return Disturbance(slow.rms_mw, slow.time_scale_s, slow.rms_mw)
        if self.wander.there:
            return Disturbance(self.wander.rms_mw, self.wander.time_scale_s)
        return None


def diagnose(
    record: Record, model: RegionalModel, given: bool = False, progress: Progress = quiet
) -> Diagnosis:
    """Find the errors of the simulation, name the cause, extend the model, measure the gain.

    Parameters
    ----------
    record : Record
    model : RegionalModel
        Curve and dynamics: those identified from this record, or those of an earlier one.
    given : bool
        The model comes from elsewhere: its dynamics and number of pieces are kept, and any
        difference from them is a finding. Otherwise they are fitted to the record.

    Raises
    ------
    TooFewSamplesError
        The record is too short or has too many gaps.
    DataError
        The valve hardly moves.
    """
    progress(0.02, 'the record itself')
    bad, wrong = record.faults()
    grids, rough = record.grids(bad), record.grids(bad, rough=True)
    _moves(grids)
    task = Task(grids, grids.open_rows, np.zeros(ORDER), given)
    since = first = since_model(task, model) if given else ''
    start = since.changed if isinstance(since, Change) else None
    start = start or Extended(model if given else simplified(model))
    found = search(task, start, progress, rough, earlier_curve=given)
    if isinstance(since, Change) and since.name == CURVE and _BEND in found.model.names:
        # Is a bend the whole change of the curve, or only its largest part?
        left = since_model(task, model, found.model.active)
        if isinstance(left, Change) and left.name == CURVE and not left.near:
            found = search(task, start, progress, rough, earlier_curve=False)
        else:
            since = left
    progress(0.7, 'the sealed blocks')
    confirm(found)
    _withdraw_imitations(found)
    _withdraw_small(found)
    _date(found)
    progress(0.8, 'what is left')
    course = _course(found)
    rest = replace(_look_again(found), course=course, start_ns=found.task.grids.start_ns)
    rest = _withdraw(found, rest)
    _withdraw_small(found)  # what a withdrawn cause left to another one may be less
    _, dropped = _verdict(found, rest)
    if _BEND not in found.model.names or dropped:
        since = first  # what was left beside a bend holds only beside it
    if given and found.model.active and not dropped:
        # Their mean effect on the record hides or imitates a change before it.
        since = since_model(task, model, found.model.active)
        if isinstance(since, Change) and since.name == CURVE and _BEND in found.model.names:
            since = ''  # the bend is that change
    return _conclude(record, found, rest, wrong, since, progress)


def diagnose_form(
    record: Record, model: RegionalModel, asked: Record, found_model: RegionalModel,
    progress: Progress = quiet,
) -> Diagnosis:  # fmt: skip
    """Diagnose a record whose static power has another form than the given model.

    The form is the first cause; the others are searched for in the form selected by the data.

    Parameters
    ----------
    record, model
        The given form and model.
    asked, found_model
        The same rows in the form selected by the data, and a model of it found in them.

    Raises
    ------
    TooFewSamplesError, DataError
        As `diagnose`.
    """
    found = diagnose(asked, found_model, progress=progress)
    bad, _ = record.faults()
    before, after = record.grids(bad), asked.grids(bad)
    plain = Task(before, before.open_rows, np.zeros(ORDER)), Extended(model)
    better = Task(after, after.open_rows, np.zeros(ORDER)), found.simulation
    gain = gain_of_form(*plain, *better)
    words = record.form.words, asked.form.words
    nan = float('nan')
    cause = NamedCause(
        'form',
        f'The static power has another form than the model: it follows {words[1]}, not '
        f'{words[0]}.' + (_AT_OPENINGS if asked.form.scaled else ''),
        {'exponent': Estimate(asked.form.exponent, nan, nan, ''),
         'offset_mw': Estimate(found.final.base.offset, nan, nan, 'MW')},
        gain,
        'Move the pressure by a tenth at two openings, each held.',
    )  # fmt: skip
    verdict = NAMED if found.verdict == NOTHING else found.verdict
    result = replace(
        found, verdict=verdict, causes=(cause, *found.causes), rmse_simulation=gain.rmse_before
    )
    return replace(result, sentence=_sentence(result))


_AT_OPENINGS = ' The breakpoints of this valve are at fixed openings.'


def _moves(grids: Grids) -> None:
    """Raise if the valve hardly moves."""
    low, high = np.quantile(grids.u[grids.usable > 0], (0.01, 0.99))
    if high - low < _LEAST_SPREAD * abs(high):
        raise DataError(
            f'The valve hardly moves: u stays between {low:.4g} and {high:.4g}. A diagnosis needs '
            'several loads.'
        )


def _wandering(grids: Grids, screening: Screening, slow: Wander) -> FloatArray | None:
    """Return the slow disturbance in MW for every mean; None if there is none."""
    return slow.level[grids.sub] * screening.here if slow.there else None


def _look_again(found: SearchResult) -> _Rest:
    """Test the residual of the model with all causes."""
    screening = Screening(found.task, found.model)
    slow = wander(screening)
    level = _wandering(found.task.grids, screening, slow)
    left = structure(found.task, found.model, screening, level)
    own = _own_misfit(found, left)
    if own:
        left = replace(left, there=False)
    slowly = drift(found.task, found.model)
    return _Rest(slow, left, period(found.task, found.model), slowly, own)


def _course(found: SearchResult, again: bool = True) -> Course | None:
    """Return the shape of a change in time that the causes do not explain; None if there is none.

    Causes in time are removed if another shape, or a slow disturbance without a shape, fits better
    than all of them together: a step plus a drift can imitate nearly any slow change.
    """
    names = [name for name in found.model.names if name in LEVELS]
    if names == ['curve_step']:
        names = []  # a single curve_step also depends on the load
    if len(names) > _MOST_LEVELS:
        for name in names:
            found.withdraw(name, _SO_MANY, found.model.without(name))
        found.model, _ = improve(found.task, found.model, 3)
        names = []
    tried = courses(found.task, found.model, names, found.task.grids.whole)
    if not tried:
        return None
    mine = of_causes(found.model, names) if names else ()
    best = max((c for c in tried.values() if c.name not in mine), key=lambda c: c.score)
    if names:
        better = best.score - max(tried[shape].score for shape in mine)
        if better <= _largest_lead(names, best.name):
            if better > 0.0 and best.name != NO_SHAPE:
                words = course_words(best, found.task.grids.start_ns)
                found.other_shape = (
                    f'Instead of {listed(names)} the power may change in time {words}: this fits '
                    'the data a little better, but not by enough to decide.'
                )
            return None
        families = {catalogue()[name].family for name in names}
        for name in names:
            found.withdraw(name, _OF_SHAPE[best.name], found.model.without(name))
        found.model, _ = improve(found.task, found.model, 3)
        other_family = again and best.name in _FAMILIES and best.name not in families
        if other_family and add_of_family(found, best.name):
            # The causes of another family hid those of this shape.
            confirm(found)
            _withdraw_imitations(found)
            _date(found)
            return _course(found, again=False)
    least_mw = LEAST_DRIFT_MW * found.task.grids.size
    if best.score - tried[NO_SHAPE].score < _LEAST_SHAPE or best.rms_mw <= least_mw:
        return None
    return best


def _largest_lead(names: list[str], shape: str) -> float:
    """Return by how much a shape may fit better than causes that are named all the same."""
    if 'intervals' in names and shape == NO_SHAPE:
        return -_LEAST_INTERVALS
    return ANOTHER_SHAPE if len(names) == 1 else 0.0


_OF_SHAPE = {
    NO_SHAPE: OF_WANDER,
    'drift': 'the power changes evenly in time, which fits better',
    'step': 'the power changes once, which fits better',
    'late drift': 'a drift that begins within the record fits better',
    'exponential': 'a change that slows down fits better',
    'drift and step': 'a drift with a step fits better',
    'drift and back': 'a drift that ends at once fits better',
    'there and back': 'a change that is undone later fits better',
    'two steps': 'two steps in time fit better',
    'drift and two steps': 'a drift with two steps fits better',
}
_SO_MANY = 'so many changes in time together would imitate any slow change'


def course_words(course: Course, start_ns: int) -> str:
    """Return words for how the power changes in time, in MW and UTC."""
    mw = [f'{size:+.{1 if abs(size) >= 1.0 else 2}f} MW' for size in course.mw]
    at = [told(start_ns, s, _COURSE_STEP_S) for s in course.at_s]
    if course.spread_s:
        at[-1] += f', within about {course.spread_s / 3600.0:.0f} h' + ' each' * (len(at) > 1)
    if course.name == 'drift':
        return f'evenly, {mw[0]} over the record'
    if course.name == 'step':
        return f'by {mw[0]} about {at[0]}'
    if course.name == 'late drift':
        return f'evenly from about {at[0]} on, {mw[0]} by the end of the record'
    if course.name == 'exponential':
        hours = course.at_s[0] / 3600.0
        time = f'{hours:.0f} h' if hours < _DAYS_FROM_H else f'{hours / 24.0:.1f} days'
        return (
            f'fast at first and then slower, by {mw[0]} by the end of the record, with a time '
            f'constant of {time}'
        )
    if course.name == 'drift and step':
        return f'evenly, {mw[0]} over the record, and by {mw[1]} about {at[0]} besides'
    if course.name == 'drift and back':
        return f'evenly, {mw[0]} until about {at[0]}, and then back at once'
    if course.name == 'there and back':
        return f'by {mw[0]} from about {at[0]} to {at[1]}'
    if course.name == 'drift and two steps':
        return (
            f'evenly, {mw[0]} over the record, and besides by {mw[1]} about {at[0]} and by '
            f'{mw[2]} about {at[1]}'
        )
    return f'by {mw[0]} about {at[0]} and by {mw[1]} about {at[1]}'


_COURSE_STEP_S = 3600
_DAYS_FROM_H = 48.0


def _date(found: SearchResult) -> None:
    """Fit the onsets and hidden states of the model to all blocks.

    The open blocks alone would place a change inside a sealed block at the wrong end of it. The
    hours between that and the true time would look like a misfit or a slow disturbance. Only the
    times of changes are taken from the sealed blocks.
    """
    every = replace(found.task, rows=found.task.grids.whole)
    everywhere = np.ones(every.grids.subs, dtype=bool)
    found.model = inferred(every, search_onsets(every, found.model), everywhere)
    for a in found.model.active:
        if a.cause.infer is not None and len(a.extra) < LEAST_SWITCHES:
            found.withdraw(a.name, 'it is switched on only once: a change that is undone')


def _own_misfit(found: SearchResult, left: Structure) -> str:
    """Return a note on a structure error of the model that is too small to be a fault; else ''.

    A real area curve is smooth, a turbine has more than one lag, and means over a minute do not
    show the lag. The resulting small error is visible in records of days. It is not a fault.
    """
    size = float(np.sqrt(left.explained_mw2)) if left.there else 0.0
    if not 0.0 < size < _own_size(found.task):
        return ''
    return (
        f'Straight pieces and the dynamics of the model leave {size:.2g} MW (root mean square) '
        f'that depends on {" and ".join(left.variables)}.'
    )


def _withdraw_imitations(found: SearchResult) -> None:
    """Remove causes in time if the load of hours before explains the power about as well."""
    for a in found.model.active:
        if not a.cause.slow:
            continue
        without = found.without(a.name)
        effect = answer(found.task.grids, found.model) - answer(found.task.grids, without)
        if likelier := likelier_over_hours(found.task, without, effect, a.size):
            found.withdraw(a.name, f'the {likelier} explains the power about as well', without)


def _withdraw_small(found: SearchResult) -> None:
    """Remove causes that explain no more than a healthy plant differs from its model.

    That is more with a given model whose form or recording is known to leave such an error.
    """
    own = _own_size(found.task) if found.task.fixed_dynamics else 0.0
    for a in found.model.active:
        name, why = a.name, 'a healthy plant differs from its model'
        share = _LEAST_SLACK if a.cause.family == 'slack' else _LEAST_EXPLAINED
        least = share * _range(found.task)
        if own > least:
            least, why = own, 'a model found in another record may be off'
        if a.cause.covariate is None and _explained(found, name) < least**2:
            found.withdraw(name, f'it explains less than {least:.2g} MW, by which {why}')


def _own_size(task: Task) -> float:
    """Return the expected error of the model form or the recording, MW; 0 if there is none."""
    if not (task.grids.form.scaled or task.grids.blur.words):
        return 0.0
    return _OWN_MISFIT * _range(task)


def _range(task: Task) -> float:
    """Return the range of the power, MW."""
    power = task.grids.power[task.grids.scored]
    return float(np.ptp(np.quantile(power, (0.005, 0.995))))


def _withdraw(found: SearchResult, rest: _Rest) -> _Rest:
    """Remove causes in time if the power has a slow disturbance throughout the record.

    A cause stays if it explains far more than that disturbance.
    """
    slow = rest.disturbance
    if slow is None:
        return rest
    before = found.model
    for a in before.active:
        if a.cause.slow and not _explained(found, a.name) > _FAR_MORE * slow.rms_mw**2:
            shape = NO_SHAPE if rest.course is None else rest.course.name
            found.withdraw(a.name, _OF_SHAPE[shape], found.model.without(a.name))
    withdrawn = found.model is not before
    if not withdrawn:
        return replace(rest, drift=drift(found.task, found.model))
    found.model, _ = improve(found.task, found.model, 3)
    # The effect that these causes explained now belongs to the slow change, which was measured
    # beside them.
    course = _course(found, again=False)
    return replace(_look_again(found), course=course, start_ns=rest.start_ns)


def _explained(found: SearchResult, name: str) -> float:
    """Return the reduction of the mean square of the residual by a cause, MW^2."""
    rows = found.task.rows
    without = found.without(name)
    left, more = (found.task.residual(m)[rows] for m in (found.model, without))
    return float(np.mean(more**2) - np.mean(left**2))


def _final(found: SearchResult) -> tuple[Task, Extended]:
    """Fit the extended model to all blocks, including the sealed ones."""
    task = replace(found.task, rows=found.task.grids.whole)
    everywhere = np.ones(task.grids.subs, dtype=bool)
    # Before the fit: states that are wrong in the sealed blocks would make their effect too small.
    model, cost = improve(task, inferred(task, found.model, everywhere), _LAST_STEPS)
    model, cost = search_levels(task, model, cost)
    model, _ = search_lines(task, model, cost)
    return task, inferred(task, model, everywhere)


def _meaning(task: Task, model: Extended, cause: FittedCause) -> str:
    """Return a sentence with the effect of a cause at full load, relative to the model without it.

    For a step this is the value after minus before, for a drift the end minus the beginning, for
    intervals the difference between the two states.
    """
    grids, whole = task.grids, task.grids.whole
    without = answer(grids, model.without(cause.name))
    moved, power = (answer(grids, model) - without)[whole], without[whole]
    full = float(np.quantile(power, _FULL_LOAD))
    where, high = f'At full load (from {full:.0f} MW on)', power >= full
    day = grids.means(grids.time_s)[whole] / DAY_S
    onset = next((cause.named()[u.name] for u in cause.cause.unknowns if u.dated), None)
    days = grids.reference.span_s / DAY_S
    level, reach = _worth(cause, moved[high], day[high], onset, days)
    if not np.isfinite(level):
        return ''
    most = float(np.ptp(np.quantile(moved, (0.01, 0.99))))
    if not max(abs(level), reach) > _ACTS * most:
        return f'{where} the power is not changed, at other loads by up to {most:.2g} MW.'
    if not level:
        return f'{where} the power changes by up to {reach:.2g} MW.'
    said = f'{where} this makes {more_or_less(level)}'
    if cause.cause.slow and onset is None and not cause.extra and cause.name != 'diurnal':
        said += ' at the end of the record than at its beginning'
    largest = where_largest(
        power, level, lambda rows: _worth(cause, moved[rows], day[rows], onset, days)[0]
    )
    return f'{said}{largest}.'


def _worth(
    cause: FittedCause, moved: FloatArray, day: FloatArray, onset: float | None, days: float
) -> tuple[float, float]:
    """Return the signed MW of a cause (0 if it has both signs) and its largest size."""
    reach = float(np.quantile(np.abs(moved), 0.95))
    if onset is not None:
        after = day >= onset
        if after.all() or not after.any():
            return math.nan, reach
        return float(moved[after].mean() - moved[~after].mean()), reach
    if cause.extra:
        low, high = np.quantile(moved, (0.01, 0.99)).tolist()
        return math.copysign(high - low, next(iter(cause.values))), reach
    if cause.cause.slow and cause.name != 'diurnal':
        if np.ptp(day) < 0.5:
            return math.nan, reach
        return float(np.polyfit(day, moved, 1)[0]) * days, reach
    one_sided = np.ptp(np.sign(moved)) == 0.0
    return float(moved.mean()) if one_sided else 0.0, reach


def _conclude(
    record: Record, found: SearchResult, rest: _Rest, wrong: tuple[Fault, ...],
    since: Change | str, progress: Progress,
) -> Diagnosis:  # fmt: skip
    grids = found.task.grids
    models = steps(found)
    gains = gains_of(found, models)
    task, final = _final(found)
    progress(0.9, 'how sure it is')
    estimates = Certainty(task, final).intervals() if final.active else {}
    if 'temperature' in estimates:
        estimates['temperature'] = _with_what_agrees(found, rest, estimates['temperature'])
    place = final.place_words(grids.form)
    sentences = {
        a.name: a.sentence(grids.start_ns, estimates[a.name], place) for a in final.active
    }
    causes = tuple(
        NamedCause(
            a.name, sentences[a.name], estimates[a.name], gain,
            a.cause.experiment,
            tuple(n for n in found.near.get(a.name, ()) if n not in final.names), a.extra,
            _meaning(task, final, a),
        )
        for a, gain in zip(final.active, gains, strict=True)
    )  # fmt: skip
    raw = record.grids(np.zeros(record.table.values.shape, dtype=bool)) if wrong else None
    in_actuator, in_record = actuator_cause(found), record_causes(raw, found, wrong)
    changed, alike = (since, '') if isinstance(since, Change) else (None, since)
    earlier = () if changed is None else (changed.cause(found.task, models[0]),)
    verdict, dropped = _verdict(found, rest, bool(earlier + in_actuator), bool(in_record))
    near = tuple(dict.fromkeys(n for c in earlier + causes for n in c.not_told_apart))
    if verdict == UNEXPLAINED:
        near = tuple(dict.fromkeys((*(c.name for c in causes), *near)))
    causes = () if dropped else causes
    unexplained, unexplained_mw = _unexplained(rest)
    simulation = models[0] if changed is None else changed.given.without_causes()
    extended = models[0] if dropped else models[-1]
    before, after = (rmse(found.task, m, grids.sealed_rows) for m in (simulation, extended))
    explained = rest.structure.explained_mw2 if rest.structure.there else 0.0
    result = Diagnosis(
        verdict=verdict, sentence='', causes=earlier + causes + in_actuator + in_record,
        not_told_apart=near, experiments=_experiments(earlier + causes),
        disturbance=rest.disturbance,
        unexplained_by=unexplained, unexplained_mw=unexplained_mw,
        rejected=tuple(found.reasons.items()),
        rmse_simulation=before, rmse_extended=after,
        rmse_noise_floor=noise_floor(found.task, models[-1], explained),
        segments=by_segment(found.task, simulation, models[-1], record.spans_ns),
        simulation=simulation, extended=extended,
        final=final.without_causes() if dropped else final,
        reference=grids.reference, mean_s=grids.mean_s,
        notes=tuple(
            note for note in (
                *notes(grids), *_of_covariates(models[-1]), rest.own_misfit, alike,
                '' if dropped else found.other_shape,
            ) if note
        ),
    )  # fmt: skip
    return replace(result, sentence=_sentence(result))


def _of_covariates(model: Extended) -> list[str]:
    """Return the meaning of the parameters of each covariate that was named."""
    told = []
    for about in (a.cause.covariate for a in model.active):
        if about is not None:
            told.append(
                f'{about.name}: b is its effect in MW for each {about.unit or "unit"} of '
                f'{about.column}, at the mean load of {about.power_mw:.0f} MW. a1 and a2 (MW) are '
                'no effect of it: with L = load / mean load they correct the curve by a1 (L - 1) '
                '+ a2 (L - 1)^2, because column and load may have changed together by chance.'
            )
    return told


def _with_what_agrees(
    found: SearchResult, rest: _Rest, k: dict[str, Estimate]
) -> dict[str, Estimate]:
    """Return the size of a temperature effect with the error by what agrees with it a little.

    A condenser that is not in the log follows the load with a lag, as the temperature of the
    steam does: the size contains this part of the slow disturbance. The same holds for the error
    of the form of the model, or of the recording.
    """
    slow = _AGREES * rest.drift.rms_mw if rest.drift.there else 0.0
    own = _AGREES_OWN * _range(found.task) if _own_size(found.task) else 0.0
    error = math.hypot(slow, own) / math.sqrt(max(_explained(found, 'temperature'), 1e-12))
    return {
        name: replace(
            e,
            low=e.value - math.hypot(e.value - e.low, error * e.value),
            high=e.value + math.hypot(e.high - e.value, error * e.value),
        )
        for name, e in k.items()
    }


def _verdict(
    found: SearchResult, rest: _Rest, otherwise_named: bool = False, record_wrong: bool = False
) -> tuple[str, bool]:
    """Return the verdict, and whether the names must be removed.

    If the remaining structure exceeds what the causes explain, they are only approximate. Faults
    of the record, whose rows are left out, explain no change in time of the others.
    """
    structure = rest.structure.explained_mw2 if rest.structure.there else 0.0
    left = max(structure, rest.period.variance_mw2 if rest.period.there else 0.0)
    if left > 0.0:
        rows = found.task.rows
        own = float(
            np.mean(found.task.residual(found.plain)[rows] ** 2)
            - np.mean(found.task.residual(found.model)[rows] ** 2)
        )
        if not found.model.active or left > own:
            return UNEXPLAINED, bool(found.model.active)
    if found.model.active or otherwise_named:
        return NAMED, False
    if rest.course is not None:
        return UNEXPLAINED, False
    return (NAMED if record_wrong else NOTHING), False


_THE_TIME = 'the time'
# Variables of `structure` in words of a plant engineer; the others are such words already.
_IN_WORDS = {
    'u': 'opening and pressure (u)', 'pressure given u': 'the pressure at one u',
    'ramp': 'how far the valve moved in the last 3 min',
    'slow ramp': 'how far the valve moved in the last 15 min',
    'pressure change': 'how far the pressure moved in the last 10 min',
    'temperature change': 'how far the temperature moved in the last 20 min',
    'valve travel': 'how much the valve moves to and fro',
    'travel of the last hour': 'how much the valve moved in the last hour',
}  # fmt: skip


def _unexplained(rest: _Rest) -> tuple[tuple[str, ...], float]:
    """Return what the rest depends on, and the root mean square of that without the time, MW."""
    course, structure = rest.course, rest.structure
    names, variance = (
        (structure.variables, structure.explained_mw2) if structure.there else ((), 0.0)
    )
    if course is not None:
        # A large change in time also shows in variables that correlate with time by chance.
        if course.rms_mw**2 < structure.explained_mw2:
            names = (*names, _THE_TIME)
        else:
            names, variance = (_THE_TIME,), 0.0
    if rest.period.there:
        names, variance = (*names, rest.period.words), variance + rest.period.variance_mw2
    return names, math.sqrt(variance)


def _experiments(causes: tuple[NamedCause, ...]) -> tuple[str, ...]:
    return tuple(c.experiment for c in causes if c.not_told_apart)


def _nearly(names: tuple[str, ...]) -> str:
    """Return a sentence on the causes that cannot be distinguished from a named one."""
    fit = 'fits' if len(names) == 1 else 'fit'
    return f' Not certain: {listed(names)} {fit} these data nearly as well.' if names else ''


def _sentence(d: Diagnosis) -> str:
    """Return the verdict as sentences for an operator."""
    wander = '' if d.disturbance is None else f' {d.disturbance.sentence}'
    if d.verdict == NAMED:
        drifts = d.disturbance is not None and d.disturbance.drift_mw is not None
        told = (c.sentence + _nearly(c.not_told_apart) for c in d.causes)
        return ' '.join(told) + (wander if drifts else '')
    blind = [name for name, reason in d.rejected if 'cannot be judged' in reason]
    unseen = 'could not be checked with this record'
    if d.verdict == NOTHING:
        slow = '' if d.disturbance is None else 'a slow disturbance and '
        but = f', {len(blind)} {unseen}' if blind else ''
        return (
            f'No cause was found: {len(catalogue()) - len(blind)} were checked{but}. The '
            f'remaining difference between model and measurement is {slow}noise.{wander}'
        )
    but = f' {counted(len(blind), "cause")} {unseen}.' if blind else ''
    alike = ', '.join(d.not_told_apart)
    near = f' These would look alike here: {alike}.' if alike else ''
    first = ''.join(f'{c.sentence} ' for c in d.causes if c.name in SINCE_MODEL)
    besides = ''.join(
        f' Found besides: {c.sentence}' for c in d.causes if c.name not in SINCE_MODEL
    )
    if d.unexplained_by == (_THE_TIME,):
        return f'{first}{wander.strip()}{but}{besides}'
    names = listed([_IN_WORDS.get(n, n) for n in d.unexplained_by if n != _THE_TIME])
    return (
        f'{first}Measured and simulated power {"still " if first else ""}differ by '
        f'{d.rmse_extended:.2g} MW (root mean square). Of this about '
        f'{d.unexplained_mw:.2g} MW depends on {names}, and no cause of the catalogue explains '
        f'it.{wander}{near}{but}{besides}'
    )
