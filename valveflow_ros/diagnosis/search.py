# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Selection of causes: screening, refits of the candidates, a penalised choice, one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
from valveflow_ros.diagnosis.grids import Grids
from valveflow_ros.diagnosis.kernels import bump
from valveflow_ros.diagnosis.screening import Screening
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.fit.piece_selection import choose_pieces
from valveflow_ros.fit.problem import Problem, Samples
from valveflow_ros.fit.refine import search as search_plain
from valveflow_ros.fit.whitening import fit_ar
from valveflow_ros.records import FloatArray

# The plain simulation: few distinct pieces.
#
# A curve found by prediction error has as many breakpoints as reduce the error. A shallow one is
# not a valve point but part of a smooth shape, and would hide `curve_shape` inside the model.

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


# Breakpoints of the plain curve that are not valve points but the middle of a bump.
#
# A curve found by prediction error may have a breakpoint in the middle of a bump, and
# `curve_shape` would find nothing. Such a breakpoint bends in the opposite direction to both
# neighbours. It is removed if a bump in its place explains the data equally well.

_WIDTHS = (0.5, 0.8, 1.2)  # of the shorter piece next to the breakpoint
_PLACES = (-0.15, 0.0, 0.15)


def without_bumps(task: Task, plain: Extended) -> tuple[Task, Extended]:
    """Return the plain model without breakpoints that a bump can replace, fitted again."""
    for knot in _suspects(plain):
        smaller = replace(plain, base=simplified(without_knot(plain.base, knot)))
        if _as_good(task, plain, smaller, float(plain.base.knots[knot]), _width(plain, knot)):
            task, smaller, _ = settle(task, smaller, rounds=1, steps=4)
            return without_bumps(task, smaller)
    return task, plain


def _suspects(plain: Extended) -> list[int]:
    """Return inner breakpoints that bend in the opposite direction to both neighbours."""
    bend = np.sign(np.diff(plain.base.slopes()))
    return [
        k + 1 for k in range(1, len(bend) - 1) if bend[k] == -bend[k - 1] == -bend[k + 1] != 0.0
    ]


def _width(plain: Extended, knot: int) -> float:
    knots = plain.base.knots
    return float(min(knots[knot] - knots[knot - 1], knots[knot + 1] - knots[knot]))


def _as_good(task: Task, plain: Extended, smaller: Extended, u: float, width: float) -> bool:
    """Return True if a bump at ``u`` reduces the cost of the smaller model to the plain one."""
    screening, cause = Screening(task, smaller), catalogue()['curve_shape']
    gain = max(
        screening.scaled_height(cause, (u + place * width, share * width)).gain
        for share in _WIDTHS
        for place in _PLACES
    )
    return screening.floor - 2.0 * screening.variance * gain <= task.cost(plain)


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


# A bump, a dent next to it, or neither.
#
# With free breakpoints, a curve with a bump is nearly equal to one with other breakpoints and a
# dent next to it, or with a bump in place of a breakpoint. So a named bend is compared with such
# bends, and with breakpoints alone, each beside a newly identified curve.

_BESIDE = (-1.2, -0.7, 0.7, 1.2)  # of its half width
_SHARES = (0.5, 1.0)  # of the height and half width that replace a breakpoint
_BEND_SIZE = 3  # parameters
_BEND_TOLD = 10.0  # log-likelihood by which one bend must be better than another
# Of the height of the named one: others are not tried or ignored.
_LEAST_BEND, _LARGEST_BEND = 0.1, 4.0


def settle_bend(found: SearchResult) -> None:
    """Give `curve_shape` the best place and sign; withdraw it where breakpoints do as well.

    ``found.other_bend`` becomes the model with the opposite sign if it fits nearly as well. Two
    models are compared with the whitening of one; each parameter of the curve is penalised.
    """
    bend = _bend(found.model)
    if bend is None:
        return
    task = found.task if found.rough is None else replace(found.task, grids=found.rough)
    anew = [_settled_anew(task, m) for m in _other_bends(found.model, bend)]
    alike, turned = (
        [m for m in anew if m and _is_bend(m, bend, turned) and not _rounds(m)]
        for turned in (False, True)
    )
    kept, own = found.model, settle(task, found.model, rounds=2, steps=10)[:2]
    if alike:
        best = settle(task, _best(task, kept, alike), rounds=2, steps=10)[:2]
        better = _advantage(*best, own[1])
        kept = best[1] if better > _BEND_TOLD else kept
        own = best if better > 0.0 else own
    if turned:
        best = settle(task, _best(task, found.model, turned), rounds=2, steps=10)[:2]
        better, worse = _advantage(*best, own[1]), _advantage(*own, best[1])
        if _is_bend(best[1], bend, turned=True) and better > 0.0:
            kept, found.other_bend = best[1], own[1] if better < _BEND_TOLD else None
            own = best
        elif _is_bend(best[1], bend, turned=True) and worse < _BEND_TOLD:
            found.other_bend = best[1]
    knots, why = _without_bend(task, own, found)
    if why:
        kept, found.other_bend = knots, None
        found.evidence.pop('curve_shape', None)
        found.near.pop('curve_shape', None)
        found.reasons['curve_shape'] = why
    elif _rounds(own[1]):
        kept, found.other_bend = found.other_bend or kept, None
    if kept is not found.model:
        found.task, found.model, _ = settle(found.task, kept, rounds=1, steps=6)
    if why:
        found.plain, _ = improve(found.task, replace(found.plain, base=found.model.base), 4)


