"""Reads the unit out of a column's name, however a historian spells it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from valveflow_ros.records import Signal

# What a unit measures.
OPENING, PRESSURE, TEMPERATURE, POWER = 'opening', 'pressure', 'temperature', 'power'
DIMENSIONS = {
    Signal.VALVE_OPENING: OPENING,
    Signal.MAIN_STEAM_PRESSURE: PRESSURE,
    Signal.MAIN_STEAM_TEMPERATURE: TEMPERATURE,
    Signal.GENERATED_POWER: POWER,
    Signal.VALVE_COMMAND: OPENING,
}


@dataclass(frozen=True, slots=True)
class Spelling:
    """A unit as it was found.

    Attributes
    ----------
    dimension : str
        What it measures.
    unit : str
        The name the project knows it by.
    written : str
        As it stands in the file.
    """

    dimension: str
    unit: str
    written: str = ''


def _spellings() -> dict[str, Spelling]:
    known: dict[str, Spelling] = {}

    def put(dimension: str, unit: str, words: str) -> None:
        for word in words.split():
            known[word] = Spelling(dimension, unit)

    put(OPENING, '%', '% percent pct prozent proz perc %open %auf %offen')
    put(OPENING, 'fraction', 'fraction p.u. pu anteil')
    put(PRESSURE, 'MPa', 'mpa mpaa mpa(a) mpaabs megapascal')
    put(PRESSURE, 'kPa', 'kpa kpaa kpa(a) kpaabs')
    put(PRESSURE, 'Pa', 'pa pascal paabs')
    put(PRESSURE, 'bar', 'bar bara bar(a) barabs bar_a bar-a')
    put(PRESSURE, 'psi', 'psi psia psi(a) psiabs lb/in2 lbf/in2')
    put(PRESSURE, 'barg', 'barg bar(g) barü barue bar(ü) bar(ue) bar_ü bar-ü bar_g bar-g bargauge')
    put(PRESSURE, 'MPag', 'mpag mpa(g) mpa_g mpa-g mpagauge')
    put(PRESSURE, 'kPag', 'kpag kpa(g) kpa_g kpa-g kpagauge')
    put(PRESSURE, 'psig', 'psig psi(g) psi_g psi-g psigauge')
    put(PRESSURE, 'kg/cm2', 'kg/cm2 kg/cm² kgf/cm2 kgf/cm² kp/cm2 kp/cm² ata')
    put(PRESSURE, 'mbar', 'mbar hpa')
    put(TEMPERATURE, 'degC', '°c degc deg.c ºc c cel celsius gradc grad deg_c ℃ ˚c')
    put(TEMPERATURE, 'K', 'k kelvin degk °k')
    put(TEMPERATURE, 'degF', '°f degf deg.f ºf f fahrenheit deg_f ℉ ˚f')
    put(POWER, 'MW', 'mw mwe mwel mw(e) mw(el) mw_e mw_el megawatt mwbrutto mwnetto mwgross mwnet')
    put(POWER, 'kW', 'kw kwe kwel kilowatt')
    put(POWER, 'W', 'w watt')
    put(POWER, 'GW', 'gw gwe')
    return known


SPELLINGS = _spellings()
# Units of what is certainly none of the five signals.
_OTHERS = frozenset({
    'mvar', 'kvar', 'var', 'mva', 'kva', 'hz', 'rpm', '1/min', 'u/min', 'min-1', 't/h', 'kg/s',
    'kg/h', 'm3/h', 'm³/h', 'nm3/h', 'l/h', 'l/s', 'kj/kg', 'kj', 'mj', 'gj', 'mwh', 'kwh', 'gwh',
    'a', 'ka', 'ma', 'v', 'kv', 'mv', 'mm', 'cm', 'm', 'm/s', 'mm/s', 'um', 'µm', 'ppm', 'ppb',
    'mg/m3', 'mg/nm3', 'mg/m³', 'ph', 's', 'sec', 'min', 'h', 'cosphi', 'lb/h', 'klb/h', 'kg', 't',
    'gpm', 'cfm', 'scfm', 'btu', 'btu/h', 'mw/min', '%/min', 'k/min', 'k/h', 'µs/cm', 'us/cm',
    'deg', 'rad', 'mwth', 'mw(th)', 'mw_th',
})  # fmt: skip
_BRACKETED = re.compile(
    r'^(?P<name>.*?)\s*[\[({<]\s*(?P<unit>[^\])}>]*(?:\([^)]*\))?)\s*[\])}>]\s*$'
)
_TRAILING = re.compile(
    r'^(?P<name>.+?)\s*(?:,|/|\bin\b|;|\s-)\s*(?P<unit>[^\s,;]+(?: [a-zA-Z]+)?)$'
)
_APART = re.compile(r'^(?P<name>.+?)\s+(?P<unit>\S+)$')
_LAST_WORD = re.compile(r'^(?P<name>.+?)[\s_.]+(?P<unit>[^\s_.]+)$')
# Pressures that may be either, and what they are called where they are those of a gauge.
_OF_GAUGE = {'bar': 'barg', 'mpa': 'MPag', 'kpa': 'kPag', 'psi': 'psig'}
_GAUGE_WORD = re.compile(
    r'(?<![a-zäöü])(gauge|gage|überdruck|ueberdruck|manometer|relativ|relative|rel|ü)(?![a-zäöü])'
)
_ABSOLUTE_WORD = re.compile(r'(?<![a-zäöü])(abs|absolut|absolute|absolutdruck)(?![a-zäöü])')
# As the last word of a name these are no units: 'PT_100_A', 'Level_C', 'Turbine K'.
_NOT_AS_A_WORD = frozenset(['c', 'k', 'f', 'w', 'pa', 'grad', 'pu', 'a', 'v', 'h', 's', 'm', 't'])


def split_unit(name: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit's text, empty if there is none."""
    text = ' '.join(name.split())
    for pattern in (_BRACKETED, _APART, _TRAILING, _LAST_WORD):
        found = pattern.match(text)
        if found is None:
            continue
        unit = found['unit'].strip()
        if pattern in (_APART, _LAST_WORD) and not _may_end(found['name'], unit, pattern):
            continue
        if is_unit(unit):
            return found['name'].strip(' ,;/-_') or text, unit
    return text, ''


