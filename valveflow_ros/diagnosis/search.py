# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Selection of causes: screening, refits of the candidates, a penalised choice, one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import FittedCause, Start
from valveflow_ros.diagnosis.causes import catalogue, causes_for
from valveflow_ros.diagnosis.evidence import Evidence, colour, weigh
from valveflow_ros.diagnosis.extended import Drive, Extended, answer, drive
from valveflow_ros.diagnosis.fitting import (
    Task,
    base_tangents,
    held,
    improve,
    search_levels,
    search_lines,
    settle,
)
from valveflow_ros.diagnosis.grids import DAY_S, Grids
from valveflow_ros.diagnosis.screening import EDGE_SHARE, Screening
from valveflow_ros.diagnosis.slow import LEVELS, OF_WANDER, wander_lead
from valveflow_ros.errors import TooFewSamplesError, listed
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.refine import search as search_plain
from valveflow_ros.numerics import each_in_threads
from valveflow_ros.records import FloatArray

# The plain simulation: few distinct pieces.
#
# A curve found by prediction error has as many breakpoints as reduce the error. A shallow one is
# not a valve point but part of a smooth shape.

SHALLOW = 0.2  # change of slope relative to the larger one
_JUMP = 1e-4  # of the range of the curve, whose unit depends on the form


def simplified(model: RegionalModel) -> RegionalModel:
    """Return the curve without its shallow breakpoints, removed one by one; jumps stay."""
    least = _JUMP * float(np.ptp(np.concatenate([model.left, model.right])))
    while model.pieces > 1:
        slopes = model.slopes()
        larger = np.maximum(np.abs(slopes[1:]), np.abs(slopes[:-1]))
        bend = np.abs(np.diff(slopes)) / np.maximum(larger, 1e-12)
        bend[np.abs(model.left[1:] - model.right[:-1]) > least] = np.inf
        weakest = int(np.argmin(bend))
        if bend[weakest] >= SHALLOW:
            return model
        model = without_knot(model, weakest + 1)
    return model


def without_knot(model: RegionalModel, knot: int) -> RegionalModel:
    """Return the curve with the two pieces at an inner breakpoint merged."""
    return replace(
        model,
        knots=np.delete(model.knots, knot),
        left=np.delete(model.left, knot),
        right=np.delete(model.right, knot - 1),
    )


# New identification of curve and regions after a strong cause.
#
# A cause as large as the noise of the power makes the identification wrong: regions are missed
# and breakpoints are misplaced. After correcting for the cause, the record is that of the plant
# without it, and pieces and regions are identified again.

_MORE_PIECES, _MOST = 3, 8
_EACH = 5.0  # log-likelihood that each additional parameter of curve and regions must gain


def rebuilt(task: Task, model: Extended) -> tuple[Task, Extended]:
    """Return the model with newly identified curve and regions if they fit better."""
    try:
        found, _ = search_plain(_seen_through(task, model), _rich(model.base), _MOST)
        base = simplified(found)
    except (TooFewSamplesError, np.linalg.LinAlgError):
        return task, model
    if base.pieces == model.base.pieces and base.regions == model.base.regions:
        return task, model
    task_new, other, cost = settle(task, replace(model, base=base), rounds=1, steps=4)
    # Both with the whitening of the better model.
    variance = cost / max(int(task.rows.sum()), 1)
    before = task_new.cost(model) / (2.0 * variance) + _EACH * model.base.size
    after = task_new.cost(other) / (2.0 * variance) + _EACH * other.base.size
    return (task_new, other) if after < before else (task, model)


def _seen_through(task: Task, model: Extended) -> Samples:
    """Return the record corrected for the causes; sealed blocks are left out."""
    grids = task.grids
    driven = drive(grids, model)
    plain = answer(grids, model.without_causes(), Drive(driven.u, driven.scale, None, None))
    power = grids.power - (answer(grids, model) - plain)
    rows = np.repeat(task.rows, grids.group)
    return Samples(
        u=driven.u,
        power_mw=np.repeat(np.where(task.rows, power, 0.0), grids.group),
        usable=(rows & (grids.usable > 0)).astype(np.uint8),
        step_s=grids.step_s,
        settle_s=grids.settle_s,
        group=grids.group,
        scale=driven.scale if grids.form.scaled else None,
    )


