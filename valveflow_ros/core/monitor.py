"""The engine: rows in, events out. No clock, no files, no threads, no ROS."""

from __future__ import annotations

import enum
import json
import math
from dataclasses import dataclass

import numpy as np

from valveflow_ros.config import Settings, parameter
from valveflow_ros.core.alarms import ResidualAlarm
from valveflow_ros.core.characteristic import Characteristic
from valveflow_ros.core.events import (
    CurveAdopted,
    Event,
    FitRequested,
    JournalEntry,
    JournalKind,
    SegmentClosed,
)
from valveflow_ros.core.fit_task import FitTask
from valveflow_ros.core.prediction import PredictionBlock, Predictor, no_prediction
from valveflow_ros.core.segmenter import NoiseLevel, Segmented, Segmenter
from valveflow_ros.core.units import integrated_input
from valveflow_ros.core.window import RollingWindow
from valveflow_ros.errors import DataError, ParameterError
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, SampleTable, Signal

BY_HAND = 'asked for by hand'


class CurveStatus(enum.IntEnum):
    """What can be said of the running curve; the same numbers stand in the message.

    `STALE`: there is a curve, but the last fit was refused or the clock went
    back. `REFUSED`: there is none, and the last fit was refused.
    """

    UNKNOWN = 0
    FRESH = 1
    STALE = 2
    REFUSED = 3


@dataclass(frozen=True, slots=True)
class Fed:
    """What one call of `Monitor.feed` did.

    Attributes
    ----------
    rows : int
        Rows taken. Fewer than given after a `FitRequested`: whoever computes
        fits in place hands the outcome back before the rest is fed.
    events : list of Event
        In the order in which they happened.
    """

    rows: int
    events: list[Event]


@dataclass(frozen=True, slots=True)
class _Rows:
    """The columns of some rows, all of shape (n,)."""

    time_ns: IntArray
    u: FloatArray
    power_mw: FloatArray
    temperature_degc: FloatArray

    def part(self, start: int, end: int) -> _Rows:
        """Return the rows ``[start, end)`` without copying."""
        cut = slice(start, end)
        return _Rows(
            self.time_ns[cut], self.u[cut], self.power_mw[cut], self.temperature_degc[cut]
        )


