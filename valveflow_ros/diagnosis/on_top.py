"""A record freed of the causes of an earlier model, to be diagnosed on top of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.diagnosis.cause import Stage
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.diagnose import Record
from valveflow_ros.diagnosis.extended_model import ExtendedModel
from valveflow_ros.records import Quality, SampleTable, Signal


def on_top(record: Record, earlier: ExtendedModel, measured: SampleTable) -> Record:
    """Return the record with what a diagnosis on top of an earlier model needs.

    Parameters
    ----------
    record : Record
        Its table was freed of the causes of ``earlier``.
    measured : SampleTable
        The rows of the record before that.

    Notes
    -----
    Where the opening was changed it is no longer the position that a command leads to, so
    the command is left out: it would show the earlier cause again.
    """
    rows = record.table
    if _changes_opening(earlier):
        values, quality = rows.values.copy(), rows.quality.copy()
        values[:, Signal.VALVE_COMMAND] = np.nan
        quality[:, Signal.VALVE_COMMAND] = Quality.BAD
        rows = SampleTable(rows.time_ns, values, quality)
    return replace(record, table=rows, measured=measured)


def freed(record: Record, held: tuple[HeldCause, ...]) -> Record:
    """Return a record whose rows were freed of causes, where those as measured are gone.

    A stop or a slack that was taken into the opening lets it rest for hours, which is no dead
    transmitter: faults of the opening are not looked for then.
    """
    if not any(catalogue()[h.name].stage == Stage.OPENING for h in held):
        return record
    values, quality = record.table.values.copy(), record.table.quality.copy()
    values[:, Signal.VALVE_OPENING] = np.nan
    quality[:, Signal.VALVE_OPENING] = Quality.BAD
    return replace(record, measured=SampleTable(record.table.time_ns, values, quality))


def _changes_opening(model: ExtendedModel | None) -> bool:
    return model is not None and (
        any(a.cause.stage in (Stage.OPENING, Stage.INPUT) for a in model.model.active)
        or _changes_opening(model.on_top_of)
    )
