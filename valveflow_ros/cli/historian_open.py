"""Everything a table leaves open, found in one go, with the options that would decide it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

from valveflow_ros.cli.options import Constant, LogMapping, read_mapping
from valveflow_ros.cli.usage import UsageError
from valveflow_ros.errors import ValveflowError
from valveflow_ros.logs.tables.refusal import THEIRS, RefusedError, Remedy

Result = TypeVar('Result')
_TABLE = {'time-zone': 'time_zone', 'date-order': 'date_order', 'decimal': 'decimal',
          'sheet': 'sheet'}  # fmt: skip
# In place of what nobody has named yet, to look on.
_USUAL = {
    'valve_opening': 50.0,
    'main_steam_pressure': 15.0,
    'main_steam_temperature': 540.0,
    'generated_power': 300.0,
    'valve_command': 50.0,
}
_MOST_LOOKS = 12
# Each further look may read the whole table.
LOOKING_ON = 'looking for what else the table leaves open'


def looked_through(
    path: object,
    look: Callable[[LogMapping], Result],
    mapping: LogMapping,
    again: Callable[[LogMapping], object] | None = None,
) -> Result:
    """Return what a look gives; where it is refused, look on as if the person had answered.

    Parameters
    ----------
    look : callable
        Raises `RefusedError` for what a table leaves open.
    mapping : Mapping
        What the person said.
    again : callable, optional
        Looks as `look` does; of what it understands it says nothing, only that it is at work.

    Raises
    ------
    RefusedError
        With everything that would have been refused, one after the other.
    """
    try:
        return look(mapping)
    except RefusedError as refused:
        found = [refused]
    remedies = list(found[0].remedies)
    for _ in range(_MOST_LOOKS):
        if found[-1].last:
            break
        try:
            mapping = answered(mapping, found[-1].remedies)
            (again or look)(mapping)
            break
        except RefusedError as refused:
            if not set(refused.remedies) - set(remedies):
                break
            found.append(refused)
            remedies += refused.remedies
        except (UsageError, ValveflowError):
            # What was open before has to be said first.
            break
    problems = [problem for refused in found for problem in _problems(refused, path)]
    raise RefusedError(path, problems, _newest(remedies), last=True) from None


def answered(mapping: LogMapping, remedies: Iterable[Remedy]) -> LogMapping:
    """Return the mapping with these options added; what is not known yet is left out of the look.

    Raises
    ------
    UsageError
        If the options cannot be read.
    """
    columns, constants, table = dict(mapping.columns), dict(mapping.constants), mapping.table
    for remedy in remedies:
        if remedy.option in _TABLE:
            table = replace(table, **{_TABLE[remedy.option]: remedy.value})
            continue
        ((name, column),) = read_mapping([remedy.value], []).columns.items()
        if column.theirs == THEIRS:
            if name not in _USUAL:
                raise UsageError(f'--column {name}={THEIRS} has to be answered first.')
            columns.pop(name, None)
            constants[name] = Constant(name, _USUAL[name], '')
        else:
            columns[name] = column
    return LogMapping(columns, constants, table)


def joined(path: object, refused: list[RefusedError]) -> RefusedError:
    """Return one refusal of all these, which were found when all of a table was read."""
    problems = [problem for one in refused for problem in _problems(one, path)]
    return RefusedError(path, problems, [r for one in refused for r in one.remedies], last=True)


def _problems(refused: RefusedError, path: object) -> list[str]:
    """Return what a refusal says, with the column if it names one."""
    about = refused.where.removeprefix(str(path)).lstrip(': ')
    return [f'{about}: {problem}' if about else problem for problem in refused.problems]


def _newest(remedies: list[Remedy]) -> list[Remedy]:
    """Return the options without those that a later one replaces."""
    return list({subject(remedy): remedy for remedy in remedies}.values())


def subject(remedy: Remedy) -> str:
    """Return what an option speaks of: a second one takes the place of the first."""
    return remedy.value.partition('=')[0].strip() if remedy.option == 'column' else remedy.option
