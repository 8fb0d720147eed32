# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``monitor``: run the monitor over a log, and read the outputs of a recorded monitor."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from valveflow_ros import __version__
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.shift import minute
from valveflow_ros.diagnosis.extended import ExtendedModel
from valveflow_ros.diagnosis.from_window import diagnose_window
from valveflow_ros.errors import RecordingError
from valveflow_ros.interface import SILENT, Progress
from valveflow_ros.interface.files import Result, as_text
from valveflow_ros.interface.logs import Log, as_log
from valveflow_ros.interface.models import load_extended, taken_curve, taken_model
from valveflow_ros.interface.observation import Covariates, check_signals, taken_covariates
from valveflow_ros.interface.settings import settings_for
from valveflow_ros.logs import LogContents
from valveflow_ros.monitoring import events as told
from valveflow_ros.monitoring.alarm_state import AlarmChange, AlarmState
from valveflow_ros.monitoring.alarms import ResidualAlarm, ShiftAlarm
from valveflow_ros.monitoring.diagnosis_requests import onset_ns
from valveflow_ros.monitoring.events import Event, JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_aligned
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.monitoring.reference import Wear
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, SampleTable
from valveflow_ros.report import history as reported
from valveflow_ros.report import page as html
from valveflow_ros.report import words
from valveflow_ros.report.figure import Figure
from valveflow_ros.report.terminal.board import ALARM, CURVE, DIAGNOSIS
from valveflow_ros.report.words import counted, moment
from valveflow_ros.signals.align import Aligner, aligned_blocks

# Switches the diagnoses off: each takes as long as `diagnose` over the window.
_NO_DIAGNOSIS = {'diagnosis_on_mismatch': False, 'diagnosis_hour': -1}
_RESIDUAL = ResidualAlarm.NAME
Kind = TypeVar('Kind')


