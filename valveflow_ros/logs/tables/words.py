# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recognises the five signals by English and German column names and by units.

A name gets a mark for each signal that it may be: 1 for a quantity alone
('pressure'), 2 for a quantity with its location ('main steam pressure',
'Frischdampfdruck'). Values are not used.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass

from valveflow_ros.records import FLOW_UNITS, SIGNALS, Signal

# The quantities that units measure.
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
    """A unit in a file: its quantity, its name in this project, and its text in the file."""

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
# Units of flows; they are accepted only for a column that the user names.
_FLOWS = {unit.lower(): unit for unit in FLOW_UNITS} | {
    'tph': 't/h', 't/hr': 't/h', 'kg/hr': 'kg/h', 'kg/sec': 'kg/s', 'm³/h': 'm3/h',
    'nm³/h': 'Nm3/h', 'm3/hr': 'm3/h', 'klb/hr': 'klb/h', 'lb/hr': 'lb/h', 'lpm': 'l/min',
}  # fmt: skip
# Units that none of the five signals can have.
_OTHERS = frozenset({
    'mvar', 'kvar', 'var', 'mva', 'kva', 'hz', 'rpm', '1/min', 'u/min', 'min-1', 'l/h', 'kj/kg',
    'kj', 'mj', 'gj', 'mwh', 'kwh', 'gwh', 'a', 'ka', 'ma', 'v', 'kv', 'mv', 'mm', 'cm', 'm',
    'm/s', 'mm/s', 'um', 'µm', 'ppm', 'ppb', 'mg/m3', 'mg/nm3', 'mg/m³', 'ph', 's', 'sec', 'min',
    'h', 'cosphi', 'kg', 't', 'cfm', 'btu', 'btu/h', 'mw/min', '%/min', 'k/min', 'k/h', 'µs/cm',
    'us/cm', 'deg', 'rad', 'mwth', 'mw(th)', 'mw_th', *_FLOWS,
})  # fmt: skip
_BRACKETED = re.compile(
    r'^(?P<name>.*?)\s*[\[({<]\s*(?P<unit>[^\])}>]*(?:\([^)]*\))?)\s*[\])}>]\s*$'
)
_TRAILING = re.compile(
    r'^(?P<name>.+?)\s*(?:,|/|\bin\b|;|\s-)\s*(?P<unit>[^\s,;]+(?: [a-zA-Z]+)?)$'
)
_APART = re.compile(r'^(?P<name>.+?)\s+(?P<unit>\S+)$')
_LAST_WORD = re.compile(r'^(?P<name>.+?)[\s_.]+(?P<unit>[^\s_.]+)$')
# Pressure units that may be absolute or gauge, and the name of the gauge unit.
_OF_GAUGE = {'bar': 'barg', 'mpa': 'MPag', 'kpa': 'kPag', 'psi': 'psig'}
_GAUGE_WORD = re.compile(
    r'(?<![a-zäöü])(gauge|gage|überdruck|ueberdruck|manometer|relativ|relative|rel|ü)(?![a-zäöü])'
)
_ABSOLUTE_WORD = re.compile(r'(?<![a-zäöü])(abs|absolut|absolute|absolutdruck)(?![a-zäöü])')
# Not taken as a unit if they are the last word of a name: 'PT_100_A', 'Level_C', 'Turbine K'.
_NOT_AS_A_WORD = frozenset(['c', 'k', 'f', 'w', 'pa', 'grad', 'pu', 'a', 'v', 'h', 's', 'm', 't'])


def split_unit(name: str) -> tuple[str, str]:
    """Return the name of a column without its unit, and the unit; empty if there is none."""
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
    """Return True if the last word of a name may be its unit; a single K or C rarely is."""
    word = _squeezed(unit)
    if word in _NOT_AS_A_WORD:
        return pattern is _APART and word in ('c', 'k', 'f') and 'temp' in name.lower()
    return True


def is_unit(text: str) -> bool:
    """Return True if a cell holds only a unit, of the five signals or another."""
    word = _squeezed(text)
    return word in SPELLINGS or word in _OTHERS or word in ('-', '[-]')


def spelling(text: str) -> Spelling | None:
    """Return the unit that a text means; ``None`` if no signal can have it."""
    found = SPELLINGS.get(_squeezed(text))
    if found is None:
        return None
    return Spelling(found.dimension, found.unit, text.strip())


def of_gauge(found: Spelling | None, told: str) -> Spelling | None:
    """Return the gauge unit if the column is a gauge pressure, as in 'Überdruck [bar]'.

    ``told`` is the name and description of the column.
    """
    if found is None or _squeezed(found.written) not in _OF_GAUGE:
        return found
    words = told.lower()
    if not _GAUGE_WORD.search(words) or _ABSOLUTE_WORD.search(words):
        return found
    return Spelling(found.dimension, _OF_GAUGE[_squeezed(found.written)], found.written)