def _rich(base: RegionalModel) -> RegionalModel:
    """Return the curve with its widest pieces split in two; superfluous ones are removed later."""
    for _ in range(_MORE_PIECES):
        k = int(np.argmax(np.diff(base.knots)))
        base = _with_knot(base, 0.5 * float(base.knots[k] + base.knots[k + 1]))
    return base


def _with_knot(base: RegionalModel, u: float) -> RegionalModel:
    """Return the same curve with a further breakpoint at ``u``."""
    k = int(np.searchsorted(base.knots, u)) - 1
    value = base.left[k] + base.slopes()[k] * (u - base.knots[k])
    return replace(
        base,
        knots=np.insert(base.knots, k + 1, u),
        left=np.insert(base.left, k + 1, value),
        right=np.insert(base.right, k, value),
    )


Progress = Callable[[float, str], None]

MOST_CAUSES = 4
MOST_RIVALS = 7
PENALTY = 5.0  # log-likelihood that each parameter chosen from the data must gain
SCREEN_LEAST = 6.0
SCREEN_SHARE = 0.1
NOT_TOLD_APART = 10.0
# Of the largest power. The breakpoints of real valves are rounded; fixed on units built from
# physics with numbers 5001 to 5012.
_LEAST_HEIGHT = 0.0025
KEPT_LEAST = 8.0
# In log-likelihood; a random variation also imitates causes that are not found yet.
_LEAD_OF_WANDER = 6.0
_SAME_COST = 0.999  # a smaller part of the sum of squares is another minimum of the same model
_LEAST_EXCHANGE = 1.0  # log-likelihood: less is no reason to fit everything again
STRONG = 300.0  # log-likelihood of a cause that may have made the identification wrong
_SHORT_STEPS_MW = (1.0, 0.4)
_INTERVALS = 'intervals'
_BEND = 'curve_shape'
_REFITTED = 2  # starts of one cause with a base of their own that are refitted to the end


@dataclass(frozen=True, slots=True)
class Rival:
    """A candidate cause after a full refit; ``score`` is half a penalised sum of squares."""

    model: Extended
    added: FittedCause
    score: float


@dataclass(slots=True)
class Trials:
    """The starts and refits of causes added to one model, by name: none is computed twice."""

    task: Task
    model: Extended
    starts: dict[str, list[Start]] = field(default_factory=dict)
    refits: dict[str, list[tuple[Extended, float]]] = field(default_factory=dict)


@dataclass(slots=True)
class SearchResult:
    """The outcome of the search.

    Attributes
    ----------
    task, model : Task, Extended
        The last whitening and the model with all causes.
    plain : Extended
        The model without causes, fitted to the same rows.
    start : Extended
        The model from which the search began.
    evidence : dict
        By name of a cause, its evidence when it was added.
    near : dict
        By name of a cause, the other candidates that fitted nearly as well.
    reasons : dict
        By name, why a cause was rejected.
    tried : int
        Number of causes tried.
    rough : Grids, optional
        The record with longer model rows, for screening.
    other_shape : str
        Sentence on a change in time that fits a little better than the named one; or ''.
    refuted : set of str
        Causes that the sealed blocks did not confirm.
    trials : Trials, optional
        Of the last model to which causes were added.
    """

    task: Task
    model: Extended
    plain: Extended
    start: Extended
    evidence: dict[str, Evidence] = field(default_factory=dict)
    near: dict[str, tuple[str, ...]] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    tried: int = 0
    rough: Grids | None = None
    other_shape: str = ''
    refuted: set[str] = field(default_factory=set)
    trials: Trials | None = None

    def without(self, name: str) -> Extended:
        """Return the model without a cause, fitted again.

        Beside a cause that is a lag, the other lags are far from their best without it. So the fit
        begins with the curve and lags of the plain model too.
        """
        others = self.model.without(name)
        begin = (others, replace(self.plain, active=others.active))
        return min((improve(self.task, m, 3) for m in begin), key=lambda fit: fit[1])[0]

    def withdraw(self, name: str, why: str, model: Extended | None = None) -> None:
        """Remove a cause; ``model`` is the one without it, which is fitted here if not given."""
        self.model = self.without(name) if model is None else model
        self.near.pop(name, None)
        self.evidence.pop(name, None)
        self.reasons[name] = why
        self.other_shape = ''