@dataclass(frozen=True, slots=True, repr=False)
class MonitorResult(Result):
    """The outputs of a monitor over a log.

    Attributes
    ----------
    source : str
        Name of the log.
    events : tuple of Event
        All events of the engine, in order.
    start_ns, end_ns : int
        First and last row.
    settings : Settings
    wear : Wear or None
        The slow change of the curve; None while it is unknown.
    """

    verb = 'monitor'
    source: str
    events: tuple[Event, ...]
    start_ns: int
    end_ns: int
    settings: Settings
    wear: Wear | None = None

    @property
    def output_unit(self) -> str:
        """Return the unit of the output."""
        return self.settings.output_unit

    def _events(self, kind: type[Kind]) -> list[Kind]:
        return [e for e in self.events if isinstance(e, kind)]

    def _times(self, kind: JournalKind) -> list[int]:
        return [e.time_ns for e in self._events(told.JournalEntry) if e.kind == kind]

    @property
    def _references(self) -> list[Characteristic]:
        return [e.characteristic for e in self._events(told.ReferenceSet)]

    @property
    def _diagnosed(self) -> list[told.Diagnosed]:
        return [e for e in self._events(told.Diagnosed) if e.content]

    @property
    def wear_words(self) -> str:
        """Return a sentence on the slow change of the curve; empty while it is unknown."""
        if self.wear is None:
            return ''
        since, unit = moment(self.wear.since_ns), self.output_unit
        return (
            f'Since {since} the curve has changed slowly by {words.signed(self.wear.total_mw)} '
            f'{unit}, {words.signed(self.wear.mw_per_month, 2)} {unit} a month.'
        )

    @property
    def reference_words(self) -> str:
        """Return a sentence on which curve is the reference, or why there is none."""
        if references := self._references:
            first_id, curve = references[0].model_id, references[-1]
            data = words.period(curve.source.window_start_ns, curve.source.window_end_ns)
            followed = (
                '' if curve.model_id == first_id
                else f' It followed the first reference, curve {first_id}, within the wear budget.'
            )  # fmt: skip
            return (
                f'The reference that later curves are compared with is curve {curve.model_id}, '
                f'from data of {data}.{followed}'
            )
        days = self.settings.real('reference_after')
        return (
            'There was no reference curve, so no shift could be found. A reference needs about '
            f'twice {days:g} days without a fault; or give one with --reference FILE.'
        )

    @property
    def curves(self) -> list[tuple[int, Characteristic]]:
        """Return each curve with the time (ns) of the last row before its adoption."""
        adopted = [e.characteristic for e in self._events(told.CurveAdopted)]
        return list(zip(self._times(JournalKind.FIT_ADOPTED), adopted, strict=True))

    @property
    def alarms(self) -> list[AlarmChange]:
        """Return the changes of the alarms' states, without repetitions."""
        return [c for c in self._events(AlarmChange) if c.state != c.previous]

    @property
    def diagnoses(self) -> list[tuple[int, dict[str, Any]]]:
        """Return each diagnosis: the time (ns) of its newest row, and the content of its JSON."""
        return [(e.task.window_end_ns, json.loads(e.content)) for e in self._diagnosed]

    def predictions(self) -> dict[str, IntArray | FloatArray]:
        """Return the predictions as arrays of shape (rows,), named as in `PredictionBlock`."""
        names = ('time_ns', 'u', 'measured_mw', 'static_mw', 'dynamic_mw', 'residual_mw',
                 'average_mw', 'evidence', 'shift_mw', 'state')  # fmt: skip
        return self._predicted(*names)

    def _predicted(self, *names: str) -> dict[str, Any]:
        blocks = self._events(PredictionBlock)
        return {n: np.concatenate([getattr(b, n) for b in blocks]) for n in names if blocks}

    def _judged(self) -> tuple[IntArray, FloatArray, FloatArray] | None:
        """Return time, mean residual and evidence, NaN where the alarm does not judge.

        The result is in the order of time, and None if nothing was judged.
        """
        rows = self._predicted('time_ns', 'residual_mw', 'average_mw', 'evidence')
        if not rows:
            return None
        order = np.argsort(rows['time_ns'], kind='stable')  # the clock may have gone back
        time_ns, residual, average, evidence = (column[order] for column in rows.values())
        judged = np.isfinite(residual) & np.isfinite(evidence)
        if not judged.any():
            return None
        return time_ns, np.where(judged, average, np.nan), np.where(judged, evidence, np.nan)

    @property
    def largest_evidence(self) -> tuple[int, float] | None:
        """Return the time (ns) and the largest evidence of the residual alarm outside alarms.

        The evidence is a share of the limit; None if there were no such rows.
        """
        judged = self._judged()
        if judged is None:
            return None
        time_ns, _, evidence = judged
        spans = reported.standing_spans(self.history(), _RESIDUAL)
        return reported.largest_evidence(time_ns, evidence, spans)

    @property
    def evidence_words(self) -> str:
        """Return a sentence on how near the residual came to an alarm; empty if not judged."""
        largest = self.largest_evidence
        if largest is None:
            return ''
        at, share = largest
        delay = words.duration(self.settings.real('alarm_on_delay'))
        short = (
            f' It was beyond the limit, but not for alarm_on_delay ({delay}).'
            if share > 1.0 else ''
        )  # fmt: skip
        return (
            f'Outside alarms, the evidence of the residual alarm reached at most '
            f'{words.percent(share)} of its limit, at {moment(at)}.{short}'
        )

    def history(self) -> reported.History:
        """Return curves, alarms and diagnoses as the reports show them."""
        return reported.History(
            self.start_ns,
            self.end_ns,
            tuple(_curve_moment(at, c) for at, c in self.curves),
            reported.alarms_of(
                reported.AlarmMoment(a.time_ns, a.name, a.state, a.sentence, a.state == a.previous)
                for a in self._events(AlarmChange)
            ),
            tuple(reported.DiagnosisMoment(at, d['sentence']) for at, d in self.diagnoses),
        )

    def _sentence(self) -> str:
        alarms = [sentence for _, sentence in self.standing] or ['No alarm stands at the end.']
        return ' '.join((f'{counted(len(self.curves), "curve")}.', *alarms, *self.named))

    def page(self) -> html.Page:
        """Return the report: the changes of the curve, and the outputs of the monitor."""
        about = f'{self.reference_words} {self.wear_words}'
        lead = ''.join(
            html.paragraph(html.text(line), 'where')
            for line in (self.source, words.period(self.start_ns, self.end_ns), about)
        )
        sections = [html.Section('The answer', self._answer()), *self._nearness()]
        sections += reported.history_sections(self.history())
        foot = (
            f'Made by valveflow {html.text(__version__)}. The same numbers without rounding are '
            'in monitor.json beside this page.'
        )
        return html.Page('What the monitor would have reported', lead, sections, foot, self.verb)

    def _nearness(self) -> list[html.Section]:
        """Return the section on how near the residual came to an alarm; none if not judged."""
        judged = self._judged()
        if judged is None:
            return []
        figure = reported.evidence_figure(
            *judged, reported.standing_spans(self.history(), _RESIDUAL),
            round(self.settings.real('sample_period') * NS_PER_S),
            self.settings.real('alarm_limit'),
        )  # fmt: skip
        words_too = [html.paragraph(self.evidence_words)] if self.evidence_words else []
        return [html.Section('How near the residual came to an alarm', [*words_too, figure])]

    def _answer(self) -> list[str | Figure]:
        """Return the state at the end, its reasons as far as known, and every diagnosis."""
        alarms, curves = self._alarms_json(), len(self.curves)
        parts: list[str | Figure] = [
            html.notice(f'<b>{html.text(name.replace("_", " "))}</b>: {html.text(sentence)}')
            for name, sentence in self.standing
        ]
        if not parts:
            gone = f' {counted(len(alarms), "alarm")} came and went.' if alarms else ''
            known = 'No alarm is active at the end.' if curves else 'No new curve was found.'
            parts.append(html.paragraph(known + gone, '' if gone or not curves else 'good'))
        if not self.diagnoses:
            return parts
        last = f'The last diagnosis: {self.diagnoses[-1][1]["sentence"]}'
        parts += [html.paragraph(html.text(line)) for line in (*self.named, last, *self.advice)]
        rows = [
            [moment(at), words.VERDICT_WORDS[d['verdict']], html.text(d['sentence'])]
            for at, d in self.diagnoses
        ]
        body = html.table(['data up to', 'verdict', 'what it said'], rows, sentences=True)
        return [*parts, html.folded(counted(len(rows), 'diagnosis', 'diagnoses'), body)]

    @property
    def standing(self) -> list[tuple[str, str]]:
        """Return the name of each alarm that stands at the end, and a sentence on it."""
        found_ns = onset_ns(self._diagnosed[-1].content) if self._diagnosed else None
        standing = []
        for alarm in self._alarms_json():
            if alarm['cleared'] is None:
                name, sentence = alarm['name'], alarm['sentence']
                # The curve alone often cannot tell when it moved.
                if name == ShiftAlarm.NAME and found_ns and found_ns <= alarm['raised']:
                    sentence += f' The diagnosis dates it to about {minute(found_ns)}.'
                standing.append((name, sentence))
        return standing

    @property
    def named(self) -> list[str]:
        """Return a sentence on each cause that any diagnosis named: how often, and first when."""
        times: dict[str, list[int]] = {}
        for at, d in self.diagnoses:
            for cause in d['causes']:
                times.setdefault(cause['name'], []).append(at)
        total = counted(len(self.diagnoses), 'diagnosis', 'diagnoses')
        return [
            f'{name} was named by {len(found)} of {total}, first with data up to '
            f'{moment(found[0])}.'
            + ('' if found[-1] == self.diagnoses[-1][0] else ' The last one does not name it.')
            for name, found in times.items()
        ]

    @property
    def advice(self) -> list[str]:
        """Return effect in MW and advice of the faults that were named last."""
        # A covariate is no fault: there is nothing to do.
        faults = [[c for c in d['causes'] if c['to_do']] for _, d in self.diagnoses]
        last: list[dict[str, Any]] = next((causes for causes in reversed(faults) if causes), [])
        return [words.advice(c['name'], c['meaning'], c['to_do']) for c in last]

    def texts(self) -> dict[str, str]:
        """Return ``monitor.json``; times are ns since 1970.

        ``largest_evidence`` is that of the residual alarm outside alarms, as a share of its limit.
        """
        largest, references = self.largest_evidence, self._references
        content = {
            'format': 'valveflow/monitor',
            'version': 1,
            'alarms': self._alarms_json(),
            'largest_evidence': largest and {'time': largest[0], 'share': largest[1]},
            'curves': [
                {
                    'adopted': at,
                    'model_id': c.model_id,
                    'window_from': c.source.window_start_ns,
                    'window_to': c.source.window_end_ns,
                }
                for at, c in self.curves
            ],
            'diagnoses': [
                {
                    'time': at,
                    'verdict': d['verdict'],
                    'causes': [cause['name'] for cause in d['causes']],
                }
                for at, d in self.diagnoses
            ],
            # A reference that is set before the first row has no time.
            'reference': {
                'set': max(self._times(JournalKind.SET_REFERENCE)[-1], self.start_ns),
                'model_id': references[-1].model_id,
            }
            if references
            else None,
            'wear': self.wear and self.wear._asdict(),
        }
        return {'monitor.json': as_text(content)}

    def _alarms_json(self) -> list[dict[str, Any]]:
        """Return one entry for each rise of an alarm, with the last report on it."""
        found: dict[tuple[str, int], dict[str, Any]] = {}
        for change in self._events(AlarmChange):
            stands = change.state in (AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED)
            key = change.name, change.occurrence
            if stands:
                entry = found.setdefault(
                    key,
                    {'name': change.name, 'raised': change.time_ns, 'cleared': None,
                     'state': '', 'sentence': ''},
                )  # fmt: skip
                if not entry['sentence'] or math.isfinite(change.value):
                    entry['sentence'] = change.sentence
            if key in found:
                found[key]['state'] = change.state.name.lower()
                found[key]['cleared'] = None if stands else found[key]['cleared'] or change.time_ns
        return list(found.values())