def flow_spelled(text: str) -> Spelling | None:
    """Return the unit of a flow that a text means; ``None`` if it is none."""
    unit = _FLOWS.get(_squeezed(text))
    return None if unit is None else Spelling(POWER, unit, text.strip())


def unit_named(signal: Signal, text: str) -> str:
    """Return the unit of this signal that a text means; empty if it is none."""
    found = spelling(text) or flow_spelled(text)
    return found.unit if found is not None and found.dimension == DIMENSIONS[signal] else ''


def is_foreign(text: str) -> bool:
    """Return True if a text is a unit that none of the signals can have."""
    return _squeezed(text) in _OTHERS


def _squeezed(text: str) -> str:
    word = text.strip().strip('[]{}<>').strip().lower().replace(' ', '')
    if word.startswith('(') and word.endswith(')'):
        word = word[1:-1]
    return word.replace('abs.', 'abs').replace('el.', 'el')


EXACT, CLEAR, LIKELY, TAG, UNIT = 4.0, 2.0, 1.0, 0.8, 0.5

_VALVE = re.compile(
    r'valve|ventil|\bgov|governor|throttle|\bgvs?\d*\b|\bcvs?\d*\b|\btcv\d*\b|\bmcv\d*\b|\bhpcv'
)
_PLACE = re.compile(
    r'open|oeffn|offn|\bpos\b|position|stellung|\bhub\b|hub\b|stroke|\blift\b|travel|\bauf\b|'
    r'feedback|\bfbk?\b|rueckm|\bist\b|istwert'
)
_COMMAND = re.compile(
    r'command|\bcmd\b|demand|\bdmd\b|setpoint|set point|\bsp\b|soll|stellbefehl|stellgroesse|'
    r'\bref\b|reference|\bout(?:put)?\b|\bop\b|vorgabe'
)
_OPENING_TAG = re.compile(r'\b(?:zt|zi|zit|gt|gi) ?\d')
_PRESSURE = re.compile(r'pressure|druck|\bpress?\b|\bp\b|\bmsp\b|\bpms\b|\bpfd\b')
_TEMPERATURE = re.compile(r'temp|\bt\b|\bmst\b|\btms\b|\btfd\b')
_STEAM = re.compile(
    r'main ?steam|live ?steam|frischdampf|frisch ?dampf|\bfd\b|\bms\b|\bhp\b|\bhd\b|throttle|'
    r'initial|turbine inlet|inlet|vor turbine|vor hd|turbineneintritt|steam|dampf|\bmsp\b|'
    r'\bmst\b|\bpms\b|\btms\b|\bpfd\b|\btfd\b|superheat|ueberhitzer'
)
_PRESSURE_TAG = re.compile(r'\b(?:pt|pi|pit|ps|px) ?\d|^(?:pt|ps|pit)$')
_TEMPERATURE_TAG = re.compile(r'\b(?:tt|te|ti|tit|tx|ts) ?\d|^(?:tt|te)$')
_POWER = re.compile(
    r'power|leistung|\bload\b|\blast\b|megawatt|\bmwe?l?\b|output|\bgen\b|generation'
)
_OF_UNIT = re.compile(
    r'generat|\bgen\b|active|wirk|\bunit\b|\bblock|turbine|turbo|electric|elektr|\bklemmen'
)
_POWER_TAG = re.compile(r'\b(?:jt|ji|jit|et) ?\d')
# Words of names that are not measured main steam signals.
_NOT_MEASURED = re.compile(
    r'setpoint|set point|\bsp\b|soll|target|ziel|limit|grenz|alarm|deviation|abweich|diff|delta|'
    r'\brate\b|gradient|status|qualit|total|average|mittel|\bavg\b|\bmax|\bmin\b|command|\bcmd\b|'
    r'demand|\bdmd\b|vorgabe|\bref\b|reference|forecast|prognose|counter|zaehler|energy|energie|'
    r'quality'
)
_ELSEWHERE = re.compile(
    r'reheat|hzue|kzue|\bzue|zwischen|condens|kondens|extract|anzapf|feed|speis|drum|trommel|'
    r'lube|\boil\b|oel|exhaust|abdampf|flue|rauch|furnace|feuerraum|vacuum|vakuum|first stage|'
    r'radkammer|stage|stufe|deaer|entgas|cool|kuehl|ambient|umgebung|aussen|bearing|lager|metal|'
    r'\bair\b|luft|\bgas\b|water|wasser|\bip\b|\blp\b|\bmd\b|\bnd\b|winding|wickl|gland|sperr|'
    r'spray|einspritz|bypass|umleit|drain|entwaess|intercept|abfang|stop ?valve|stopventil|'
    r'schnellschluss|\besv\b|\bmsv\b|damper|klappe|fuel|brennst|\bcoal|kohle|level|niveau|'
    r'humid|feuchte|oxygen|sauerst|fan\b|geblaese|pump|mill|muehle'
)
_NOT_ACTIVE = re.compile(
    r'react|blind|\bmvar|apparent|schein|factor|faktor|\bpf\b|auxil|eigenbed|thermal|therm|'
    r'heat|waerme|house|supply|\bups\b'
)


