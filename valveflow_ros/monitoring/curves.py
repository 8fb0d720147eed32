# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The curve of the last fit, the predicting curve, and the time of the next fit."""

from __future__ import annotations

import enum

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.monitoring.prediction import PredictionBlock, Predictor, no_prediction
from valveflow_ros.monitoring.rows import Rows
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, ByteArray, IntArray
from valveflow_ros.segments.window import RollingWindow
from valveflow_ros.state import Memory, State


class CurveStatus(enum.IntEnum):
    """The status of the running curve; the message uses the same numbers.

    `STALE`: there is a curve, but the last fit was refused or the clock went
    back. `REFUSED`: there is no curve, and the last fit was refused. `PROVISIONAL`: the curve is
    fitted to rows since the onset of a fault, not to the healthy plant.
    """

    UNKNOWN = 0
    FRESH = 1
    STALE = 2
    REFUSED = 3
    PROVISIONAL = 4


NO_CURVE_YET = (
    'No curve yet: not enough samples in steady states and long ramps; min_fit_samples are needed.'
)


class RunningCurve:
    """The curve of the last fit, and the predictor.

    If there is a reference, it gives the predictions: a curve fitted to a fault would hide the
    fault.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._predictor: Predictor | None = None
        self.characteristic: Characteristic | None = None  # the curve of the last fit
        self.status = CurveStatus.UNKNOWN
        # Why there is no curve, or only a stale or provisional one; empty if it is up to date.
        self.cause = NO_CURVE_YET

    @property
    def predicting(self) -> Characteristic | None:
        """Return the curve used for predictions."""
        return None if self._predictor is None else self._predictor.characteristic

    def configure(self, settings: Settings) -> None:
        """Apply settings in which only live parameters differ."""
        self._settings = settings
        if self._predictor is not None:
            self._predictor.configure(settings)

    def adopt(self, characteristic: Characteristic, provisional: str = '') -> None:
        """Store the curve of a fit; ``provisional`` says why the plant was not healthy."""
        self.characteristic, self.cause = characteristic, provisional
        self.status = CurveStatus.PROVISIONAL if provisional else CurveStatus.FRESH

    def predict_from(
        self, curve: Characteristic, window: RollingWindow, *, afresh: bool = False
    ) -> None:
        """Use another curve for predictions.

        The accumulated evidence is kept, unless ``afresh`` is given.
        """
        before, self._predictor = self._predictor, Predictor.of(curve, self._settings)
        if before is not None and not afresh:
            self._predictor.follow(before)
        self._predictor.warm_up(*window.tail(self._predictor.warm_up_rows))

    def refuse(self, reason: str) -> None:
        """Mark the old curve as stale, if there is one."""
        self.status = CurveStatus.REFUSED if self.characteristic is None else CurveStatus.STALE
        self.cause = reason

    def restart(self, reason: str) -> None:
        """Restart the prediction with the current curve, after the clock went back."""
        if self._predictor is not None:
            self._predictor = Predictor.of(self._predictor.characteristic, self._settings)
            self.status, self.cause = CurveStatus.STALE, reason

    def predict(self, rows: Rows, kinds: ByteArray) -> PredictionBlock:
        """Predict rows; ``kinds`` are those of the segmenter."""
        columns = rows.time_ns, rows.u, rows.power_mw, kinds
        if self._predictor is None:
            return rows.shown(no_prediction(*columns))
        return rows.shown(self._predictor.predict(*columns, rows.opening_percent))

    def snapshot(self) -> State:
        """Return the state."""
        predictor, curve = self._predictor, self.characteristic
        return {
            'curve': None if curve is None else to_json(curve),
            'predicting': None if predictor is None else to_json(predictor.characteristic),
            'predictor': None if predictor is None else predictor.snapshot(),
            'status': int(self.status),
            'cause': self.cause,
        }

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""
        if saved['curve'] is not None:
            self.characteristic = from_json(saved['curve'])
        # In states of earlier versions the running curve gives the predictions.
        predicting = saved.get('predicting', saved['curve'])
        if predicting is not None:
            self._predictor = Predictor.of(from_json(predicting), self._settings)
            if saved['predictor'] is not None:
                self._predictor.restore(saved['predictor'])
        self.status, self.cause = CurveStatus(saved['status']), saved['cause']


class Refits(Memory):
    """Count segments and time until the next request, and name requests.

    The name of a request is the time of the last row before it.
    """

    REMEMBERED = (
        'pending_ns', '_last_ns', '_later_ns', '_last_name_ns', '_segments_at_request',
        'segments_seen',
    )  # fmt: skip

    def __init__(self) -> None:
        self.pending_ns: int | None = None
        self._last_ns: int | None = None
        self._later_ns: int | None = None
        self._last_name_ns = 0
        self._segments_at_request = 0
        self.segments_seen = 0

    def rows_until_due(self, time_ns: IntArray, settings: Settings) -> tuple[int, bool]:
        """Return the number of rows up to the end of the period, and whether it is among them."""
        if self._last_ns is None:
            self._last_ns = int(time_ns[0])
        elif time_ns[0] < self._last_ns:
            # After the clock went back the period must not become longer. If the clock then jumps
            # forward again, the period does not end at once.
            self._later_ns, self._last_ns = self._last_ns, int(time_ns[0])
        over = len(time_ns)
        if self._later_ns is not None:
            over = int(np.searchsorted(time_ns, self._later_ns, side='right'))
            if over == 0:
                self._last_ns, self._later_ns, over = self._later_ns, None, len(time_ns)
        period_ns = round(settings.real('refit_period') * NS_PER_S)
        if period_ns == 0:
            return over, False
        due = int(np.searchsorted(time_ns, self._last_ns + period_ns, side='left'))
        return (due + 1, True) if due < over else (over, False)

    def due(
        self, last_ns: int, closed: bool, by_time: bool, settings: Settings, segments: int
    ) -> bool:
        """Return True if the time or the segments since the last request require a new one.

        At the newest row, of ``last_ns``, a segment may have ``closed`` or the period ended
        (``by_time``). Some of the ``segments`` available to a fit must be new: otherwise the curve
        would not change.
        """
        if by_time:
            self._last_ns = last_ns
        if self.pending_ns is not None or settings.real('refit_period') <= 0.0:
            return False
        new = self.segments_seen - self._segments_at_request
        wanted = settings.whole('refit_segments')
        if new < settings.real('refit_share') * segments:
            return False
        return (by_time and new > 0) or (closed and wanted > 0 and new >= wanted)

    def ask(self, last_ns: int) -> int:
        """Record a request made now; return its name."""
        # After the clock went back names must not repeat.
        self.pending_ns = max(last_ns, self._last_name_ns + 1)
        self._last_name_ns = self.pending_ns
        self._last_ns, self._later_ns = last_ns, None
        self._segments_at_request = self.segments_seen
        return self.pending_ns

    def settle(self, request_ns: int) -> bool:
        """Accept an outcome; return True if it was expected."""
        if request_ns != self.pending_ns:
            return False
        self.pending_ns = None
        return True

    def ask_again(self, segments: int = 1) -> None:
        """Cancel the pending request; count this many segments as new."""
        if self.pending_ns is not None:
            self.pending_ns = None
            self.count_as_new(segments)

    def count_as_new(self, segments: int = 1) -> None:
        """Count this many of the last segments as new."""
        self._segments_at_request = min(self._segments_at_request, self.segments_seen - segments)
