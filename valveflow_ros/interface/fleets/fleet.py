# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``fleet``: identify, diagnose and monitor many units and months with Dask."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import quote

from valveflow_ros.errors import (
    InputError,
    RecordingError,
    UsageError,
    ValveflowError,
    counted,
    listed,
)
from valveflow_ros.interface import SILENT, Progress
from valveflow_ros.interface.files import check_folder, whole_file, write_texts
from valveflow_ros.interface.fleets.unit_logs import UnitLog, read_fleet
from valveflow_ros.interface.fleets.unit_month import (
    LIBRARIES,
    FleetTask,
    Row,
    failed_row,
    unit_month,
)
from valveflow_ros.report.fleet import REPORT, UNITS, UnitStory, fleet_page, story_of, unit_page
from valveflow_ros.report.page import plotly_script

DATA, PAGE = 'fleet.parquet', 'fleet.html'
_WAIT_S, _SHOWN = 10, 4


@contextmanager
def connected(scheduler: str) -> Iterator[Any]:
    """Yield a client of a scheduler, or of a local cluster with one worker per core.

    Raises `RecordingError` if no scheduler answers, `UsageError` if its address is none.
    """
    import dask
    from distributed import Client, LocalCluster

    # The rows report the work; messages and tracebacks of the library are suppressed.
    quiet = {'logging': {'distributed': 'critical', 'bokeh': 'critical'}}
    with dask.config.set(quiet), _silenced():
        if scheduler:
            if not scheduler.rpartition(':')[2].isdigit():
                raise UsageError(
                    f"--scheduler '{scheduler}' names no port, as tcp://10.0.0.5:8786 does."
                )
            try:
                client = Client(scheduler, timeout=_WAIT_S, set_as_default=False)
            except ValueError as error:
                raise UsageError(f"--scheduler '{scheduler}' is no address ({error}).") from None
            except (OSError, TimeoutError) as error:
                raise RecordingError(
                    scheduler, f'no Dask scheduler answers there within {_WAIT_S} s'
                ) from error
            with client:
                yield client
            return
        # One thread per worker, also in compiled loops: the workers already use all cores.
        cores = len(os.sched_getaffinity(0))
        with LocalCluster(
            n_workers=cores, threads_per_worker=1, processes=True,
            dashboard_address='127.0.0.1:0', silence_logs=logging.CRITICAL,
            env={'NUMBA_NUM_THREADS': '1'},
        ) as cluster, Client(cluster, set_as_default=False) as client:  # fmt: skip
            # Dask does not restart a worker killed during its start; `adapt` starts another.
            cluster.adapt(minimum=cores, maximum=cores, interval='1s')
            yield client


@contextmanager
def _silenced() -> Iterator[None]:
    """Silence all loggers of the library; some of them have their own levels."""
    names = [n for n in logging.root.manager.loggerDict if n.partition('.')[0] == 'distributed']
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


def _tell_workers(client: Any, units: Mapping[str, Sequence[UnitLog]], progress: Progress) -> None:
    """Report the workers, and the first tasks in the order in which they are distributed."""
    workers = client.scheduler_info(n_workers=-1)['workers'].values()
    if not workers:
        progress.say(f'{client.scheduler.address} has no worker yet; waiting for one.')
        return
    limit = min(w['memory_limit'] or 0 for w in workers)
    bound = (
        f'each bounded to {limit / 1e9:.1f} GB of memory' if limit else 'without a bound of memory'
    )
    progress.say(f'{counted(len(workers), "worker")}, {bound}.')
    progress.say(
        'The workers begin. Where none has run before it compiles first, which takes minutes; the '
        'next run does not.'
    )
    first = [f'{unit} {logs[0].name}' for unit, logs in units.items()]
    at_once = min(_SHOWN, sum(w['nthreads'] for w in workers))
    progress(0.0, f'first {listed(first[:at_once])}')


Chain = Generator[FleetTask, Row, None]


def spread(
    client: Any, work: Callable[[FleetTask], Row], chains: Sequence[Chain]
) -> Iterator[tuple[FleetTask, Row]]:
    """Run chains of tasks on the workers; yield each task with its row when it is done.

    Each chain yields a task and receives its row by `send`. It has at most one task on the
    cluster: the scheduler has at most one task per unit, and finished work is not lost with a
    worker. Chains with more finished tasks come first, so that units end one by one. Raises
    `ValveflowError` if the connection to the scheduler is lost.
    """
    from distributed import as_completed

    under_way: dict[str, tuple[Chain, FleetTask, int]] = {}
    futures = as_completed(loop=client.loop)

    def submit(chain: Chain, task: FleetTask, depth: int) -> None:
        future = client.submit(work, task, pure=False, priority=depth)
        under_way[future.key] = chain, task, depth
        futures.add(future)

    for chain in chains:
        submit(chain, next(chain), 0)
    for future in futures:
        chain, task, depth = under_way.pop(future.key)
        row = _outcome(future, task)
        yield task, row
        with suppress(StopIteration):
            submit(chain, chain.send(row), depth + 1)


