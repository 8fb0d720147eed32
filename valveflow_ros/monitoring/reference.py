"""The reference of the running monitor: kept, and what later curves are judged against."""

from __future__ import annotations

from collections.abc import Sequence

from valveflow_ros.config import Settings
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.curve.shift import Shift, ShiftLimits, judge_shift
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.shift_alarm import ShiftAlarm
from valveflow_ros.records import SpecialSegment
from valveflow_ros.state import State


class ReferenceKeeper:
    """Keep the reference and the alarm on a shift.

    Parameters
    ----------
    settings : Settings
    """

    def __init__(self, settings: Settings) -> None:
        self.curve: Characteristic | None = None
        self.shift: Shift | None = None
        self.problem = ''
        self.alarm = ShiftAlarm(settings)

    def snapshot(self) -> State:
        """Return what is remembered; see `core.state`. The last judgement is not."""
        return {
            'curve': None if self.curve is None else to_json(self.curve),
            'problem': self.problem,
            'alarm': self.alarm.snapshot(),
        }

    def restore(self, saved: State) -> None:
        """Go on from a state; raises `DataError` if it does not fit."""
        self.curve = None if saved['curve'] is None else from_json(saved['curve'])
        self.problem = saved['problem']
        self.alarm.restore(saved['alarm'])

    def set(self, curve: Characteristic, time_ns: int, settings: Settings) -> list[AlarmChange]:
        """Judge against ``curve`` from the next adoption on.

        Raises
        ------
        DataError
            The curve's input u is not the one of this monitor.
        """
        exponent = settings.real('pressure_exponent')
        if curve.pressure_exponent != exponent:
            raise DataError(
                f'The reference has the pressure exponent {curve.pressure_exponent:g}, the '
                f'monitor {exponent:g}: their inputs u are not the same thing.'
            )
        self.curve = curve
        self.shift, self.problem = None, ''
        return self.alarm.end('There is a new reference.', time_ns, curve.model_id, settings)

    def judge(
        self,
        current: Characteristic,
        segments: Sequence[SpecialSegment],
        time_ns: int,
        settings: Settings,
    ) -> tuple[Shift | None, list[AlarmChange]]:
        """Judge a curve that was adopted; None without a reference it can be compared with.

        Parameters
        ----------
        current : Characteristic
        segments : sequence of SpecialSegment
            Those of the window, in order of time.
        time_ns : int
        settings : Settings
        """
        self.shift, self.problem = None, ''
        if self.curve is None:
            return None, []
        limits = ShiftLimits(settings.real('shift_confidence'), settings.real('shift_least'))
        try:
            self.shift = judge_shift(self.curve, current, segments, limits)
        except DataError as error:
            self.problem = str(error)
            return None, self.alarm.unjudged(
                self.problem, time_ns, current.model_id, settings
            )  # fmt: skip
        return self.shift, self.alarm.judge(self.shift, time_ns, settings)