class Monitor:
    """Keep the window, the segments, the curve, the predictions and the alarm.

    Parameters
    ----------
    settings : Settings

    Notes
    -----
    The state changes by rows and by the calls `adopt`, `refuse`, `acknowledge`,
    `request_fit`, `restart` and `reconfigure`, nothing else, and each such call leaves a
    `JournalEntry` with the number of rows before it. Rows and journal together
    give the same events again, bit for bit.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._step_s = settings.real('sample_period')
        self._segmenter = Segmenter(settings)
        self._window = RollingWindow(86400.0 * settings.real('window_days'), self._step_s)
        self._alarm = ResidualAlarm(settings)
        self._predictor: Predictor | None = None
        self._rows = 0
        self._last_ns = 0
        self._last_average = math.nan
        self._pending_ns: int | None = None
        self._last_request_ns: int | None = None
        self._last_name_ns = 0
        self._segments_at_request = 0
        self._segments_seen = 0
        self._wanted = False
        self.status = CurveStatus.UNKNOWN
        self.cause = 'No curve yet: not enough special segments.'

    @property
    def rows(self) -> int:
        """Return the number of rows taken so far."""
        return self._rows

    @property
    def last_ns(self) -> int:
        """Return the time of the newest row, 0 before the first."""
        return self._last_ns

    @property
    def characteristic(self) -> Characteristic | None:
        """Return the running curve."""
        return None if self._predictor is None else self._predictor.characteristic

    @property
    def alarm(self) -> ResidualAlarm:
        """Return the residual alarm."""
        return self._alarm

    @property
    def fit_pending(self) -> bool:
        """Tell whether a fit was asked for and its outcome is awaited."""
        return self._pending_ns is not None

    @property
    def segments(self) -> int:
        """Return the number of special segments in the window."""
        return self._window.segments

    @property
    def special_samples(self) -> int:
        """Return the number of samples in those segments."""
        return self._window.special_samples

    def noise(self) -> NoiseLevel:
        """Return the noise levels the thresholds stand on."""
        return self._segmenter.noise()

    def limit_mw(self) -> float:
        """Return the limit of the residual alarm; NaN without a curve."""
        if self._predictor is None:
            return math.nan
        fixed = self.settings.real('alarm_limit')
        if fixed > 0.0:
            return fixed
        sd = self._predictor.characteristic.residuals.average_sd_mw
        return max(self.settings.real('alarm_limit_sd') * sd, self.settings.real('alarm_floor'))

    def reconfigure(self, settings: Settings) -> list[Event]:
        """Take settings of which only live ones differ.

        Raises
        ------
        ParameterError
            One differs that may not be changed while the monitor runs.
        """
        changed = {k: v for k, v in settings.items() if v != self.settings[k]}
        for name in changed:
            if not parameter(name).live:
                raise ParameterError(name, 'cannot be changed while the monitor runs')
        if not changed:
            return []
        self.settings = settings
        self._alarm.configure(settings)
        text = json.dumps(changed, sort_keys=True)
        return [self._journal(JournalKind.SETTINGS, 0, '', text)]

    def feed(self, table: SampleTable) -> Fed:
        """Take rows until they end or a fit is wanted."""
        events: list[Event] = []
        rows = self._columns(table)
        done = 0
        while done < len(table):
            until, by_time = self._rows_until_due(table.time_ns[done:])
            taken, closed = self._take(rows.part(done, done + until), events)
            done += taken
            # Decisions fall only where a segment closes or the period ends, never where
            # a block happens to end: cutting must not matter.
            if self._due(closed, by_time and taken == until):
                events += self._ask()
                break
        return Fed(done, events)

    def adopt(self, request_ns: int, characteristic: Characteristic) -> list[Event]:
        """Let ``characteristic`` predict from the next row on.

        An outcome of a request that is no longer awaited is ignored.
        """
        if request_ns != self._pending_ns:
            return []
        self._pending_ns = None
        self._predictor = Predictor(
            characteristic, self._step_s, self.settings.settle_s,
            self.settings.real('alarm_average'),
        )  # fmt: skip
        self._predictor.warm_up(*self._window.tail(self._predictor.warm_up_rows))
        self.status = CurveStatus.FRESH
        self.cause = ''
        entry = self._journal(JournalKind.FIT_ADOPTED, request_ns, characteristic.model_id, '')
        return [CurveAdopted(characteristic), entry]

    def refuse(self, request_ns: int, reason: str) -> list[Event]:
        """Note that a fit gave no curve; the old one stays, as stale."""
        if request_ns != self._pending_ns:
            return []
        self._pending_ns = None
        self.status = CurveStatus.REFUSED if self._predictor is None else CurveStatus.STALE
        self.cause = reason
        return [self._journal(JournalKind.FIT_REFUSED, request_ns, '', reason)]

    def request_fit(self) -> list[Event]:
        """Ask for a fit now.

        Raises
        ------
        DataError
            One is running already, or there is nothing to fit.
        """
        if self._pending_ns is not None:
            raise DataError('A fit is running already.')
        if not self._window.segments:
            raise DataError('There is no special segment to fit yet.')
        return self._ask(BY_HAND)

    def acknowledge(self) -> list[Event]:
        """Acknowledge the alarm.

        Raises
        ------
        DataError
            There is nothing to acknowledge.
        """
        model_id = '' if self.characteristic is None else self.characteristic.model_id
        change = self._alarm.acknowledge(
            self._last_ns, self._last_average, self.limit_mw(), model_id
        )
        if change is None:
            raise DataError('There is no alarm to acknowledge.')
        return [change, self._journal(JournalKind.ACKNOWLEDGE, 0, model_id, '')]

    def restart(self, reason: str) -> list[Event]:
        """Forget the rows after the clock went back; curve and alarm stay."""
        pending = self._pending_ns
        events: list[Event] = []
        if pending is not None:
            events += self.refuse(pending, reason)
        self._segmenter = Segmenter(self.settings, self._segments_seen)
        self._window = RollingWindow(
            86400.0 * self.settings.real('window_days'), self._step_s
        )  # fmt: skip
        self._last_request_ns = None
        self._segments_at_request = self._segments_seen
        if self._predictor is not None:
            self._predictor = Predictor(
                self._predictor.characteristic, self._step_s, self.settings.settle_s,
                self.settings.real('alarm_average'),
            )  # fmt: skip
            self.status = CurveStatus.STALE
            self.cause = reason
        return [*events, self._journal(JournalKind.RESET, 0, '', reason)]

    def _columns(self, table: SampleTable) -> _Rows:
        """Return the columns the engine works on, u among them."""
        u = integrated_input(
            table.column(Signal.VALVE_OPENING),
            table.column(Signal.MAIN_STEAM_PRESSURE),
            self.settings.real('pressure_exponent'),
        )
        power = np.ascontiguousarray(table.column(Signal.GENERATED_POWER))
        temperature = np.ascontiguousarray(table.column(Signal.MAIN_STEAM_TEMPERATURE))
        return _Rows(table.time_ns, u, power, temperature)

    def _take(self, rows: _Rows, events: list[Event]) -> tuple[int, bool]:
        """Run rows up to the next segment's close through everything.

        Returns the rows taken and whether a segment closed at the last of them.
        """
        segmented = self._segmenter.feed(
            rows.time_ns, rows.u, rows.power_mw, rows.temperature_degc, most=1
        )
        n = segmented.rows
        rows = rows.part(0, n)
        self._window.append(rows.time_ns, rows.u, rows.power_mw, rows.temperature_degc)
        block = self._predict(rows, segmented)
        self._rows += n
        self._last_ns = int(rows.time_ns[-1])
        self._last_average = float(block.average_mw[-1])
        self._say(block, segmented, events)
        return n, bool(segmented.found)

    def _predict(self, rows: _Rows, segmented: Segmented) -> PredictionBlock:
        if self._predictor is None:
            return no_prediction(rows.time_ns, rows.u, rows.power_mw, segmented.kinds)
        return self._predictor.predict(
            rows.time_ns, rows.u, rows.power_mw, segmented.kinds, self.limit_mw()
        )

    def _say(self, block: PredictionBlock, segmented: Segmented, events: list[Event]) -> None:
        """Append what the rows brought; a segment can only have closed at the last of them."""
        events.append(block)
        if self._predictor is not None:
            judged = np.where(np.isfinite(block.residual_mw), block.average_mw, math.nan)
            changes = self._alarm.feed(block.time_ns, judged, block.limit_mw, block.model_id)
            events += [change for _, change in changes]
        self._close(segmented, events)

    def _close(self, segmented: Segmented, events: list[Event]) -> None:
        for _, found in segmented.found:
            self._window.add_segment(found)
            self._segments_seen += 1
            events.append(SegmentClosed(found.segment))

    def _may_ask(self) -> bool:
        """Tell whether a fit may be asked for by itself."""
        if self._pending_ns is not None or self.settings.real('refit_period') <= 0.0:
            return False
        # Data under alarm would teach the curve the very fault it should show.
        return not self._alarm.active

    def _rows_until_due(self, time_ns: IntArray) -> tuple[int, bool]:
        """Return how many rows to take before the period is over, and whether it is among them."""
        if self._last_request_ns is None:
            self._last_request_ns = int(time_ns[0])
        period_ns = round(self.settings.real('refit_period') * NS_PER_S)
        if period_ns == 0:
            return len(time_ns), False
        due = int(np.searchsorted(time_ns, self._last_request_ns + period_ns, side='left'))
        return (due + 1, True) if due < len(time_ns) else (len(time_ns), False)

    def _due(self, closed: bool, by_time: bool) -> bool:
        """Tell whether a fit is to be asked for at this boundary."""
        if by_time:
            self._last_request_ns = self._last_ns
        new = self._segments_seen - self._segments_at_request
        wanted = self.settings.whole('refit_segments')
        if not (by_time and new > 0) and not (closed and wanted > 0 and new >= wanted):
            return False
        enough = self._window.special_samples >= self.settings.whole('min_fit_samples')
        return enough and self._may_ask()

    def _ask(self, text: str = '') -> list[Event]:
        # Its time names a request; after the clock went back names must not come again.
        self._pending_ns = max(self._last_ns, self._last_name_ns + 1)
        self._last_name_ns = self._pending_ns
        self._last_request_ns = self._last_ns
        self._segments_at_request = self._segments_seen
        noise = self._segmenter.noise()
        task = FitTask(
            self._pending_ns, self._window.contents(), self.settings, noise.input, noise.power_mw
        )
        entry = self._journal(JournalKind.FIT_REQUESTED, self._pending_ns, '', text)
        return [entry, FitRequested(task)]

    def _journal(
        self, kind: JournalKind, request_ns: int, model_id: str, text: str
    ) -> JournalEntry:
        return JournalEntry(self._last_ns, kind, request_ns, self._rows, model_id, text)
