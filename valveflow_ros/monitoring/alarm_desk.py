"""Where the alarms come together: fed in the order of the rows, handled by an operator."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from valveflow_ros.config import Settings
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarm_records import AlarmChange, Judged
from valveflow_ros.monitoring.alarms import ResidualAlarm
from valveflow_ros.monitoring.shift_alarm import ShiftAlarm

if TYPE_CHECKING:
    from valveflow_ros.monitoring.prediction import PredictionBlock


# Something an operator does: what was judged last, and by which curve, in; changes out.
Act = Callable[[Judged, str], list[AlarmChange]]


class AlarmDesk:
    """Hold all alarms of the monitor.

    Parameters
    ----------
    residual : ResidualAlarm
    shift : ShiftAlarm
    """

    def __init__(self, residual: ResidualAlarm, shift: ShiftAlarm) -> None:
        self._residual, self._shift = residual, shift
        self._all = residual, shift
        for alarm in self._all:
            alarm.stand_beside(self._all)

    def configure(self, settings: Settings) -> None:
        """Take new settings; states and counters stay."""
        for alarm in self._all:
            alarm.configure(settings)

    def feed(self, block: PredictionBlock) -> list[AlarmChange]:
        """Judge predicted rows; return what changes, in the order of the rows."""
        judged = np.where(np.isfinite(block.residual_mw), block.evidence, np.nan)
        changes = self._residual.feed(
            block.time_ns, judged, block.shift_mw, block.model_id, [self._shift]
        )
        return [change for _, change in changes]

    def acknowledge(self, judged: Judged, model_id: str) -> list[AlarmChange]:
        """Acknowledge all alarms.

        Raises
        ------
        DataError
            There is nothing to acknowledge.
        """
        self._residual.judged = judged
        changes = [c for a in self._all for c in a.acknowledge(judged.time_ns, model_id)]
        if not changes:
            raise DataError('There is no alarm to acknowledge.')
        return changes

    def shelve(self, judged: Judged, model_id: str) -> list[AlarmChange]:
        """Put all alarms that stand aside for a time.

        Raises
        ------
        DataError
            None stands that is not shelved already.
        """
        self._residual.judged = judged
        done = [alarm.shelve(judged.time_ns, model_id) for alarm in self._all]
        return _changes(done, 'There is no alarm to shelve.')

    def unshelve(self, judged: Judged, model_id: str) -> list[AlarmChange]:
        """Take all alarms from the shelf; one that the flood limit holds back comes later.

        Raises
        ------
        DataError
            None is shelved.
        """
        self._residual.judged = judged
        done = [alarm.unshelve(judged.time_ns, model_id) for alarm in self._all]
        return _changes(done, 'There is no shelved alarm.')


def _changes(done: list[tuple[bool, list[AlarmChange]]], otherwise: str) -> list[AlarmChange]:
    """Return the changes of all alarms; say so if nothing was done to any."""
    if not any(did for did, _ in done):
        raise DataError(otherwise)
    return [change for _, changes in done for change in changes]
