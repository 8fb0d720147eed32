"""What plants call the five signals, in English and German, and what only sounds like them.

A name gets marks: a quantity alone ('pressure') one, a quantity of the right
place ('main steam pressure', 'Frischdampfdruck') two. Nothing here looks at
values.
"""

from __future__ import annotations

import re
import unicodedata

from valveflow_ros.logs.tables.historian_units import (
    DIMENSIONS,
    POWER,
    PRESSURE,
    TEMPERATURE,
    Spelling,
)
from valveflow_ros.records import SIGNALS, Signal

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
# What keeps a name from being a measured main steam signal.
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
    """Return a name in small letters, umlauts written out, its words parted by blanks."""
    text = re.sub(r'(?<=[a-zäöü])(?=[A-ZÄÖÜ])', ' ', name)
    text = text.lower().translate(_UMLAUTS)
    text = unicodedata.normalize('NFKD', text)
    text = ''.join(c for c in text if not unicodedata.combining(c))
    return ' '.join(re.split(r'[^a-z0-9%]+', text)).strip()


_UMLAUTS = str.maketrans({'ä': 'ae', 'ö': 'oe', 'ü': 'ue', 'ß': 'ss'})


def marks(name: str, about: str, unit: Spelling | None) -> dict[Signal, float]:
    """Return how well a column suits each signal; signals it does not suit are left out.

    Parameters
    ----------
    name : str
        The column's name without its unit.
    about : str
        What else the file says of it, as a row of descriptions under the header.
    unit : Spelling or None
        The unit that stands beside it.
    """
    plain = name.strip()
    for info in SIGNALS:
        if plain.rsplit('/', 1)[-1].lower() in (info.topic, info.column):
            return {info.signal: EXACT}
    text = f'{folded(name)} {folded(about)}'.strip()
    # P is the pressure to one and the power to another: a letter says nothing, its unit does.
    by_words = _by_words(text) if len(text) > 1 else {}
    if unit is None:
        return by_words
    # What is named after one quantity and measured in the unit of another is neither.
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
        # 'Throttle pressure' is no opening, 'turbine inlet temperature' no power.
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
    """Return the signal that a unit alone suggests, where no word speaks against it."""
    if _ELSEWHERE.search(text) or _NOT_MEASURED.search(text):
        return {}
    if unit.dimension == POWER:
        return {} if _NOT_ACTIVE.search(text) else {Signal.GENERATED_POWER: UNIT}
    if unit.dimension == PRESSURE:
        return {Signal.MAIN_STEAM_PRESSURE: UNIT}
    if unit.dimension == TEMPERATURE:
        return {Signal.MAIN_STEAM_TEMPERATURE: UNIT}
    return {Signal.VALVE_OPENING: UNIT}
