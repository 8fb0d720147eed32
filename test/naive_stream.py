# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Slow truths of the streaming parts, in obvious loops over lists and dicts.

Nothing here is fast, bounded in memory or clever, and nothing is shared with the
engine but its settings and the words of `records`.
"""

import itertools
import math

import numpy as np

from valveflow_ros.records import SIGNALS

NS = 1_000_000_000


# --- aligning -------------------------------------------------------------------------------


class NaiveAligner:
    """Keep every accepted reading for ever and look each row's values up among them."""

    def __init__(self, settings):
        self.period = round(settings['sample_period'] * NS)
        self.lateness = round(settings['lateness'] * NS)
        self.hold = round(settings['hold_limit'] * NS)
        self.jump = max(round(settings['clock_jump'] * NS), 3 * self.period)
        self.limits = {}
        for info in SIGNALS:
            name = 'valve_opening' if info.topic == 'valve_command' else info.topic
            self.limits[int(info.signal)] = settings[f'{name}_low'], settings[f'{name}_high']
        self.required = [int(info.signal) for info in SIGNALS if info.required]
        self.counts = {info.topic: {} for info in SIGNALS}
        self.rows = []  # (time_ns, [values], [qualities])
        self.resets = []  # numbers of rows
        self.waiting = []
        self.forget()

    def forget(self):
        self.accepted = {int(info.signal): [] for info in SIGNALS}  # [(time, value, quality)]
        self.tick = None
        self.newest = None

    def count(self, signal, reason):
        topic = SIGNALS[signal].topic
        self.counts[topic][reason] = self.counts[topic].get(reason, 0) + 1

    def feed(self, readings):
        """Take a list of ``(time_ns, signal, value, quality)``."""
        for reading in readings:
            self.take(*reading)
            self.close_ready()

    def take(self, time, signal, value, quality):
        low, high = self.limits[signal]
        if not 0 <= time < 2**62:  # the year 2116
            self.count(signal, 'time_outlier')
        elif math.isnan(value) or math.isinf(value):
            self.count(signal, 'not_finite')
        elif quality >= 2:
            self.count(signal, 'bad_quality')
        elif value < low or value > high:
            self.count(signal, 'impossible')
        elif self.newest is None or abs(time - self.newest) <= self.jump:
            self.give_up_waiting()
            self.accept(time, signal, value, quality)
        else:
            if self.waiting and abs(time - self.waiting[-1][0]) > self.jump:
                self.give_up_waiting()
            self.waiting.append((time, signal, value, quality))
            # The values of one instant do not confirm each other.
            stamps = [r[0] for r in self.waiting]
            instants = 1 + sum(a != b for a, b in itertools.pairwise(stamps))
            enough = len(stamps) == 20
            if time > self.newest and (instants >= 3 or enough):
                self.believe()
            elif time < self.newest and enough:
                while self.tick is not None and self.tick <= self.newest:
                    self.close()  # what was before the restart is told to its end
                self.resets.append(len(self.rows))
                self.forget()
                self.believe()

    def give_up_waiting(self):
        for _, signal, _, _ in self.waiting:
            self.count(signal, 'time_outlier')
        self.waiting = []

    def believe(self):
        waiting, self.waiting = self.waiting, []
        for reading in waiting:
            # They count as arriving together: only what the lateness closes is closed between.
            time = reading[0]
            while self.tick is not None and self.tick < time - max(self.lateness - 1, 0):
                self.close(coming=time)
            self.accept(*reading)

    def accept(self, time, signal, value, quality):
        before = self.accepted[signal]
        if before and time == before[-1][0]:
            self.count(signal, 'duplicate')
        elif before and time < before[-1][0]:
            self.count(signal, 'out_of_order')
        else:
            if self.tick is None:
                self.tick = self.on_grid(time)
            elif time <= self.tick - self.period:
                self.count(signal, 'late')
            before.append((time, value, quality))
            self.count(signal, 'accepted')
            self.newest = time if self.newest is None else max(self.newest, time)

    def on_grid(self, time):
        """Return the first row not before ``time``."""
        row = time - time % self.period
        return row if row == time else row + self.period

    def close_ready(self):
        while self.tick is not None and self.ready():
            self.close()

    def ready(self):
        if self.newest >= self.tick + self.lateness:
            return True
        for signal, before in self.accepted.items():
            spoken = before[-1][0] if before else None
            if signal in self.required:
                expected = True
            else:
                expected = spoken is not None and spoken >= self.tick - self.hold
            if expected and (spoken is None or spoken < self.tick):
                return False
        return True

    def close(self, coming=None):
        values, qualities = [], []
        for before in self.accepted.values():
            newest = next((r for r in reversed(before) if r[0] <= self.tick), None)
            if newest is not None and newest[0] >= self.tick - self.hold:
                values.append(newest[1])
                qualities.append(newest[2])
            else:
                values.append(math.nan)
                qualities.append(2)
        if not all(math.isnan(v) for v in values):
            self.rows.append((self.tick, values, qualities))
            self.tick += self.period
            return
        later = [r[0] for before in self.accepted.values() for r in before if r[0] > self.tick]
        if coming is not None:
            later.append(coming)
        self.tick = max(self.tick + self.period, self.on_grid(min(later)))

    def finish(self):
        self.give_up_waiting()
        while self.tick is not None and self.tick <= self.newest:
            self.close()


