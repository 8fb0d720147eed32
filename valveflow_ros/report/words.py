# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Numbers, times and units as text, rounded according to their uncertainty."""

from __future__ import annotations

import math
import re
from datetime import datetime, timedelta, timezone, tzinfo
from fractions import Fraction
from typing import TYPE_CHECKING

from valveflow_ros.records import NS_PER_S

if TYPE_CHECKING:
    # Importing it loads the compiler, which takes half a second, and `info` shows no curve.
    from valveflow_ros.curve.characteristic import HeldCause

UNKNOWN = 'unknown'
NOT_KNOWN = 'not known'
_MINUS = '−'
Z95 = 1.959963984540054


def plain(value: float, digits: int = 4) -> str:
    """Return ``value`` with ``digits`` significant digits, without powers of ten if possible.

    NaN and infinity become the word 'unknown'.
    """
    if not math.isfinite(value):
        return UNKNOWN
    if value == 0.0:
        return '0'
    exponent = math.floor(math.log10(abs(value)))
    if -4 <= exponent < 7:
        rounded = round(value, digits - 1 - exponent)
        text = f'{rounded:.{max(0, digits - 1 - exponent)}f}'
    else:
        text = f'{value:.{digits - 1}e}'
    return text.replace('-', _MINUS) if value < 0.0 else text


def decimals(value: float, places: int) -> str:
    """Return ``value`` with a fixed number of decimals; 'unknown' if it is not finite."""
    if not math.isfinite(value):
        return UNKNOWN
    text = f'{value:.{places}f}'
    if float(text) == 0.0:
        text = text.lstrip('-')
    return text.replace('-', _MINUS)


def level(value: float, places: int) -> str:
    """Return ``value`` like `decimals`, with more decimals for at least two digits."""
    return decimals(value, max(places, places_for(abs(value))))


def signed(value: float, places: int = 1) -> str:
    """Return a number with its sign and a fixed number of decimals."""
    text = decimals(value, places)
    return f'+{text}' if value > 0.0 and float(f'{value:.{places}f}') else text


def p_value(value: float) -> str:
    """Return the p value of a test: 'p = 0.03', 'p < 0.0001', 'not tested'."""
    if not math.isfinite(value):
        return 'not tested'
    return 'p < 0.0001' if value < 1e-4 else f'p = {plain(value, 2)}'


def places_for(error: float) -> int:
    """Return the number of decimals at which an error has two significant digits."""
    if not math.isfinite(error) or error <= 0.0:
        return 0
    return max(0, 1 - math.floor(math.log10(error)))


def with_error(value: float, error: float, unit: str = '') -> str:
    """Return 'value ± half of its 95 % interval', both rounded to two digits of that.

    ``error`` is the standard error. If it is unknown, return the value with four digits.
    """
    tail = f' {unit}' if unit else ''
    if not math.isfinite(value):
        return UNKNOWN
    if not math.isfinite(error) or error <= 0.0:
        return plain(value) + tail
    half = Z95 * error
    places = places_for(half)
    return f'{decimals(value, places)} ± {decimals(half, places)}{tail}'


def is_known(value: float, error: float) -> bool:
    """Return True if a time is larger than its standard error, or has none."""
    return not error > value


def time_with_error(value_s: float, error_s: float, unit: str = '') -> str:
    """Return a time constant or delay; 'not known' if its standard error is larger."""
    return with_error(value_s, error_s, unit) if is_known(value_s, error_s) else NOT_KNOWN