_BY_CHANCE = 'the power does not follow it more closely than a slow wander would by chance'


def search(
    task: Task, start: Extended, progress: Progress, rough: Grids | None = None,
    *, earlier_curve: bool,
) -> SearchResult:  # fmt: skip
    """Fit the plain model, then add causes while one of them passes all tests.

    With ``earlier_curve`` the breakpoints of ``start`` were not found from this record.
    """
    progress(0.05, 'simulation fitted to the record')
    task, plain = _settled(task, start)
    found = SearchResult(task, plain, plain, start, rough=rough)
    barred: set[str] = set()
    every = causes_for(task.grids)
    for name, cause in every.items():
        if why := cause.hindered(task.grids):
            found.reasons[name] = f'cannot be judged: {why}'
            barred.add(name)
    if task.grids.form.scaled:
        # They were determined together with the form, in this record or that of the given model:
        # the exponent is a parameter of it, and the curve shape is the error of straight pieces.
        for name in ('exponent', _BEND):
            found.reasons[name] = (
                'cannot be judged: in the form p^m F(V) + c the exponent m and the curve F are '
                'results of the fit, with no expected values to compare them with'
            )
            barred.add(name)
        # What is left of its pressure dependence is an error of the exponent.
        found.reasons['choked'] = (
            'cannot be judged: the form p^m F(V) + c is that of a valve that is choked already'
        )
        barred.add('choked')
    elif not earlier_curve:
        found.reasons[_BEND] = (
            'cannot be judged without an earlier model whose curve still holds: breakpoints that '
            'are found from the same record follow a bend too'
        )
        barred.add(_BEND)
    found.tried = len(every) - len(barred)
    found = _extended(found, barred, progress)
    for name in catalogue():
        if (why := unseen(name, task.grids)) and name not in found.model.names:
            found.reasons.setdefault(name, why)
    for name in task.grids.covariates:
        if name not in found.model.names:
            found.reasons.setdefault(name, _BY_CHANCE)
    return found


def _extended(
    found: SearchResult, barred: set[str], progress: Progress, pairs: bool = False
) -> SearchResult:
    """Add causes while one of them passes the tests.

    Intervals at unknown times can imitate several causes at once. When they are added, these are
    also searched for without them, and the likelier set is returned.

    Parameters
    ----------
    pairs : bool
        If no cause passes alone, two are tried at once: each may hide the other.
    """
    for turn in range(len(found.model.active), MOST_CAUSES):
        progress(0.15 + 0.15 * turn, 'further causes tried' if turn else 'causes tried')
        before = replace(
            found, evidence=dict(found.evidence), near=dict(found.near),
            reasons=dict(found.reasons),
        )  # fmt: skip
        barred_before = {*barred, _INTERVALS}
        if not (_add(found, barred) or (pairs and _add_two(found, barred))):
            break
        _drop_weak(found, barred)
        _exchange(found, barred)
        _conceal(found, barred)
        if _INTERVALS in found.model.names and _INTERVALS not in before.model.names:
            before.trials = found.trials
            others = _extended(before, barred_before, progress, pairs=True)
            return _likelier(_extended(found, barred, progress), others)
    return found


def _likelier(found: SearchResult, others: SearchResult) -> SearchResult:
    """Return the likelier of two searches, the first of which found intervals."""
    if _INTERVALS not in found.model.names:
        return found
    task = others.task  # both with the same whitening and variance
    e = task.innovations(task.residual(others.model))
    variance = float(e @ e) / len(e) * colour(task, e)

    def score(model: Extended) -> float:
        chosen = PENALTY * sum(a.size for a in model.active) + _EACH * model.base.size
        return task.cost(model) / (2.0 * variance) + chosen

    less = score(found.model) - score(others.model)
    if less <= 0.0:
        return found
    instead = [n for n in others.model.names if n not in found.model.names]
    better = 'together explain' if len(instead) > 1 else 'explains'
    others.reasons[_INTERVALS] = (
        f'{listed(instead) or "a model without it"} {better} the data better '
        f'(log-likelihood {less:+.1f})'
    )
    for name in instead if less < NOT_TOLD_APART else ():
        others.near[name] = (*others.near[name], _INTERVALS)
    return others


