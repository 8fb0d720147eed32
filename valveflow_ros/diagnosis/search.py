"""Which causes: screening, rivals, full refits, a penalised choice, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from valveflow_ros.diagnosis.bench import Bench
from valveflow_ros.diagnosis.bumps import without_bumps
from valveflow_ros.diagnosis.cause import Active, Start
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.draws import held
from valveflow_ros.diagnosis.evidence import Evidence, colour, weigh
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.fitting import (
    Task,
    base_tangents,
    improve,
    search_levels,
    search_lines,
    settle,
)
from valveflow_ros.diagnosis.rebuild import rebuilt
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.records import FloatArray

Progress = Callable[[float, str], None]

MOST_CAUSES = 4
MOST_RIVALS = 7
PENALTY = 5.0  # log-likelihood that each number chosen from the data must bring
SCREEN_LEAST = 6.0
SCREEN_SHARE = 0.1
NOT_TOLD_APART = 10.0
KEPT_LEAST = 8.0
STRONG = 300.0  # log-likelihood of a cause that may have led the identification astray
_SHORT_STEPS_MW = (1.0, 0.4)


@dataclass(frozen=True, slots=True)
class Rival:
    """A cause after its full refit; ``score`` is half a penalised sum of squares."""

    model: Extended
    added: Active
    score: float


@dataclass(slots=True)
class Found:
    """The outcome of the search.

    Attributes
    ----------
    task, model : Task, Extended
        The last whitening and the model with all causes.
    plain : Extended
        The model without causes, fitted to the same rows.
    evidence : dict
        By name of a cause, what spoke for it when it was taken.
    near : dict
        By name of a cause, the rivals that did nearly as well.
    reasons : dict
        By name, why a cause was put away.
    tried : int
        Number of causes tried.
    rough : Scene, optional
        The record with longer model rows, for screening.
    """

    task: Task
    model: Extended
    plain: Extended
    evidence: dict[str, Evidence] = field(default_factory=dict)
    near: dict[str, tuple[str, ...]] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    tried: int = 0
    rough: Scene | None = None


def search(task: Task, start: Extended, progress: Progress, rough: Scene | None = None) -> Found:
    """Fit the plain model, then add causes while one of them stands up to all tests."""
    progress(0.05, 'simulation fitted to the record')
    task, plain, _ = settle(task, start, rounds=2, steps=4)
    task, plain = without_bumps(task, plain)
    found = Found(task, plain, plain, rough=rough)
    barred: set[str] = set()
    for name, cause in catalogue().items():
        if why := cause.hindered(task.scene):
            found.reasons[name] = f'cannot be judged: {why}'
            barred.add(name)
    found.tried = len(catalogue()) - len(barred)
    for turn in range(MOST_CAUSES):
        progress(0.15 + 0.15 * turn, 'causes tried' if turn == 0 else 'further causes tried')
        if not _add(found, barred):
            break
        _drop_weak(found, barred)
        _conceal(found, barred)
    return found


def _conceal(found: Found, barred: set[str]) -> None:
    """Put away what cannot be judged beside the causes taken."""
    for a in found.model.active:
        for name, cause in catalogue().items():
            if cause.family in a.cause.conceals and name not in (*barred, *found.model.names):
                found.reasons.setdefault(name, f'cannot be judged beside {a.name}')
                barred.add(name)


def _add(found: Found, barred: set[str]) -> bool:
    """Add the best cause if it stands up; tell whether it did."""
    rivals = _rivals(found, barred)
    if not rivals:
        return False
    best = rivals[0].score
    for rival in rivals:
        if rival.score - best > NOT_TOLD_APART:
            break
        if beyond := rival.added.beyond:
            found.reasons[rival.added.name] = beyond
            continue
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
                    f'{name} explains the data better, by {by:.1f} in log-likelihood'
                )
        if rival.added.cause.of_model and not found.task.fixed_dynamics:
            _absorb(found, rival)
        else:
            _take(found, rival, evidence.gain)
        return True
    return False


def _take(found: Found, rival: Rival, gain: float) -> None:
    """Fit the model with its new cause, and find curve and regions anew where that is due."""
    found.task, settled, _ = settle(found.task, rival.model, rounds=1, steps=3)
    found.model = held(found.task.scene, settled, found.task.ar)
    if gain > STRONG and not found.task.fixed_dynamics:
        found.task, found.model = rebuilt(found.task, found.model)


def _absorb(found: Found, rival: Rival) -> None:
    """Make what an identification may find too a part of the plain model: it is no fault."""
    name = rival.added.name
    found.evidence.pop(name, None)
    found.near.pop(name, None)
    found.reasons[name] = 'it became a part of the plain model, which was free to have it'
    whole = replace(rival.model.without(name), base=rival.model.regional)
    found.task, found.model, _ = settle(found.task, whole, rounds=1, steps=3)
    plain = replace(found.plain, base=rival.added.cause.act(found.plain.base, rival.added.values))
    found.plain, _ = improve(found.task, plain, 4)


def _shortlist(bench: Bench, barred: set[str]) -> list[tuple[str, Start]]:
    """Return starts worth a full refit: the best, and the families of the best."""
    starts: dict[str, list[Start]] = {}
    for name, cause in catalogue().items():
        if name not in barred and name not in bench.model.names:
            starts[name] = list(cause.starts(bench))
    best = {n: max(s.gain for s in found) for n, found in starts.items() if found}
    if not best or max(best.values()) < SCREEN_LEAST:
        return []
    least = max(SCREEN_LEAST, SCREEN_SHARE * max(best.values()))
    good = sorted((n for n in best if best[n] >= least), key=lambda n: -best[n])[:MOST_RIVALS]
    families = {catalogue()[n].family for n in good}
    good += [n for n in best if n not in good and catalogue()[n].family in families]
    return [(n, s) for n in good for s in starts[n]]


def _rivals(found: Found, barred: set[str]) -> list[Rival]:
    """Refit every promising cause; best score first, one entry a cause."""
    bench = Bench(found.task, found.model, found.rough)
    shortlist = _shortlist(bench, barred)
    tangents = base_tangents(found.task, found.model) if shortlist else None
    refits = []
    for name, start in shortlist:
        added = Active(catalogue()[name], start.values, start.extra)
        model, frozen = found.model, tangents
        if start.base is not None:
            model, frozen = replace(model, base=start.base), None
        refits.append(_refit(found.task, model.with_cause(added), frozen))
    if not refits:
        return []
    # The noise is what the best of them leaves.
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
    """Return a rival that contains a simpler one scored by what it has more, and by that alone.

    Several draws of the noise smooth a path, and that is worth something without any jump.
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
        tangents = None  # it holds one delay, which changes the columns
    model, cost = improve(task, model, 3, tangents)
    model, cost = search_lines(task, model, cost)
    model, cost = search_levels(task, model, cost, _SHORT_STEPS_MW)
    return improve(task, model, 3, tangents)


def _drop_weak(found: Found, barred: set[str]) -> None:
    """Take out each earlier cause that the later ones have made superfluous."""
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
            found.reasons[a.name] = f'the causes found later leave it only {loss:.1f} to explain'
            barred.add(a.name)