def folded(name: str) -> str:
    """Return a name in lower case, with 'ae' for 'ä' etc., and words separated by spaces."""
    text = re.sub(r'(?<=[a-zäöü])(?=[A-ZÄÖÜ])', ' ', name)
    text = text.lower().translate(_UMLAUTS)
    text = unicodedata.normalize('NFKD', text)
    text = ''.join(c for c in text if not unicodedata.combining(c))
    return ' '.join(re.split(r'[^a-z0-9%]+', text)).strip()


_UMLAUTS = str.maketrans({'ä': 'ae', 'ö': 'oe', 'ü': 'ue', 'ß': 'ss'})


def marks(name: str, about: str, unit: Spelling | None) -> dict[Signal, float]:
    """Return the marks of a column for the signals that it may be; a higher mark is better.

    ``name`` is without the unit; ``about`` is its description in the file, for example from a
    row under the header.
    """
    plain = name.strip()
    for info in SIGNALS:
        if plain.rsplit('/', 1)[-1].lower() in (info.topic, info.column):
            return {info.signal: EXACT}
    text = f'{folded(name)} {folded(about)}'.strip()
    # A single letter is ambiguous (P: pressure or power), so only its unit is used.
    by_words = _by_words(text) if len(text) > 1 else {}
    if unit is None:
        return by_words
    # A column whose name and unit are of different quantities is neither of them.
    return {
        signal: mark
        for signal, mark in (by_words or _by_unit(text, unit)).items()
        if unit.dimension == DIMENSIONS[signal]
    }


def _by_words(text: str) -> dict[Signal, float]:
    found: dict[Signal, float] = {}
    away = bool(_ELSEWHERE.search(text))
    valve, place = bool(_VALVE.search(text)), bool(_PLACE.search(text))
    if not away and valve and _COMMAND.search(text):
        return {Signal.VALVE_COMMAND: CLEAR}
    if _NOT_MEASURED.search(text):
        return found
    if not away:
        if valve or (place and not _POWER.search(text)):
            found[Signal.VALVE_OPENING] = CLEAR if valve and place else LIKELY
        elif _OPENING_TAG.search(text):
            found[Signal.VALVE_OPENING] = TAG
        found |= _of_steam(text, Signal.MAIN_STEAM_PRESSURE, _PRESSURE, _PRESSURE_TAG)
        found |= _of_steam(text, Signal.MAIN_STEAM_TEMPERATURE, _TEMPERATURE, _TEMPERATURE_TAG)
    if not _NOT_ACTIVE.search(text) and not away:
        if _POWER.search(text):
            clear = bool(_OF_UNIT.search(text))
            found[Signal.GENERATED_POWER] = CLEAR if clear else LIKELY
        elif _POWER_TAG.search(text):
            found[Signal.GENERATED_POWER] = TAG
    if Signal.MAIN_STEAM_PRESSURE in found or Signal.MAIN_STEAM_TEMPERATURE in found:
        # 'Throttle pressure' is not an opening, 'turbine inlet temperature' not a power.
        found.pop(Signal.VALVE_OPENING, None)
        found.pop(Signal.GENERATED_POWER, None)
    return found


def _of_steam(
    text: str, signal: Signal, words: re.Pattern[str], tag: re.Pattern[str]
) -> dict[Signal, float]:
    if words.search(text):
        return {signal: CLEAR if _STEAM.search(text) else LIKELY}
    return {signal: TAG} if tag.search(text) else {}


def _by_unit(text: str, unit: Spelling) -> dict[Signal, float]:
    """Return the signal that a unit alone suggests, unless a word excludes it."""
    if _ELSEWHERE.search(text) or _NOT_MEASURED.search(text):
        return {}
    if unit.dimension == POWER:
        return {} if _NOT_ACTIVE.search(text) else {Signal.GENERATED_POWER: UNIT}
    if unit.dimension == PRESSURE:
        return {Signal.MAIN_STEAM_PRESSURE: UNIT}
    if unit.dimension == TEMPERATURE:
        return {Signal.MAIN_STEAM_TEMPERATURE: UNIT}
    return {Signal.VALVE_OPENING: UNIT}