def _outcome(future: Any, task: FleetTask) -> Row:
    from distributed import CancelledError, KilledWorker

    try:
        return dict(future.result())
    except KilledWorker as error:
        died = f'{error.allowed_failures + 1} workers that did it died one after the other'
        return failed_row(task, f'{died}, as for want of memory; the next run tries it again.')
    except (CancelledError, OSError):
        raise ValveflowError(
            'The scheduler has gone. What is done stays: run the same command again.'
        ) from None
    except Exception as error:  # noqa: BLE001 - anything that prevents a worker from starting
        about = ' '.join(f'{type(error).__name__}: {error}'.split())[:200]
        return failed_row(task, f'The worker could not do it ({about}).')


def _chain(logs: Sequence[UnitLog], folder: Path) -> Chain:
    """Yield the tasks of a unit; the curve of a log is the reference for the next log."""
    before = first = ''
    for log in logs:
        row = yield FleetTask(log, folder, before, first)
        before = row.get('curve') or before
        first = first or before


def _schema() -> Any:
    """Return the columns of the data set; times are UTC, powers are in MW or in `output_unit`."""
    import pyarrow as pa

    f, s, n, b = pa.float64(), pa.string(), pa.int64(), pa.bool_()
    at = pa.timestamp('ns', tz='UTC')

    def records(**fields: Any) -> Any:
        return pa.list_(pa.struct(list(fields.items())))

    def judged(name: str) -> dict[str, Any]:
        return {
            f'{name}_moved': b, f'{name}_mw': f, f'{name}_u_from': f, f'{name}_u_to': f,
            f'{name}_p_value': f, f'{name}_since': at, f'{name}_since_low': at,
            f'{name}_since_high': at, f'{name}_sentence': s,
        }  # fmt: skip

    parameter = records(name=s, value=f, low=f, high=f, unit=s)
    return pa.schema({
        'log': s, 'source': s, 'status': s, 'sentences': pa.list_(s), 'start': at, 'end': at,
        # curve
        'curve': s, 'model_id': s, 'reference': s, 'output_unit': s, 'axis': s,
        'pressure_exponent': f, 'pressure_scale_exponent': f, 'offset_mw': f,
        'reference_pressure_mpa': f,
        'pieces': records(
            u_from=f, u_to=f, slope=f, intercept=f, slope_stderr=f, intercept_stderr=f, samples=n,
        ),
        'u': pa.list_(f), 'power_mw': pa.list_(f), 'breakpoint_low': pa.list_(f),
        'breakpoint_high': pa.list_(f),
        'dynamics': records(
            power_from=f, power_to=f, time_constant_s=f, delay_s=f, time_constant_stderr_s=f,
            delay_stderr_s=f,
        ),
        **judged('shift'), **judged('change'), 'change_mean_mw': f,
        # errors
        'rmse_mw': f, 'explained': f, 'rmse_simulation': f, 'rmse_extended': f,
        'rmse_noise_floor': f,
        # causes
        'verdict': s,
        'causes': records(
            name=s, sentence=s, meaning=s, to_do=s, parameters=parameter, rmse_before=f,
            rmse_after=f, reduction=f, p_value=f, onset=at, onset_low=at, onset_high=at,
        ),
        'not_told_apart': pa.list_(s), 'unexplained_by': pa.list_(s),
        # alarms
        'alarms': records(name=s, raised=at, cleared=at, state=s, sentence=s),
        'monitor_curves': n, 'monitor_diagnoses': records(time=at, verdict=s, causes=pa.list_(s)),
        'wear_mw_per_month': f,
        # quality
        'rows': n, 'steady': n, 'slope_response': n, 'samples': n, 'temperature_flag': b,
        'rejected': records(reason=s, count=n), 'notes': pa.list_(s),
        # versions, timing
        'versions': pa.struct([(name, s) for name in ('valveflow', 'python', *LIBRARIES)]),
        'read_s': f, 'identify_s': f, 'diagnose_s': f, 'monitor_s': f, 'task_s': f,
    })  # fmt: skip


def partition_of(folder: Path, unit: str) -> Path:
    """Return the file of a unit in the data set."""
    return folder / DATA / f'unit={quote(unit, safe="")}' / 'part-0.parquet'


