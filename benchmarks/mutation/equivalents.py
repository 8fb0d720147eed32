"""Mistakes that change nothing anybody could see, each with the reason, judged by hand."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.mutation.sites import Mutant


@dataclass(frozen=True)
class Equivalent:
    """A mistake as `Mutant` writes it down; without ``nth`` all equal ones of the function."""

    module: str
    function: str
    before: str
    after: str
    reason: str
    nth: int | None = None


TABLE: tuple[Equivalent, ...] = (
    Equivalent(
        'ros/state_folder', '_in_use',
        "owner = f' (process {int(lock.read_text()[:20])})'",
        "owner = f' (process {int(lock.read_text()[:21])})'",
        'A process number has seven digits at most: both read the whole of it.',
    ),
    Equivalent(
        'ros/state_folder', '_locked', 'os.ftruncate(descriptor, 0)',
        'os.ftruncate(descriptor, 1)',
        'The byte that stays is overwritten: a number and its line end are two bytes at least.',
    ),
    Equivalent(
        'logs/recover', '_holds_nothing', 'chunks = sum((1 for _ in scanner.chunks()))',
        'chunks = sum((2 for _ in scanner.chunks()))',
        'It is asked only whether there is any chunk, and twice as many is any as well.',
    ),
)  # fmt: skip


def reason_for(mutant: Mutant) -> str:
    """Return why a mutant is equivalent; empty if it is not known to be."""
    for known in TABLE:
        same = (known.function, known.before, known.after)
        if (
            mutant.module.endswith(f'/{known.module}.py')
            and same == (mutant.function, mutant.before, mutant.after)
            and known.nth in (None, mutant.nth)
        ):
            return known.reason
    return ''