def _without_bend(
    task: Task, own: tuple[Task, Extended], found: SearchResult
) -> tuple[Extended, str]:
    """Return the model with breakpoints alone, and why it is preferred to the bend; or ''."""
    model = _in_pieces(own[1])
    _, knots, _ = settle(task, _settled_anew(task, model) or model, rounds=2, steps=10)
    # Straight pieces are what a valve is expected to have: any number of them may be needed.
    gain = _advantage(*own, knots, 0.0) - PENALTY * _BEND_SIZE
    # A given model keeps its number of pieces: more of them would be a finding too.
    if gain < NOT_TOLD_APART and not task.fixed_dynamics:
        return knots, 'breakpoints of the curve explain the data as well'
    if _rounds(own[1]) and found.other_bend is None:
        return knots, 'it lies at a breakpoint, as the rounded breakpoint of a healthy valve would'
    return knots, ''


def _in_pieces(model: Extended) -> Extended:
    """Return the model with straight pieces in place of `curve_shape`."""
    bend = _bend(model)
    assert bend is not None
    h, centre, width = bend.values
    base = model.base
    for u in (centre - width, centre, centre + width):
        if base.knots[0] < u < base.knots[-1] and u not in base.knots:
            base = _with_knot(base, u)
    raised = np.empty(len(base.knots))
    bump(base.knots, centre, width, raised)
    base = replace(base, left=base.left + h * raised[:-1], right=base.right + h * raised[1:])
    return replace(model.without('curve_shape'), base=base)


def _best(task: Task, model: Extended, tried: list[Extended]) -> Extended:
    return min(tried, key=lambda other: _advantage(task, model, other))


def _other_bends(model: Extended, bend: FittedCause) -> Iterator[Extended]:
    """Yield the model, with an opposite bend next to its own, and with one at each breakpoint."""
    h, centre, width = bend.values
    yield model
    for beside in _BESIDE:
        yield model.having(replace(bend, values=(-h, centre + beside * width, width)))
    base = model.base
    for k in range(1, len(base.knots) - 1):
        height = _height(base, k)
        if _LEAST_BEND * abs(h) < abs(height) < _LARGEST_BEND * abs(h):
            wide = 0.5 * float(base.knots[k + 1] - base.knots[k - 1])
            for share in _SHARES:
                values = share * height, float(base.knots[k]), share * wide
                at_knot = replace(bend, values=values)
                yield replace(model, base=without_knot(base, k)).having(at_knot)


def _height(base: RegionalModel, knot: int) -> float:
    """Return how far the curve at a breakpoint is above the line between its neighbours, in MW."""
    (a, b, c), slopes = base.knots[knot - 1 : knot + 2], base.slopes()
    return float((slopes[knot - 1] - slopes[knot]) * (b - a) * (c - b) / (c - a))


def _advantage(task: Task, model: Extended, other: Extended, each: float = _EACH) -> float:
    """Return the log-likelihood of a model minus that of another, with one whitening."""
    e = task.innovations(task.residual(model))
    variance = float(e @ e) / len(e) * colour(task, e)
    gain = (task.cost(other) - task.cost(model)) / (2.0 * variance)
    return gain + each * (other.base.size - model.base.size)


def _settled_anew(task: Task, model: Extended) -> Extended | None:
    """Return the model fitted again with newly chosen pieces, and the same regions."""
    try:
        if not task.fixed_dynamics:
            rows = Problem(_seen_through(task, model).coarser())
            base = choose_pieces(rows, model.base, fit_ar(*rows.answer(model.base)), _MOST).model
            model = replace(model, base=simplified(base))
        return settle(task, model, rounds=1, steps=6)[1]
    except (TooFewSamplesError, np.linalg.LinAlgError):
        return None


def _bend(model: Extended) -> FittedCause | None:
    return next((a for a in model.active if a.name == 'curve_shape'), None)