# --- the line and the noise -----------------------------------------------------------------


def straight_line(values):
    """Return ``(value(k) for any k, slope, rms with n - 2 degrees of freedom)``."""
    n = len(values)
    if n == 1:
        return (lambda k: values[0]), 0.0, 0.0
    base = values[0]
    slope, start = np.polyfit(range(n), [v - base for v in values], 1)
    rest = sum((v - base - start - slope * k) ** 2 for k, v in enumerate(values))
    rms = math.sqrt(rest / (n - 2)) if n > 2 else 0.0
    return (lambda k: base + start + slope * k), float(slope), rms


def leverage(n, k):
    """Return the leverage of a new point at ``k`` on a line through points 0..n-1."""
    middle = sum(range(n)) / n
    spread = sum((i - middle) ** 2 for i in range(n))
    return 1.0 / n + (k - middle) ** 2 / spread


def noise_of(rms_values):
    """Return the 40 % quantile of what 40 bins a decade from 1e-6 keep of the rms values."""
    places = []
    for rms in rms_values:
        if 1e-6 < rms < 1e6:  # what stands still to the last digit teaches nothing
            places.append(min(math.trunc((math.log10(rms) + 6.0) * 40.0), 479))
    wanted = 0.4 * len(places)
    below = 0
    for place in sorted(set(places)):
        here = places.count(place)
        if below + here >= wanted:
            return 10.0 ** (-6.0 + (place + (wanted - below) / here) / 40.0)
        below += here
    return 0.0


# --- segmenting -----------------------------------------------------------------------------