def monitor(
    log: Any,
    *,
    parameters: Mapping[str, Any] | None = None,
    model: ExtendedModel | str | Path | None = None,
    reference: Characteristic | str | Path | None = None,
    diagnose: bool = True,
    covariates: Mapping[str, str] | None = None,
    progress: Progress = SILENT,
) -> MonitorResult:
    """Run the monitor over a log as fast as possible; each fit is computed in this process.

    Parameters
    ----------
    log : Log, str, Path or pandas.DataFrame
        The result of `open_log`, or anything that it opens.
    parameters : mapping, optional
        Parameters of the monitor by name. Those that depend on the step of the data are adapted.
    model : ExtendedModel or path, optional
        An ``extended_model.json`` whose causes are removed from the rows first, like the
        parameter ``model_file`` of the node.
    reference : Characteristic or path, optional
        Every curve is compared with it, like the parameter ``reference_file`` of the node.
    diagnose : bool
        Also compute the diagnoses that the monitor requests; each takes as long as `diagnose`.
    covariates : mapping of str to str, optional
        Further columns that the diagnoses try as causes, given as in `diagnose`; by default
        the topics in the parameter ``covariates``.
    progress : Progress

    Raises
    ------
    DataError
        A required signal has no usable value.
    RecordingError, InputError
        A file cannot be read, or a parameter is wrong.
    """
    # A parameter file of `config init` has all parameters, so it must not decide.
    given = {**(parameters or {}), **({} if diagnose else _NO_DIAGNOSIS)}
    model, given = taken_model(model or given.get('model_file') or None, given, load_extended)
    reference = taken_curve(reference or given.get('reference_file') or None)
    covariates = taken_covariates(covariates, given)
    log = as_log(log, progress)
    # The window is as long as that of a live monitor, independent of the length of the log.
    given, units = log.parameters(given)
    settings, notes = settings_for(log.steps(), 0.0, given, live=True)
    for sentence in (*units, *notes):
        progress.say(sentence)
    columns = Covariates.of(log, model, covariates)
    corrector = columns.corrector_of(model, settings)
    aligner, engine = Aligner(settings), Monitor(settings, corrector, columns.entries)
    events: list[Event] = [] if reference is None else engine.set_reference(reference)
    tables: list[SampleTable] = []
    tell = _progress_by_time(log, progress)
    for aligned in columns.beside(aligned_blocks(aligner, log.readings, None, '')):
        tables.append(aligned.table)
        events += feed_aligned(engine, aligned, lambda task: diagnose_window(task).text, tell)
        if len(aligned.table):
            tell(int(aligned.table.time_ns[-1]), '')
    table = SampleTable.concatenate(tables)
    check_signals(table, aligner.counts())
    times = table.time_ns
    return MonitorResult(
        log.name, tuple(events), int(times[0]), int(times[-1]), settings, engine.reference.wear
    )