def _settled(task: Task, start: Extended) -> tuple[Task, Extended]:
    """Return the plain model fitted to the record."""
    task, plain, _ = settle(task, start, rounds=2, steps=4)
    if task.fixed_dynamics:
        # After a change of the curve its regions may be at the same u or at the same MW.
        same_mw = replace(plain, base=plain.base.with_levels(start.base.levels))
        plain = min((plain, same_mw), key=task.cost)
    return task, plain


def _conceal(found: SearchResult, barred: set[str]) -> None:
    """Reject causes that cannot be judged together with the causes found."""
    for a in found.model.active:
        for name, cause in catalogue().items():
            if cause.family in a.cause.conceals and name not in (*barred, *found.model.names):
                found.reasons.setdefault(name, f'cannot be judged beside {a.name}')
                barred.add(name)


def _add(found: SearchResult, barred: set[str]) -> bool:
    """Add the best cause if it passes the tests; return True if it did."""
    rivals = _visible(found, _rivals(found, barred), barred)
    if not rivals:
        return False
    best: float | None = None
    doubted: list[str] = []
    for rival in rivals:
        if best is not None and rival.score - best > NOT_TOLD_APART:
            break
        if doubt := _doubt(found.task, rival):
            # It is no candidate, so it must not hide another one that explains less.
            found.reasons[rival.added.name] = doubt
            doubted.append(rival.added.name)
            continue
        without, cost = improve(found.task, rival.model.without(rival.added.name), 3)
        now = found.task.cost(found.model)
        if cost < now * _SAME_COST:
            # The refit had led to a better curve, which needs no cause: all are tried on that one.
            found.plain = found.plain if found.model.active else without
            found.model = without
            return _add(found, barred)
        without = without if cost < now else found.model
        evidence = weigh(found.task, without, rival.model, rival.added.size)
        if not evidence.enough:
            found.reasons[rival.added.name] = evidence.reason()
            # Intervals can imitate several causes, so they hide none.
            if best is None and rival.added.name != _INTERVALS:
                best = rival.score
            continue
        _note(found, rival, [r for r in rivals if r.added.name not in doubted], evidence)
        if rival.added.cause.of_model and not found.task.fixed_dynamics:
            _absorb(found, rival)
        else:
            _take(found, rival, evidence.gain)
        return True
    # Causes that explain little beside the best one had not been refitted: now it is their turn.
    beaten = {name for name in doubted if found.reasons[name] == OF_WANDER}
    return bool(beaten) and _add(found, barred | beaten)


def _add_two(found: SearchResult, barred: set[str]) -> bool:
    """Add the two best causes if each passes the tests beside the other; return True if so."""
    task, model, chosen = found.task, found.model, []
    for _ in range(2):
        part = replace(found, model=model, reasons={})
        rivals = _visible(part, _rivals(part, barred), set())
        best = next((r for r in rivals if not _doubt(task, r)), None)
        if best is None or (best.added.cause.of_model and not task.fixed_dynamics):
            return False
        model = best.model
        chosen.append((best, rivals))
    weighed = []
    for best, _ in chosen:
        without, _ = improve(task, model.without(best.added.name), 3)
        weighed.append(weigh(task, without, model, best.added.size))
        if not weighed[-1].enough:
            return False
    for (best, rivals), evidence in zip(chosen, weighed, strict=True):
        _note(found, best, rivals, evidence)
    _take(found, chosen[-1][0], weighed[-1].gain)
    return True


def _note(found: SearchResult, chosen: Rival, rivals: list[Rival], evidence: Evidence) -> None:
    """Write down why a cause was added, and how much better it is than its rivals."""
    name, behind = chosen.added.name, {r.added.name: r.score - chosen.score for r in rivals}
    del behind[name]
    found.reasons.pop(name, None)
    found.evidence[name] = evidence
    found.near[name] = tuple(n for n, by in behind.items() if abs(by) < NOT_TOLD_APART)
    for other, by in behind.items():
        if by > 0.0:
            found.reasons[other] = f'{name} explains the data better (log-likelihood {by:+.1f})'
        else:
            found.reasons[other] = f'blocks of time kept out of the search confirm {name}'


def add_of_family(found: SearchResult, family: str) -> bool:
    """Add the best cause of one family if it passes the tests; return True if it did."""
    causes = causes_for(found.task.grids)
    others = {name for name, cause in causes.items() if cause.family != family}
    hindered = {name for name, cause in causes.items() if cause.hindered(found.task.grids)}
    return _add(found, others | hindered | found.refuted)