class NaiveSegmenter:
    """The segmenter over lists: every line is fitted anew, every time, by `np.polyfit`."""

    def __init__(self, settings):
        self.period = settings['sample_period']
        self.rows = max(1, round(settings['block'] / self.period))
        block = self.rows * self.period

        def blocks(seconds):
            return math.ceil(seconds / block - 1e-9)

        self.settle = blocks(5 * settings['time_constant'] + settings['delay'])
        self.longest = max(6, blocks(settings['longest_segment']))
        self.steady_min = max(3, blocks(settings['steady_min']))
        self.slope_min = max(3, blocks(settings['slope_min']))
        self.trim = min(6, blocks(60.0))
        self.settings = settings
        self.row = 0
        self.last_ns = None
        self.stretches = []  # rms of (u, power)
        self.segments = []  # (kind, first row, end row, (u start, end), (power start, end), ...)
        self.kinds = []
        self.start_over()

    def start_over(self):
        """Begin afresh at the next row: nothing before it connects to what follows."""
        self.first_row = self.row
        self.filling = []  # rows of the block that fills
        self.open = []  # blocks of the open segment
        self.stretch = []
        self.skip = self.settle  # blocks of the open segment that do not count
        self.run_u = self.run_y = 0

    def feed(self, time_ns, u, y, temperature):
        for row in zip(time_ns, u, y, temperature, strict=True):
            self.take(*[x.item() if hasattr(x, 'item') else x for x in row])

    def take(self, time, u, y, temperature):
        usable = math.isfinite(u) and math.isfinite(y)
        step = None if self.last_ns is None else time - self.last_ns
        gap = step is not None and (step <= 0 or step > 1.5 * self.period * NS)
        if gap or not usable:
            if self.open:
                self.close(len(self.open))
            self.start_over()
        self.last_ns = time
        self.row += 1
        if not usable:
            self.first_row = self.row
            self.kinds.append(3)
            return
        self.filling.append((u, y, temperature))
        if len(self.filling) == self.rows:
            mean = [sum(r[c] for r in self.filling) / self.rows for c in range(2)]
            warm = [r[2] for r in self.filling if math.isfinite(r[2])]
            mean.append(sum(warm) / len(warm) if warm else math.nan)
            self.filling = []
            self.take_block(mean)
        self.kinds.append(self.kind_now())

    def noise(self):
        given = self.settings['input_noise'], self.settings['power_noise']
        learnt = [noise_of([s[c] for s in self.stretches]) for c in range(2)]
        return [max(g if g > 0.0 else n, 1e-6) for g, n in zip(given, learnt, strict=True)]

    def given(self):
        return self.settings['input_noise'] > 0.0 and self.settings['power_noise'] > 0.0

    def take_block(self, mean):
        self.stretch.append(mean)
        if len(self.stretch) == 42:
            self.stretches.append(
                tuple(straight_line([b[c] for b in self.stretch])[2] for c in range(2))
            )
            self.stretch = []
        if len(self.stretches) < 4 and not self.given():
            self.first_row += self.rows
            return
        noise_u, noise_y = self.noise()
        us = [b[0] for b in self.open]
        ys = [b[1] for b in self.open[self.skip :]]
        self.run_u = self.leaves(us, mean[0], noise_u, self.run_u)
        self.run_y = self.leaves(ys, mean[1], noise_y, self.run_y)
        old_end = None
        if abs(self.run_u) >= 2 or abs(self.run_y) >= 2:
            old_end = len(us) - 1
        elif self.drifts(us, noise_u):
            old_end = len(us) - 6
        self.open.append(mean)
        if old_end is not None:
            self.close(old_end - self.trim)
            self.cut(max(len(us) - 1, 0), self.settle)
        elif len(self.open) == self.longest + self.skip + self.trim:
            self.close(len(self.open) - self.trim)
            keep = min(18, len(self.open))
            self.cut(len(self.open) - keep, max(keep - self.trim, 0))

    def leaves(self, line, value, noise, run):
        if len(line) < 6:
            return 0
        n = len(line)
        off = value - straight_line(line)[0](n)
        off /= noise * math.sqrt(1.0 + leverage(n, n))
        limit = self.settings['break_limit']
        if abs(off) <= limit:
            return 0
        step = math.copysign(2 if abs(off) > 2 * limit else 1, off)
        return run + step if run * step >= 0 else step

    def drifts(self, us, noise):
        before, minute = us[:-6], us[-6:]
        if len(before) < 12:
            return False
        line = straight_line(before)[0]
        n = len(before)
        off = sum(v - line(n + k) for k, v in enumerate(minute)) / 6.0
        sd = noise * math.sqrt(0.5 + 6 * leverage(n, n - 1 + 3.5) / 2.0)
        return abs(off) > 2.5 * sd

    def cut(self, at, skip):
        self.first_row += at * self.rows
        self.open = self.open[at:]
        self.skip = skip
        self.run_u = self.run_y = 0

    def close(self, end):
        first = self.skip
        part = self.open[first : max(end, 0)]
        if len(part) < 3:
            return
        noise_u, noise_y = self.noise()
        u_at, u_slope, u_rms = straight_line([b[0] for b in part])
        y_at, y_slope, y_rms = straight_line([b[1] for b in part])
        if u_rms > 2.0 * noise_u or y_rms > 2.0 * noise_y:
            return
        n = len(part)
        moved_u, moved_y = abs(u_slope) * n / noise_u, abs(y_slope) * n / noise_y
        limit = self.settings['steady_limit']
        if moved_u <= limit and moved_y <= limit + 0.5:
            kind, least = 1, self.steady_min
        elif moved_u >= self.settings['slope_limit']:
            kind, least = 2, self.slope_min
        else:
            return
        if n < least:
            return
        warm = [b[2] for b in part if math.isfinite(b[2])]
        self.segments.append(
            {
                'kind': kind,
                'first_row': self.first_row + first * self.rows,
                'end_row': self.first_row + end * self.rows,
                'u_start': u_at(0),
                'u_end': u_at(n - 1),
                'u_rate_per_s': u_slope / (self.rows * self.period),
                'u_rms': u_rms,
                'power_start_mw': y_at(0),
                'power_end_mw': y_at(n - 1),
                'power_rms_mw': y_rms,
                'temperature_mean_degc': sum(warm) / len(warm) if warm else math.nan,
            }
        )

    def kind_now(self):
        if len(self.open) < max(self.skip, 6):
            return 0
        if self.run_u or self.run_y:
            return 0
        _, slope, _ = straight_line([b[0] for b in self.open])
        moved = abs(slope) * len(self.open) / self.noise()[0]
        return 2 if moved >= self.settings['slope_limit'] else 1