def _may_end(name: str, unit: str, pattern: re.Pattern[str]) -> bool:
    """Tell whether the last word of a name may be its unit: a bare K or C rarely is."""
    word = _squeezed(unit)
    if word in _NOT_AS_A_WORD:
        return pattern is _APART and word in ('c', 'k', 'f') and 'temp' in name.lower()
    return True


def is_unit(text: str) -> bool:
    """Tell whether a cell holds nothing but a unit, ours or another."""
    word = _squeezed(text)
    return word in SPELLINGS or word in _OTHERS or word in ('-', '[-]')


def spelling(text: str) -> Spelling | None:
    """Return the unit a text spells, ``None`` if it is none of the five signals'."""
    found = SPELLINGS.get(_squeezed(text))
    if found is None:
        return None
    return Spelling(found.dimension, found.unit, text.strip())


def of_gauge(found: Spelling | None, told: str) -> Spelling | None:
    """Return a unit as that of a gauge where words beside it say so: 'Überdruck [bar]'.

    Parameters
    ----------
    found : Spelling or None
        The unit as it is written, which says neither gauge nor absolute.
    told : str
        Name and description of the column.
    """
    if found is None or _squeezed(found.written) not in _OF_GAUGE:
        return found
    words = told.lower()
    if not _GAUGE_WORD.search(words) or _ABSOLUTE_WORD.search(words):
        return found
    return Spelling(found.dimension, _OF_GAUGE[_squeezed(found.written)], found.written)


def unit_named(signal: Signal, text: str) -> str:
    """Return the unit of this signal that a text spells, empty if it spells none."""
    found = spelling(text)
    return found.unit if found is not None and found.dimension == DIMENSIONS[signal] else ''


def is_foreign(text: str) -> bool:
    """Tell whether a text spells a unit that none of the signals can have."""
    return _squeezed(text) in _OTHERS


def _squeezed(text: str) -> str:
    word = text.strip().strip('[]{}<>').strip().lower().replace(' ', '')
    if word.startswith('(') and word.endswith(')'):
        word = word[1:-1]
    return word.replace('abs.', 'abs').replace('el.', 'el')