def _without_onset(task: Task, rival: Rival) -> str:
    """Return why a change is no change in time; or ''.

    If it begins with the record, or explains as much without its onset, it is an error of the
    curve itself, in a record that begins with other loads.
    """
    unknowns = rival.added.cause.unknowns
    onsets = [v for u, v in zip(unknowns, rival.added.values, strict=True) if u.dated]
    if not onsets:
        return ''
    days = len(task.grids.power) * task.grids.mean_s / DAY_S
    if min(onsets) < EDGE_SHARE * days:
        return 'it would begin with the record, which does not show the time before'
    values = tuple(
        0.0 if u.dated else v for u, v in zip(unknowns, rival.added.values, strict=True)
    )
    cost = task.cost(rival.model)
    always = task.cost(rival.model.having(replace(rival.added, values=values)))
    gain = 0.5 * (always / cost - 1.0) * float(task.rows.sum())
    return '' if gain > KEPT_LEAST else 'it explains as much without its onset'


def _small(task: Task, rival: Rival) -> str:
    """Return why a bend is none: the straight pieces of a healthy valve miss as much; or ''."""
    if rival.added.name != _BEND:
        return ''
    least = _LEAST_HEIGHT * float(np.max(task.grids.power))
    if abs(rival.added.values[0]) > least:
        return ''
    return f'a healthy valve differs from straight pieces by up to {least:.2g} MW, this by less'


def _visible(found: SearchResult, rivals: list[Rival], barred: set[str]) -> list[Rival]:
    """Return candidates that the recording cannot imitate; reject the others."""
    seen = []
    for rival in rivals:
        if why := hidden(rival.added, found.task.grids):
            found.reasons[rival.added.name] = why
            barred.add(rival.added.name)
        else:
            seen.append(rival)
    return seen


# Parameters that are a time in s or a backlash in % of opening.
_TIMES = {'clock': 'd_s', 'reheater': 'time_s', 'region_lag': 'time_s', 'rate_limit': ''}
_SLACKS = {'backlash': 'w_percent', 'stiction': 's_percent'}


def hidden(added: FittedCause, grids: Grids) -> str:
    """Return why the recording may hide or imitate a cause of this size; '' if it cannot.

    For a rate limit, the duration of a typical fast move counts.
    """
    values, blur = added.named(), grids.blur
    if added.name in _SLACKS:
        seen = values[_SLACKS[added.name]] >= blur.opening_percent
    elif added.name == 'rate_limit':
        seen = blur.opening_percent >= blur.time_s * values['r_percent_per_s']
    else:
        seen = added.name not in _TIMES or values[_TIMES[added.name]] >= blur.least_s(added.name)
    return '' if seen else unseen(added.name, grids)


def unseen(name: str, grids: Grids) -> str:
    """Return the range of a cause that the recording hides; '' if there is none."""
    blur = grids.blur
    if not blur.words or name not in (*_TIMES, *_SLACKS):
        return ''
    if name in _SLACKS:
        return f'{blur.words} a slack below {blur.opening_percent:.2g} % of opening'
    return f'{blur.words} lags and delays below {blur.least_s(name):.0f} s'


def _take(found: SearchResult, rival: Rival, gain: float) -> None:
    """Fit the model with its new cause; identify curve and regions again after a strong one."""
    found.task, settled, _ = settle(found.task, rival.model, rounds=1, steps=3)
    found.model = held(found.task.grids, settled, found.task.ar)
    if gain > STRONG and not found.task.fixed_dynamics:
        found.task, found.model = rebuilt(found.task, found.model)


def _absorb(found: SearchResult, rival: Rival) -> None:
    """Make an effect that an identification may also find part of the plain model: no fault."""
    name = rival.added.name
    found.withdraw(name, 'it is already included in the fitted curve and dynamics', found.model)
    whole = replace(rival.model.without(name), base=rival.model.regional)
    found.task, found.model, _ = settle(found.task, whole, rounds=1, steps=3)
    plain = replace(found.plain, base=rival.added.cause.act(found.plain.base, rival.added.values))
    found.plain, _ = improve(found.task, plain, 4)