# --- the model ------------------------------------------------------------------------------


def naive_curve(u, knots, left, right):
    """Evaluate F by looking for the piece; the outer ones go on."""
    piece = 0
    for k in range(1, len(knots) - 1):
        if u >= knots[k]:
            piece = k
    share = (u - knots[piece]) / (knots[piece + 1] - knots[piece])
    return left[piece] * (1.0 - share) + right[piece] * share


def naive_respond(x, usable, levels, time_constants, delays, step):
    """Return the answer of the regional dynamics, ``None`` where a row is not usable."""
    answer = []
    run = []
    state = 0.0
    for now, good in zip(x, usable, strict=True):
        if not good:
            run = []
            answer.append(None)
            continue
        run.append(now)
        region = sum(1 for level in levels if now >= level)
        back = delays[region] / step
        place = len(run) - 1 - back
        # Before the run began the flow is taken to have been what it was at its first row.
        before, late = np.interp([place - 1, place], range(len(run)), run)
        constant = time_constants[region] / step
        decay = math.exp(-1.0 / constant)
        state = now if len(run) == 1 else state
        # The exact answer to a flow that runs straight from `before` to `late` in a step.
        slope = late - before
        state = decay * (state - before + constant * slope) + before + slope - constant * slope
        answer.append(state)
    return answer


# --- the alarm ------------------------------------------------------------------------------


class NaiveAlarm:
    """The residual alarm as a story: keep the run of rows beyond the limit, look at its length."""

    def __init__(self, settings):
        self.on = round(settings['alarm_on_delay'] * NS)
        self.off = round(settings['alarm_off_delay'] * NS)
        self.dead_band = settings['alarm_dead_band']
        self.latch = settings['alarm_latch']
        self.gap = round(1.5 * settings['sample_period'] * NS)
        self.state = 'NORMAL'
        self.condition = False
        self.watched = None  # time seen to pass while rows one after the other speak for a turn
        self.gone = None  # time since the condition was over
        self.longer = 1
        self.last = None
        self.changes = []  # (row, previous, state)
        self.row = 0

    def take(self, time, average, limit):
        self.row += 1
        step = 0 if self.last is None else time - self.last
        self.last = time
        if self.gone is not None:
            self.gone += max(step, 0)
        if not 0 < step <= self.gap:
            self.watched = None
        if math.isnan(average):
            return
        if self.condition:
            speaks = abs(average) < limit * (1.0 - self.dead_band)
            delay = self.off * self.longer
        else:
            speaks = abs(average) > limit
            delay = self.on
        if not speaks:
            self.watched = None
        elif self.watched is None:
            self.watched = 0
        else:
            self.watched += step
        if speaks and self.watched >= delay:
            self.watched = None
            self.condition = not self.condition
            self.turn()

    def turn(self):
        if self.condition:
            again = self.gone is not None and self.gone <= 7 * self.off
            self.longer = min(2 * self.longer, 8) if again else 1
        else:
            self.gone = 0
        if self.condition:
            self.enter('UNACKNOWLEDGED')
        elif self.latch and self.state == 'UNACKNOWLEDGED':
            self.enter('RETURNED_UNACKNOWLEDGED')
        else:
            self.enter('NORMAL')

    def acknowledge(self):
        if self.state == 'UNACKNOWLEDGED':
            self.enter('ACKNOWLEDGED')
        elif self.state == 'RETURNED_UNACKNOWLEDGED':
            self.enter('NORMAL')
        else:
            return False
        return True

    def enter(self, state):
        self.changes.append((self.row, self.state, state))
        self.state = state
