"""Tables with a row for each value: time, tag, value, as PI and its kin export them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from valveflow_ros.logs.tables.historian_layout import Heading
from valveflow_ros.logs.tables.historian_units import split_unit
from valveflow_ros.logs.tables.historian_words import folded

if TYPE_CHECKING:
    from valveflow_ros.logs.tables.table_file import TableFile

_TAG = re.compile(
    r'^(?:pi )?(?:tag|point|sensor|item|variable|signal|name|kks|channel)(?: ?(?:name|id))?$|'
    r'^(?:messstelle|kennzeichen|messstellenname|messgroesse|tag path)$'
)
_VALUE = re.compile(r'^(?:value|wert|messwert|val|reading|y|pv|avg|average|mean)$')
_UNIT = re.compile(r'^(?:unit|units|uom|eng units|engineering units|einheit|eu)$')
_QUALITY = re.compile(r'^(?:quality|status|qualitaet|quality code|guete|opc quality)$')
_ABOUT = re.compile(r'^(?:description|descriptor|beschreibung|bezeichnung|comment)$')


@dataclass(frozen=True, slots=True)
class LongForm:
    """Where tag, value and the rest stand; -1 where they do not."""

    tag: int
    value: int
    unit: int = -1
    quality: int = -1
    about: int = -1


def long_form(heading: Heading) -> LongForm | None:
    """Return the places of a long table's columns, ``None`` if it is none."""
    names = [folded(split_unit(name)[0]) for name in heading.names]

    def place(pattern: re.Pattern[str]) -> int:
        return next((k for k, name in enumerate(names) if pattern.search(name)), -1)

    tag, value = place(_TAG), place(_VALUE)
    if tag < 0 or value < 0:
        return None
    return LongForm(tag, value, place(_UNIT), place(_QUALITY), place(_ABOUT))


def tags_of(file: TableFile, form: LongForm) -> Heading:
    """Return the tags of a long table as if they were columns; reads all of their names."""
    places = [k for k in (form.tag, form.unit, form.about) if k >= 0]
    found: dict[str, tuple[str, str]] = {}
    for frame in file.blocks(places):
        text = frame.astype('string').fillna('')
        for row in text.drop_duplicates(form.tag).itertuples(index=False):
            cells = dict(zip(sorted(set(places)), row, strict=True))
            tag = cells[form.tag].strip()
            if tag and tag not in found:
                unit, about = cells.get(form.unit, ''), cells.get(form.about, '')
                found[tag] = (unit.strip(), about.strip())
    names = tuple(found)
    units = tuple(found[tag][0] or split_unit(tag)[1] for tag in names)
    return Heading(0, (), names, units, tuple(found[tag][1] for tag in names))