def _is_bend(model: Extended, named: FittedCause, turned: bool) -> bool:
    """Return True if the bend lies on the curve and has the sign of the named one, or not."""
    bend = _bend(model)
    if bend is None:
        return False
    h = named.values[0]
    height, centre = bend.values[:2]
    low, high = model.base.knots[0], model.base.knots[-1]
    large = abs(height) > _LEAST_BEND * abs(h)
    return bool((height * h < 0.0) == turned and large and low < centre < high)


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
_AT_KNOT = 0.5  # of the half width: a bend nearer to a breakpoint rounds it
KEPT_LEAST = 8.0
STRONG = 300.0  # log-likelihood of a cause that may have made the identification wrong
_SHORT_STEPS_MW = (1.0, 0.4)


@dataclass(frozen=True, slots=True)
class Rival:
    """A candidate cause after a full refit; ``score`` is half a penalised sum of squares."""

    model: Extended
    added: FittedCause
    score: float


@dataclass(slots=True)
class SearchResult:
    """The outcome of the search.

    Attributes
    ----------
    task, model : Task, Extended
        The last whitening and the model with all causes.
    plain : Extended
        The model without causes, fitted to the same rows.
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
    other_bend : Extended, optional
        The model with the opposite sign, if `curve_shape` may be a bump or a dent.
    with_knots : Extended, optional
        The plain model before breakpoints that a bump could replace were removed.
    """

    task: Task
    model: Extended
    plain: Extended
    evidence: dict[str, Evidence] = field(default_factory=dict)
    near: dict[str, tuple[str, ...]] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    tried: int = 0
    rough: Grids | None = None
    other_bend: Extended | None = None
    with_knots: Extended | None = None


_BY_CHANCE = 'the power does not follow it more closely than a slow wander would by chance'


def search(
    task: Task, start: Extended, progress: Progress, rough: Grids | None = None
) -> SearchResult:
    """Fit the plain model, then add causes while one of them passes all tests."""
    progress(0.05, 'simulation fitted to the record')
    task, rich, _ = settle(task, start, rounds=2, steps=4)
    task, plain = without_bumps(task, rich)
    with_knots = None if plain is rich else rich
    found = SearchResult(task, plain, plain, rough=rough, with_knots=with_knots)
    barred: set[str] = set()
    every = causes_for(task.grids)
    for name, cause in every.items():
        if why := cause.hindered(task.grids):
            found.reasons[name] = f'cannot be judged: {why}'
            barred.add(name)
    if task.grids.form.scaled:
        # They were determined together with the form, in this record or that of the given model:
        # the exponent is a parameter of it, and the curve shape is the error of straight pieces.
        for name in ('exponent', 'curve_shape'):
            found.reasons[name] = (
                'cannot be judged: in the form p^m F(V) + c the exponent m and the curve F are '
                'results of the fit, with no expected values to compare them with'
            )
            barred.add(name)
    found.tried = len(every) - len(barred)
    for turn in range(MOST_CAUSES):
        progress(0.15 + 0.15 * turn, 'causes tried' if turn == 0 else 'further causes tried')
        if not _add(found, barred):
            break
        _drop_weak(found, barred)
        _conceal(found, barred)
    for name in catalogue():
        if (why := unseen(name, task.grids)) and name not in found.model.names:
            found.reasons.setdefault(name, why)
    for name in task.grids.covariates:
        if name not in found.model.names:
            found.reasons.setdefault(name, _BY_CHANCE)
    return found


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
    for rival in rivals:
        if best is not None and rival.score - best > NOT_TOLD_APART:
            break
        doubt = (
            rival.added.beyond or _without_onset(found.task, rival) or _small(found.task, rival)
        )
        if doubt:
            # It is no candidate, so it must not hide another one that explains less.
            found.reasons[rival.added.name] = doubt
            continue
        if rival.added.name == 'curve_shape' and _as_knots(found, rival):
            found.reasons['curve_shape'] = 'breakpoints of the curve explain the data better'
            barred.add('curve_shape')
            return True
        best = rival.score if best is None else best
        without = found.model
        evidence = weigh(found.task, without, rival.model, rival.added.size)
        if not evidence.enough:
            found.reasons[rival.added.name] = evidence.reason()
            continue
        name = rival.added.name
        found.reasons.pop(name, None)
        found.evidence[name] = evidence
        found.near[name] = tuple(
            r.added.name for r in rivals
            if r is not rival and r.score - rival.score < NOT_TOLD_APART
        )  # fmt: skip
        for other in rivals:
            if other is not rival:
                by = other.score - rival.score
                found.reasons[other.added.name] = (
                    f'{name} explains the data better (log-likelihood {by:+.1f})'
                )
        if rival.added.cause.of_model and not found.task.fixed_dynamics:
            _absorb(found, rival)
        else:
            _take(found, rival, evidence.gain)
        return True
    return False


