"""The curve that predicts, what it is worth, and why."""

from __future__ import annotations

from valveflow_ros.config import Settings
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.monitoring.curve_status import CurveStatus
from valveflow_ros.monitoring.feeding import Rows
from valveflow_ros.monitoring.prediction import PredictionBlock, Predictor, no_prediction
from valveflow_ros.records import ByteArray
from valveflow_ros.segments.window import RollingWindow
from valveflow_ros.state import State


class CurveInForce:
    """Holds the running curve and its predictor.

    Parameters
    ----------
    settings : Settings

    Attributes
    ----------
    status : CurveStatus
    cause : str
        Why there is no curve, or only a stale one; empty if it is fresh.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._predictor: Predictor | None = None
        self.status = CurveStatus.UNKNOWN
        self.cause = 'No curve yet: not enough special segments.'

    @property
    def characteristic(self) -> Characteristic | None:
        """Return the running curve."""
        return None if self._predictor is None else self._predictor.characteristic

    def configure(self, settings: Settings) -> None:
        """Take settings of which only live ones differ."""
        self._settings = settings
        if self._predictor is not None:
            self._predictor.limit_mw = settings.real('alarm_limit')

    def adopt(self, characteristic: Characteristic, window: RollingWindow) -> None:
        """Predict from another curve; the evidence that the last one had gathered stays."""
        before, self._predictor = self._predictor, Predictor.of(characteristic, self._settings)
        if before is not None:
            self._predictor.follow(before)
        self._predictor.warm_up(*window.tail(self._predictor.warm_up_rows))
        self.status, self.cause = CurveStatus.FRESH, ''

    def refuse(self, reason: str) -> None:
        """Keep the old curve as stale, if there is one."""
        self.status = CurveStatus.REFUSED if self._predictor is None else CurveStatus.STALE
        self.cause = reason

    def restart(self, reason: str) -> None:
        """Begin anew with the curve there is, after the clock went back."""
        if self._predictor is not None:
            self._predictor = Predictor.of(self._predictor.characteristic, self._settings)
            self.status, self.cause = CurveStatus.STALE, reason

    def predict(self, rows: Rows, kinds: ByteArray) -> PredictionBlock:
        """Predict rows; ``kinds`` are the segmenter's."""
        columns = rows.time_ns, rows.u, rows.power_mw, kinds
        if self._predictor is None:
            return rows.shown(no_prediction(*columns))
        return rows.shown(self._predictor.predict(*columns))

    def snapshot(self) -> State:
        """Return what is remembered; see `core.state`."""
        predictor, curve = self._predictor, self.characteristic
        return {
            'curve': None if curve is None else to_json(curve),
            'predictor': None if predictor is None else predictor.snapshot(),
            'status': int(self.status),
            'cause': self.cause,
        }

    def restore(self, saved: State) -> None:
        """Go on from a snapshot; raises `DataError` if it does not fit."""
        if saved['curve'] is not None:
            self._predictor = Predictor.of(from_json(saved['curve']), self._settings)
            self._predictor.restore(saved['predictor'])
        self.status, self.cause = CurveStatus(saved['status']), saved['cause']