def interval(low: float, high: float) -> str:
    """Return 'low to high', rounded according to its width; 'unknown' if an end is not finite."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return UNKNOWN
    places = places_for(high - low)
    return f'{decimals(low, places)} to {decimals(high, places)}'


def span(low: float, high: float, places: int = 0) -> str:
    """Return 'low to high' with a fixed number of decimals; more if they are close together."""
    places = max(places, places_for(abs(high - low)))
    return f'{decimals(float(low), places)} to {decimals(float(high), places)}'


def count(value: int) -> str:
    """Return a whole number with digits in groups of three."""
    return f'{value:,}'.replace(',', '\u202f')


def counted(value: int, one: str, many: str = '') -> str:
    """Return a number and its noun: '1 piece', '4 pieces'."""
    return f'{count(value)} {one if value == 1 else many or one + "s"}'


def percent(share: float, digits: int = 3) -> str:
    """Return a fraction in percent; a fraction just below 1 is never shown as 100 %."""
    if not math.isfinite(share):
        return UNKNOWN
    if 0.99 < share < 1.0:
        # Near 100 % the number of digits depends on the difference from 100 %.
        places = places_for(100.0 * (1.0 - share))
        return f'{decimals(100.0 * share, places)} %' if places <= 4 else '> 99.99 %'
    return f'{plain(100.0 * share, digits)} %'


def duration(seconds: float) -> str:
    """Return a duration with its two largest units: '9 d 23 h', '12 min 5 s', '0.5 s'."""
    if not math.isfinite(seconds):
        return UNKNOWN
    if seconds < 60.0:
        return f'{seconds:.3g} s'
    sizes = ((86400, 'd'), (3600, 'h'), (60, 'min'), (1, 's'))
    large = next(k for k, (size, _) in enumerate(sizes) if seconds >= size)
    small = min(large + 1, len(sizes) - 1)
    # Round to the smaller unit, so that ten days minus a second is shown as ten days.
    left = round(seconds / sizes[small][0]) * sizes[small][0]
    parts = []
    for size, name in sizes[: small + 1]:
        number, left = divmod(left, size)
        if number:
            parts.append(f'{number} {name}')
    return ' '.join(parts[:2])


def moment(time_ns: int) -> str:
    """Return a time as '2023-11-15 00:00:00 UTC'."""
    second = time_ns // NS_PER_S
    try:
        at = datetime.fromtimestamp(second, tz=timezone.utc)
    except (OverflowError, OSError, ValueError):
        return f'{second} s since 1970'
    return f'{at:%Y-%m-%d %H:%M:%S} UTC'


_UTC_MOMENT = re.compile(r'(\d{4}-\d\d-\d\d \d\d:\d\d(?::\d\d)?) UTC(?![\w+-])')
_UTC_HOUR = re.compile(r'\b((?:[01]\d|2[0-3]):[0-5]\d) UTC(?![\w+-])')


def in_zone(said: str, zone: tzinfo | None) -> str:
    """Return a text with its times, like '2023-11-15 00:00 UTC', in a time zone; None: UTC.

    A time of day without a date, like '13:20 UTC', is given in the winter time of the zone.
    """
    if zone is None:
        return said

    def local(found: re.Match[str]) -> str:
        at = datetime.fromisoformat(f'{found[1]}+00:00').astimezone(zone)
        return f'{at:%Y-%m-%d %H:%M:%S}'[: len(found[1])] + f' {at.tzname()}'

    def hour(found: re.Match[str]) -> str:
        days = (
            datetime.fromisoformat(f'2023-{month}-01 {found[1]}+00:00').astimezone(zone)
            for month in ('01', '07')
        )
        at = min(days, key=lambda day: day.dst() or timedelta())
        return f'{at:%H:%M} {at.tzname()}'

    return _UTC_HOUR.sub(hour, _UTC_MOMENT.sub(local, said))


def floor_words(disturbed: bool) -> str:
    """Return what the estimate of the noise floor contains."""
    return 'Noise and the slow variation' if disturbed else 'Noise alone'


def period(start_ns: int, end_ns: int) -> str:
    """Return two times as 'from to'."""
    return f'{moment(int(start_ns))} to {moment(int(end_ns))}'


def exponent(value: float) -> str:
    """Return the pressure exponent in its usual form: 9/8, or a decimal number."""
    near = Fraction(value).limit_denominator(16)
    if near.denominator > 1 and abs(float(near) - value) < 1e-9:
        return f'{near.numerator}/{near.denominator}'
    return plain(value, 4)


def input_unit(value: float) -> str:
    """Return the unit of u as HTML, with m for an unknown exponent.

    With the exponent 0 u is the opening.
    """
    if value == 0.0:
        return '%'
    return f'% MPa<sup>{exponent(value) if math.isfinite(value) else "m"}</sup>'


def input_name(value: float) -> str:
    """Return what the curve is a function of: 'u', or 'opening' with the exponent 0."""
    return 'opening' if value == 0.0 else 'u'


def per_input(value: float) -> str:
    """Return the unit of a slope, in words."""
    return 'MW per %' if value == 0.0 else 'MW per unit of u'


def input_unit_plain(value: float) -> str:
    """Return the unit of u as plain text: '% MPa^(9/8)'; '% MPa^m' for an unknown exponent."""
    if not math.isfinite(value):
        return '% MPa^m'
    if value == 0.0:
        return '%'
    power = exponent(value)
    return f'% MPa^({power})' if '/' in power else f'% MPa^{power}'


def input_axis(value: float) -> dict[str, str]:
    """Return the title of an axis of u, and a short one for narrow figures, as HTML."""
    if value == 0.0:
        return {'text': 'valve opening (%)', 'short': 'opening (%)'}
    m = exponent(value) if math.isfinite(value) else 'm'
    long = f'integrated input u = V p<sup>{m}</sup> ({input_unit(value)})'
    return {'text': long, 'short': f'u ({input_unit(value)})'}


# Causes that are relative to their mean over the record, see `diagnosis.causes`.
_FROM_THE_MEAN = frozenset(('gain_drift', 'input_drift', 'intervals', 'output_offset_drift'))


def held_words(held: tuple[HeldCause, ...]) -> str:
    """Return which causes were removed from the rows; empty if there are none."""
    if not held:
        return ''
    # The onset is given as a date in the sentence; a number of days is not informative.
    told = [(h, ', '.join(f'{n} = {v:.4g}' for n, v in h.values if n != 't0_days')) for h in held]
    names = ', '.join(f'{h.name} ({values})' if values else h.name for h, values in told)
    if any(h.name in _FROM_THE_MEAN for h in held):
        curve = (
            'For a drift, and for a cause that switches on and off, only the deviation from its '
            'mean is removed, so the curve contains the mean effect. '
        )
    else:
        curve = f'The curve is that of the unit without {"it" if len(held) == 1 else "them"}. '
    return (
        f'The effect of these known causes was removed from the data first: {names}. {curve}'
        + ' '.join(h.sentence for h in held)
    )


VERDICT_WORDS = {
    'named': 'cause found',
    'nothing': 'no cause found',
    'unexplained': 'something is unexplained',
}


def advice(name: str, meaning: str, to_do: str) -> str:
    """Return the effect of a cause in MW and the recommended action; empty if both are unknown.

    The arguments are those of a cause in ``diagnosis.json``.
    """
    to_do = f'What to do: {to_do}' if to_do else ''
    told = f'{meaning} {to_do}'.strip()
    return f'{name}{":" if meaning else "."} {told}' if told else ''
