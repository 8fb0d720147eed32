# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mutants of recordings and tables: whatever reads them ends with a result or a sentence."""

from __future__ import annotations

import contextlib
import io
import os
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from log_files import START_NS, plant_sample, wander, write_chunks, write_messages

from benchmarks.torture.bombs import GOOD, chunk, file_of
from benchmarks.torture.bounded import run_bounded
from benchmarks.torture.memory import MIB
from benchmarks.torture.mutator import Mutator
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.cli.main import main as valveflow
from valveflow_ros.errors import ValveflowError
from valveflow_ros.logs import Message, open_log, write_samples, write_table
from valveflow_ros.logs.mcap.recover import recover

BATCH = 200
# The node reads no tables; a library of theirs may want more for one.
MOST_BYTES = 600 * MIB
PATIENCE_S = 60.0
UNFORESEEN = 'This should not have happened'
INFO_EVERY = 4


@dataclass(slots=True)
class Corpus:
    """The whole files that mutants are made from."""

    recordings: list[bytes]
    csv: str
    parquet: bytes


def fuzz(options: Options) -> Outcome:
    """Read, walk, recover and describe mutants until the time is over; keep what hurts."""
    outcome = Outcome()
    corpus = _corpus(options.folder)
    # Libraries that are loaded now need not be loaded by each child.
    for name in ('made.mcap', 'table.csv'):
        for call in _calls(options.folder / name, name.rsplit('.')[-1], 0).values():
            call()
    end_s = time.monotonic() + 60.0 * options.minutes * options.scale
    seed = options.seed
    while time.monotonic() < end_s:
        seed = _batch(seed, corpus, options.folder, outcome)
    counts = outcome.counts
    counts['first_seed'], counts['last_seed'] = options.seed, seed - 1
    hurt = counts.setdefault('seeds_that_hurt', [])
    outcome.sentence = (
        f'{counts["mutants"]} mutants, {counts["calls"]} calls: '
        f'{counts.get("results", 0)} results, {counts.get("sentences", 0)} sentences, '
        f'{len(hurt)} that hurt'
    )
    return outcome


def _batch(seed: int, corpus: Corpus, folder: Path, outcome: Outcome) -> int:
    """Try some mutants in a child; return the seed of the next."""
    mark = folder / 'mark'
    mark.write_text(str(seed))

    def work() -> tuple[dict[str, int], list[tuple[int, str]]]:
        counts: dict[str, int] = {}
        hurt: list[tuple[int, str]] = []
        for number in range(seed, seed + BATCH):
            mark.write_text(str(number))
            _mutant(number, corpus, folder, counts, hurt)
        return counts, hurt

    ended = run_bounded(work, PATIENCE_S, MOST_BYTES)
    hurt: list[tuple[int, str]]
    counts, hurt = ended.value or ({}, [])
    following = seed + BATCH
    if ended.error:
        # The mutants before this one have been tried, but their counts went with the child.
        at = int(mark.read_text() or seed)
        hurt, following = [(at, ended.error)], at + 1
    for name, count in counts.items():
        outcome.count(name, count)
    outcome.worst('largest_mib', round(ended.bytes / MIB, 1))
    for number, what in hurt:
        outcome.counts.setdefault('seeds_that_hurt', []).append(number)
        outcome.expect(False, f'seed {number}: {what}')
    return following


def _mutant(
    seed: int, corpus: Corpus, folder: Path, counts: dict[str, int], hurt: list[tuple[int, str]]
) -> None:
    """Make the mutant of a seed and hand it to everything that reads."""
    generator = random.Random(seed)
    mutator = Mutator(generator, corpus.recordings)
    kind = generator.choice(('mcap', 'mcap', 'mcap', 'csv', 'parquet'))
    if kind == 'mcap':
        raw = mutator.recording()
    else:
        raw = mutator.table(corpus.csv) if kind == 'csv' else mutator.bytes_of(corpus.parquet)
    path = folder / f'mutant.{kind}'
    path.write_bytes(raw)
    counts['mutants'] = counts.get('mutants', 0) + 1
    counts[kind] = counts.get(kind, 0) + 1
    for name, call in _calls(path, kind, seed).items():
        counts['calls'] = counts.get('calls', 0) + 1
        try:
            call()
            counts['results'] = counts.get('results', 0) + 1
        except ValveflowError:
            counts['sentences'] = counts.get('sentences', 0) + 1
        except BaseException as error:  # noqa: BLE001 - that is what is looked for
            hurt.append((seed, f'{name} of {path.name}: {type(error).__name__}: {error}'[:300]))


def _calls(path: Path, kind: str, seed: int) -> dict[str, Callable[[], object]]:
    copy = path.with_name('copy.mcap')

    def read() -> None:
        log = open_log(path, columns={})
        for _ in log.iter_messages():
            pass
        for topic in list(log.topics)[:3]:
            first = next(log.iter_messages([topic]), None)
            if first is not None:
                log.decoder(topic).decode(first.data)

    def mend() -> None:
        copy.unlink(missing_ok=True)
        report = recover(path, copy)
        found = sum(1 for _ in open_log(copy).iter_messages())
        if found > report.messages:
            raise AssertionError(f'recovered {report.messages}, then read {found}')

    def describe() -> None:
        out = io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            status = valveflow(['info', os.fspath(path)])
        if status not in (0, 1) or UNFORESEEN in out.getvalue():
            raise AssertionError(f'status {status}: {out.getvalue()[-200:]}')

    calls: dict[str, Callable[[], object]] = {'read': read}
    if kind == 'mcap':
        calls['recover'] = mend
    if seed % INFO_EVERY == 0:
        calls['info'] = describe
    return calls


def _corpus(folder: Path) -> Corpus:
    whole, _, _ = write_chunks(folder / 'floats', chunks=6)
    part, _, writer = write_chunks(folder / 'parts', chunks=6, close=False)
    writer.abandon()
    samples = write_messages(
        folder / 'samples',
        {'/plant_sample': 'valveflow_msgs/msg/PlantSample', '/note': 'std_msgs/msg/String'},
        [
            Message('/plant_sample', plant_sample(START_NS + k, [1.0, 2.0, 3.0, 4.0], [0] * 4),
                    START_NS + k, START_NS + k)
            for k in range(40)
        ],
    )  # fmt: skip
    table = wander(200, 5)
    made = write_samples(table, folder / 'made.mcap').path
    write_table(table, folder / 'table.csv')
    write_table(table, folder / 'table.parquet')
    recordings = [path.read_bytes() for path in (whole, part, samples, made)]
    return Corpus(
        [*recordings, file_of(chunk(GOOD, 'lz4'), chunk(GOOD))],
        (folder / 'table.csv').read_text(),
        (folder / 'table.parquet').read_bytes(),
    )
