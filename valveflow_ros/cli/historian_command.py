"""The command line that would import a table that was refused."""

from __future__ import annotations

import os
from argparse import Namespace
from pathlib import Path

from valveflow_ros.cli.historian_open import subject
from valveflow_ros.cli.options import About, read_mapping
from valveflow_ros.logs.tables.refusal import THEIRS, RefusedError, Remedy, quoted

_FLAGS = ('dry_run', 'overwrite', 'quiet', 'json')
# Of these the table shows that one is needed, and not which.
_CHOICES = ('time-zone', 'date-order', 'decimal', 'sheet')


def told(refused: RefusedError, options: Namespace) -> str:
    """Return what is open, and below it the whole command with everything said."""
    if not refused.remedies:
        return refused.listing
    checks = []
    if any(r.value.endswith(f'={THEIRS}') for r in refused.remedies):
        checks.append(f'with your names in place of {THEIRS}')
    if any(r.option in _CHOICES for r in refused.remedies) or ' or --' in refused.listing:
        checks.append('with the first of each choice: check it')
    head = ', '.join(['Then this reads it', *checks])
    return f'{refused.listing.rstrip()}\n{head}:\n  {command(refused, options)}'


def command(refused: RefusedError, options: Namespace) -> str:
    """Return the command as it was given, with the options that were missing."""
    new = {_canonical(remedy) for remedy in refused.remedies}
    words = ['valveflow', 'import', _place(options.table)]
    if options.output is not None:
        words += ['-o', _place(options.output)]
    words += [f'--{name.replace("_", "-")}' for name in _FLAGS if getattr(options, name, False)]
    words += [str(old) for old in _given(options) if _canonical(old) not in new]
    return ' '.join([*words, refused.options])


def _place(path: Path) -> str:
    """Return a path as a shell takes it, and as no option."""
    told = str(path)
    return quoted(f'.{os.sep}{told}' if told.startswith('-') else told)


def _given(options: Namespace) -> list[Remedy]:
    given = [
        Remedy(said.name.replace('_', '-'), said.value)
        if isinstance(said, About)
        else Remedy('column', said)
        for said in options.column
    ]
    return given + [Remedy('constant', said) for said in options.constant]


def _canonical(remedy: Remedy) -> str:
    """Return what an option speaks of, whichever of a signal's names was used."""
    if remedy.option == 'column':
        return next(iter(read_mapping([remedy.value], []).columns))
    return subject(remedy) if remedy.option != 'constant' else remedy.value