def _shortlist(found: SearchResult, barred: set[str], known: dict[str, list[Start]]) -> list[str]:
    """Return causes to be refitted: the best ones, and the families of the best ones.

    Backlash and stiction are two models of one slack: there is one of them only. The fitted curve
    has moved its breakpoints towards a bend, so a bend is searched for on the curve before.
    """
    task, model = found.task, found.model
    every = causes_for(task.grids)
    single = {a.cause.family for a in model.active} & {'slack'}
    wanted = [
        name for name, cause in every.items()
        if not (name in barred or name in model.names or cause.family in single)
    ]  # fmt: skip
    if untried := [name for name in wanted if name not in known]:
        screening = Screening(task, model, found.rough)
        before = replace(model, base=found.start.base)
        _ = screening.sums  # computed once, before several threads need them

        def starts_of(name: str) -> list[Start]:
            on = Screening(task, before, found.rough) if name == _BEND else screening
            return list(every[name].starts(on))

        known.update(zip(untried, each_in_threads(starts_of, untried), strict=True))
    best = {name: max(s.gain for s in known[name]) for name in wanted if known[name]}
    if not best or max(best.values()) < SCREEN_LEAST:
        return []
    least = max(SCREEN_LEAST, SCREEN_SHARE * max(best.values()))
    good = sorted((n for n in best if best[n] >= least), key=lambda n: -best[n])[:MOST_RIVALS]
    families = {every[n].family for n in good}
    return good + [n for n in best if n not in good and every[n].family in families]


def _refitted(trials: Trials, names: list[str]) -> list[tuple[Extended, float]]:
    """Return the models with one of these causes each, and their sums of squares."""
    task, refits = trials.task, trials.refits
    every, untried = causes_for(task.grids), [name for name in names if name not in refits]
    from_model: list[Extended] = []
    from_own_base: list[Extended] = []
    for name, start in ((n, s) for n in untried for s in trials.starts[n]):
        base = trials.model.base if start.base is None else start.base
        added = FittedCause(every[name], start.values, start.extra)
        begin = from_model if start.base is None else from_own_base
        begin.append(replace(trials.model, base=base).with_cause(added))
    begun: dict[str, list[tuple[Extended, float]]] = {}
    for model, cost in each_in_threads(lambda m: improve(task, m, 2), from_own_base):
        begun.setdefault(model.names[-1], []).append((model, cost))
    tangents = task.innovations(base_tangents(task, trials.model)) if from_model else None
    todo: list[tuple[Extended, FloatArray | None]] = [(m, tangents) for m in from_model]
    for several in begun.values():
        best_first = sorted(several, key=lambda m: m[1])
        todo += [(model, None) for model, _ in best_first[:_REFITTED]]
    refits |= {name: [] for name in untried}
    for model, cost in each_in_threads(lambda given: _refit(task, *given), todo):
        refits[model.names[-1]].append((model, cost))
    return [refit for name in names for refit in refits[name]]


def _rivals(found: SearchResult, barred: set[str]) -> list[Rival]:
    """Refit every promising cause; return one candidate per cause, best score first."""
    trials = found.trials
    if trials is None or trials.task is not found.task or trials.model is not found.model:
        trials = found.trials = Trials(found.task, found.model)
    refits = _refitted(trials, _shortlist(found, barred, trials.starts))
    if not refits:
        return []
    # The noise variance is that of the best refit.
    e = found.task.innovations(found.task.residual(min(refits, key=lambda r: r[1])[0]))
    variance = float(e @ e) / len(e) * colour(found.task, e)
    best: dict[str, Rival] = {}
    for model, cost in refits:
        added = model.active[-1]
        rival = Rival(model, added, cost / (2.0 * variance) + PENALTY * added.size)
        if added.name not in best or rival.score < best[added.name].score:
            best[added.name] = rival
    fair = [_fair(found.task, rival, best, variance) for rival in best.values()]
    return sorted(fair, key=lambda r: r.score)


def _fair(task: Task, rival: Rival, others: dict[str, Rival], variance: float) -> Rival:
    """Return a candidate scored only by what it explains beyond a simpler cause that it contains.

    Averaging several noise realisations smooths a path, which is a gain even without a jump.
    """
    cause = rival.added.cause
    if cause.simpler is None or cause.contains not in others:
        return rival
    plain = min(
        task.cost(rival.model.having(replace(rival.added, values=v)))
        for v in cause.simpler(rival.added.values)
    )
    simpler = others[cause.contains]
    more = (plain - task.cost(rival.model)) / (2.0 * variance)
    extra = PENALTY * (rival.added.size - simpler.added.size)
    return replace(rival, score=max(rival.score, simpler.score - more + extra))