def _without_onset(task: Task, rival: Rival) -> str:
    """Return why a change is no change in time: without its onset it explains as much; or ''.

    It is then an error of the curve itself, in a record that begins with other loads.
    """
    unknowns = rival.added.cause.unknowns
    if not any(u.dated for u in unknowns):
        return ''
    values = tuple(
        0.0 if u.dated else v for u, v in zip(unknowns, rival.added.values, strict=True)
    )
    cost = task.cost(rival.model)
    always = task.cost(rival.model.having(replace(rival.added, values=values)))
    gain = 0.5 * (always / cost - 1.0) * float(task.rows.sum())
    return '' if gain > KEPT_LEAST else 'it explains as much without its onset'


def _small(task: Task, rival: Rival) -> str:
    """Return why a bend is none: the straight pieces of a healthy valve miss as much; or ''."""
    if rival.added.name != 'curve_shape':
        return ''
    least = _LEAST_HEIGHT * float(np.max(task.grids.power))
    if abs(rival.added.values[0]) > least:
        return ''
    return f'a healthy valve differs from straight pieces by up to {least:.2g} MW, this by less'


def _rounds(model: Extended) -> bool:
    """Return True if the bend is at a breakpoint, as the rounded one of a healthy valve is."""
    bend, base = _bend(model), model.base
    assert bend is not None
    height, centre, width = bend.values
    turns = np.diff(base.slopes())[np.abs(base.knots[1:-1] - centre) < _AT_KNOT * width]
    return bool(np.any(turns * height > 0.0))


def _as_knots(found: SearchResult, rival: Rival) -> bool:
    """Put the breakpoints back if they explain the data better than a bump; tell if they do."""
    if found.with_knots is None:
        return False
    model, _ = improve(found.task, replace(found.model, base=found.with_knots.base), 4)
    task, bump = found.task, rival.model
    variance = task.cost(model) / float(task.rows.sum())
    gain = 0.5 * (task.cost(bump) - task.cost(model)) / variance
    more = model.base.size - bump.base.size - rival.added.size
    if gain <= PENALTY * more:
        return False
    found.task, found.model, _ = settle(task, model, rounds=1, steps=3)
    found.plain = found.with_knots
    return True


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
    found.evidence.pop(name, None)
    found.near.pop(name, None)
    found.reasons[name] = 'it is already included in the fitted curve and dynamics'
    whole = replace(rival.model.without(name), base=rival.model.regional)
    found.task, found.model, _ = settle(found.task, whole, rounds=1, steps=3)
    plain = replace(found.plain, base=rival.added.cause.act(found.plain.base, rival.added.values))
    found.plain, _ = improve(found.task, plain, 4)


def _shortlist(screening: Screening, barred: set[str]) -> list[tuple[str, Start]]:
    """Return starts to be refitted: the best ones, and the families of the best ones."""
    every = causes_for(screening.task.grids)
    starts: dict[str, list[Start]] = {}
    for name, cause in every.items():
        if name not in barred and name not in screening.model.names:
            starts[name] = list(cause.starts(screening))
    best = {n: max(s.gain for s in found) for n, found in starts.items() if found}
    if not best or max(best.values()) < SCREEN_LEAST:
        return []
    least = max(SCREEN_LEAST, SCREEN_SHARE * max(best.values()))
    good = sorted((n for n in best if best[n] >= least), key=lambda n: -best[n])[:MOST_RIVALS]
    families = {every[n].family for n in good}
    good += [n for n in best if n not in good and every[n].family in families]
    return [(n, s) for n in good for s in starts[n]]


def _rivals(found: SearchResult, barred: set[str]) -> list[Rival]:
    """Refit every promising cause; return one candidate per cause, best score first."""
    screening = Screening(found.task, found.model, found.rough)
    shortlist = _shortlist(screening, barred)
    every = causes_for(found.task.grids)
    tangents = None
    if shortlist:
        tangents = found.task.innovations(base_tangents(found.task, found.model))
    refits = []
    for name, start in shortlist:
        added = FittedCause(every[name], start.values, start.extra)
        model, frozen = found.model, tangents
        if start.base is not None:
            model, frozen = replace(model, base=start.base), None
        refits.append(_refit(found.task, model.with_cause(added), frozen))
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
            found.model = replace(smaller)
            found.evidence.pop(a.name, None)
            found.near.pop(a.name, None)
            found.reasons[a.name] = (
                f'after the causes found later it gains only {loss:.1f} in log-likelihood'
            )
            barred.add(a.name)