def _progress_by_time(log: Log, progress: Progress) -> Callable[[int, str], None]:
    """Return a function that reports how far the rows are, and the fit or diagnosis computed."""
    times = log.readings.time_ns
    # Single readings may have a wrong time.
    first, last = np.quantile(times, (0.01, 0.99)) if len(times) else (0.0, 0.0)
    begun: Counter[str] = Counter()

    def tell(time_ns: int, what: str) -> None:
        begun[what] += 1
        name = f'{what} {begun[what]}' if what else 'monitoring'
        share = min(max((time_ns - first) / max(last - first, 1.0), 0.0), 1.0)
        progress(0.1 + 0.85 * share, f'{name}, data up to {minute(time_ns)}')

    return tell


def _curve_moment(time_ns: int, c: Characteristic) -> reported.CurveMoment:
    ends = np.array(c.breakpoint_intervals, dtype=np.float64).reshape(-1, 2)
    return reported.CurveMoment(
        time_ns, c.model_id, c.pressure_exponent, c.breakpoints, c.values(), ends[:, 0],
        ends[:, 1], c.residuals.rmse_mw,
    )  # fmt: skip


def recorded_history(log: LogContents) -> reported.History | None:
    """Return the outputs of a monitor; None if the log is no monitor's recording.

    Topics are found by their type because the node may have any name. A message that
    cannot be decoded is reported in the notes.
    """
    notes: list[str] = []
    moments = [m for kind in (CURVE, ALARM, DIAGNOSIS) for m in _all(log, kind, notes)]
    readings = log.readings.time_ns
    ends = [int(readings.min()), int(readings.max())] if len(log.readings) else []
    return reported.history_of(moments, ends, notes)


def _all(log: LogContents, kind: str, notes: list[str]) -> list[reported.Moment]:
    """Return the messages of one type; of several topics only the first is used."""
    topics = sorted(t.name for t in log.topics.values() if t.type == kind and t.count)
    if not topics:
        return []
    if len(topics) > 1:
        notes.append(
            f'The log holds {kind.rsplit("/", 1)[-1]} messages on {" and ".join(topics)}; '
            f'only {topics[0]} is shown.'
        )
    try:
        decoder = log.decoder(topics[0])
        found = (
            reported.moment_of(kind, decoder.decode(message.data))
            for message in log.iter_messages([topics[0]])
        )
        return [one for one in found if one is not None]
    except (RecordingError, KeyError, TypeError, ValueError) as error:
        lacks = f'it lacks {error}.' if isinstance(error, KeyError) else str(error)
        notes.append(f'What the monitor published on {topics[0]} cannot be shown: {lacks}')
        return []