def _refit(task: Task, model: Extended, tangents: FloatArray | None) -> tuple[Extended, float]:
    """Fit a model whose last cause is new; return it and its sum of squares."""
    if 'clock' in model.names:
        tangents = None  # one delay is fixed with it, which changes the columns
    model, cost = improve(task, model, 3, tangents)
    model, cost = search_lines(task, model, cost)
    model, cost = search_levels(task, model, cost, _SHORT_STEPS_MW)
    return improve(task, model, 3, tangents)


def _exchange(found: SearchResult, barred: set[str]) -> None:
    """Replace each earlier cause by one that was nearly as good, if that one is better now.

    While the later causes were missing, the wrong one may have taken a part of their effect, or
    the right one may have got a wrong onset.
    """
    for a in found.model.active[:-1]:
        near = set(found.near.get(a.name, ())) - {*barred, *found.model.names}
        if not (near or any(u.dated for u in a.cause.unknowns)):
            continue
        without, rivals = in_place_of(found, a.name, near)
        if not rivals:
            continue
        best = rivals[0]
        if best.added.cause.of_model and not found.task.fixed_dynamics:
            continue  # no fault: the fitted dynamics include it
        # The present model may fit better than a new start of the same cause.
        cost = found.task.cost(best.model)
        variance = cost / max(int(found.task.rows.sum()), 1)
        gain = (found.task.cost(found.model) - cost) / (2.0 * variance)
        if gain <= PENALTY * (best.added.size - a.size) + _LEAST_EXCHANGE:
            continue
        why = f'{best.added.name} explains the data better beside the causes found later'
        put_in_place_of(found, a.name, best, rivals, without, why)


def in_place_of(found: SearchResult, name: str, near: set[str]) -> tuple[Extended, list[Rival]]:
    """Return the model without a cause, and this cause and some others refitted in its place.

    Those that are no candidates are left out.
    """
    without, _ = improve(found.task, found.model.without(name), 3)
    part = SearchResult(found.task, without, found.plain, found.start, rough=found.rough)
    others = set(causes_for(found.task.grids)) - near - {name}
    rivals = _visible(part, _rivals(part, others), set())
    return without, [r for r in rivals if not _doubt(found.task, r)]


def put_in_place_of(
    found: SearchResult, name: str, best: Rival, rivals: list[Rival], without: Extended, why: str
) -> bool:
    """Replace a cause by a rival that passes the tests; return True if it does.

    ``why`` becomes the reason against the cause, ``without`` is the model without it.
    """
    evidence = weigh(found.task, without, best.model, best.added.size)
    if not evidence.enough:
        return False
    found.withdraw(name, why, without)
    _note(found, best, rivals, evidence)
    if best.added.name != name:
        found.reasons[name] = why
    _take(found, best, evidence.gain)
    return True


def _doubt(task: Task, rival: Rival) -> str:
    """Return why a rival is no candidate, however well it fits; or ''."""
    return (
        rival.added.beyond or _without_onset(task, rival) or _small(task, rival)
        or _like_a_wander(task, rival)
    )  # fmt: skip


def _like_a_wander(task: Task, rival: Rival) -> str:
    """Return why a change in time is none: a slow disturbance fits better; or ''."""
    if rival.added.name not in LEVELS or wander_lead(task, rival.model) <= _LEAD_OF_WANDER:
        return ''
    return OF_WANDER


def _drop_weak(found: SearchResult, barred: set[str]) -> None:
    """Remove each earlier cause that the later ones have made superfluous."""
    for a in found.model.active[:-1]:
        if len(found.model.active) < 2:
            return
        cost = found.task.cost(found.model)
        variance = cost / max(int(found.task.rows.sum()), 1)
        smaller, without = improve(found.task, found.model.without(a.name), 3)
        loss = (without - cost) / (2.0 * variance)
        if loss < KEPT_LEAST + a.size:
            why = f'after the causes found later it gains only {loss:.1f} in log-likelihood'
            found.withdraw(a.name, why, smaller)
            barred.add(a.name)