def _write_unit(folder: Path, unit: str, rows: Sequence[Row]) -> UnitStory:
    """Write the data and the page of a unit after all its logs are processed."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = partition_of(folder, unit)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as draft:
        pq.write_table(pa.Table.from_pylist(list(rows), schema=_schema()), draft)
    write_texts(folder / UNITS / unit, {REPORT: unit_page(unit, rows).to_html()})
    return story_of(unit, rows)


@dataclass(frozen=True, slots=True)
class FleetResult:
    """The result of a run over a fleet.

    Attributes
    ----------
    folder : Path
        Contains ``fleet.parquet``, ``fleet.html`` and ``units``.
    stories : tuple of UnitStory
        The content of the page for each unit, sorted by name.
    anew, unchanged, failed : int
        Number of tasks done in this run, of tasks done before and unchanged, and of tasks
        without any result.
    """

    folder: Path
    stories: tuple[UnitStory, ...]
    anew: int
    unchanged: int
    failed: int

    def to_json(self) -> dict[str, Any]:
        """Return the result as a dict of plain values."""
        return {
            'format': 'valveflow/fleet',
            'version': 1,
            'tasks': {'anew': self.anew, 'unchanged': self.unchanged, 'failed': self.failed},
            'units': [story.to_json() for story in self.stories],
            'files': {name: str(self.folder / name) for name in (DATA, PAGE)},
        }

    def to_dataframe(self) -> Any:
        """Return the data set as a pandas.DataFrame, one row per log."""
        import pyarrow as pa
        import pyarrow.dataset as ds

        units = ds.partitioning(pa.schema([('unit', pa.string())]), flavor='hive')
        return ds.dataset(self.folder / DATA, partitioning=units).to_table().to_pandas()


def check_installed() -> None:
    """Raise `InputError` if a package that `fleet` needs is not installed."""
    plotly_script()
    missing = [n for n in ('dask', 'distributed', 'pyarrow') if find_spec(n) is None]
    if missing:
        what = 'which is' if len(missing) == 1 else 'which are'
        raise InputError(
            f'A fleet needs {listed(missing)}, {what} not installed: '
            f'pip install {" ".join(missing)}.'
        )


def fleet(
    logs: Sequence[str | Path],
    folder: str | Path,
    *,
    scheduler: str = '',
    options: Sequence[str] = (),
    progress: Progress = SILENT,
) -> FleetResult:
    """Identify, diagnose and monitor the logs of many units, in parallel.

    Each log is a task: the results of `identify`, `diagnose` and `monitor` are written into
    ``folder/units/UNIT/LOG``. The curve of a log is the reference for the next log of its unit.
    Tasks that an earlier run has done and whose inputs have not changed are not repeated.

    Parameters
    ----------
    logs : sequence of str or Path
        Logs, folders, globs or manifests; see `read_fleet`.
    folder : str or Path
        Created if absent. Its ``fleet.parquet`` and ``fleet.html`` cover these logs only.
    scheduler : str
        Address of a Dask scheduler whose workers see logs and folder under the same names;
        by default a local cluster with one worker per core.
    options : sequence of str
        How logs are read and evaluated; see `read_options`.
    progress : Progress

    Raises
    ------
    InputError, UsageError
        The optional dependency is missing, an option is wrong, or two units have the same name.
    RecordingError
        A log does not exist, the folder cannot be written, or no scheduler answers.
    ValveflowError
        The connection to the scheduler was lost.
    """
    check_installed()
    folder = Path(folder).absolute()
    units = read_fleet(logs, options, folder)
    check_folder(folder)
    (folder / UNITS).mkdir(parents=True, exist_ok=True)
    rows: dict[str, list[Row]] = {unit: [] for unit in units}
    stories, done, total = [], 0, sum(map(len, units.values()))
    anew = failed = 0
    with connected(scheduler) as client:
        _tell_workers(client, units, progress)
        chains = [_chain(months, folder) for months in units.values()]
        for task, row in spread(client, unit_month, chains):
            unit, done = task.of.unit, done + 1
            anew, failed = anew + row['anew'], failed + (row['status'] == 'failed')
            rows[unit].append(row)
            progress(done / total, f'{unit} {task.of.name} done')
            if len(rows[unit]) == len(units[unit]):
                stories.append(_write_unit(folder, unit, rows.pop(unit)))
    for old in (folder / DATA).glob('unit=*'):
        if old not in {partition_of(folder, unit).parent for unit in units}:
            shutil.rmtree(old, ignore_errors=True)
    stories.sort(key=lambda story: story.unit)
    write_texts(folder, {PAGE: fleet_page(stories).to_html()})
    return FleetResult(folder, tuple(stories), anew, total - anew, failed)
