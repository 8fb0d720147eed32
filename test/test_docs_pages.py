# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pages keep up with the code: tables, effects, links, pictures, figures and sentences."""

import ast
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import pytest

from docs import (
    make_pages,
    make_site,
    page_claims,
    page_effects,
    page_health,
    page_tables,
    picture_data,
)
from valveflow_ros.diagnosis.causes import catalogue as causes
from valveflow_ros.plant.effects import catalogue as effects

ROOT = Path(__file__).resolve().parent.parent
PACKAGE, DOCS = ROOT / 'valveflow_ros', ROOT / 'docs'
PAGES = make_pages.pages()
_LINK = re.compile(r'\]\(([^)\s]+)\)')
_MARK = re.compile(r'<!-- generated: ([\w ._-]+) -->')
_LARGEST = 60 * 1024
PICTURES = picture_data.DATA.parent


def test_generated_parts_are_what_the_code_says() -> None:
    assert not make_pages.stale(), 'run python -m docs.make_pages'
    page = DOCS / 'messages.md'
    text = page.read_text().replace('alarm_run_length', 'alarm_run_width')
    assert make_pages.made(page, text) != text, 'a change by hand is noticed'
    marked = {name for page in PAGES for name in _MARK.findall(page.read_text())}
    assert set(make_pages.PARTS) <= marked


def test_every_effect_has_a_page_a_picture_and_a_case_and_nothing_else_has() -> None:
    known = set(effects())
    assert set(causes()) <= known
    assert set(page_effects.names()) == known
    assert {p.stem for p in (DOCS / 'effects').glob('*.md')} - {'README'} == known
    assert {p.stem for p in PICTURES.glob('*.svg')} == known | {'chance_of_a_name'}
    assert set(picture_data.CASES) == known


def test_the_page_of_an_effect_speaks_of_it_and_its_trial_was_answered_right() -> None:
    parts = ('physics', 'picture', 'numbers', 'others', 'to_do')
    for name in effects():
        text = (DOCS / 'effects' / f'{name}.md').read_text()
        assert set(_MARK.findall(text)) == {f'effect {part}' for part in parts}, name
        for heading in ('How it looks', 'What it is confused with', 'What to do about it'):
            body = re.sub(r'<!--.*?-->', '', text.split(f'## {heading}\n')[1].split('\n## ')[0])
            assert len(body.split()) > 10, (name, heading)
        kept = page_effects.trial(name)
        assert kept['parameters'] == picture_data.CASES[name].parameters, name
        assert kept['commands'] == picture_data.commands(name), name
        assert name in [cause['name'] for cause in kept['diagnosis']['causes']]


def test_pictures_are_small_and_ask_nothing_of_the_network() -> None:
    for path in PICTURES.glob('*.*g'):
        assert path.stat().st_size <= _LARGEST, path
        for element in ElementTree.parse(path).iter() if path.suffix == '.svg' else ():
            assert 'script' not in element.tag, path
            for key, value in element.attrib.items():
                assert not key.endswith('href') or value.startswith(('#', 'data:')), path


def test_a_picture_is_drawn_again_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip('matplotlib')
    from docs import make_pictures

    monkeypatch.setattr(make_pictures, 'PICTURES', tmp_path)
    drawn = make_pictures.effect('backlash').read_bytes()
    assert drawn == make_pictures.effect('backlash').read_bytes()
    assert len(drawn) > 10_000
    assert make_pictures.chance().read_bytes() == make_pictures.chance().read_bytes()


def _anchors(page: Path) -> set[str]:
    text = re.sub(r'^```.*?^```', '', page.read_text(), flags=re.M | re.S)
    heads = re.findall(r'^#+ (.*)$', text, re.M)
    return {re.sub(r'[^\w\- ]', '', h.lower()).strip().replace(' ', '-') for h in heads}


def test_links_lead_somewhere_and_every_page_is_reached_from_the_readme() -> None:
    seen, todo = set(), [ROOT / 'README.md']
    while todo:
        page = todo.pop()
        if page in seen or page.suffix != '.md':
            continue
        seen.add(page)
        for link in _LINK.findall(page.read_text()):
            if link.startswith(('http://', 'https://')):
                continue
            name, _, anchor = link.partition('#')
            target = (page.parent / name).resolve() if name else page
            assert target.exists(), f'{page}: {link}'
            assert not anchor or anchor in _anchors(target), f'{page}: {link}'
            todo.append(target)
    assert set(PAGES) <= seen


def test_every_page_is_in_the_navigation_of_the_site() -> None:
    navigation = (ROOT / 'mkdocs.yml').read_text().partition('nav:\n')[2]
    names = [str(page.relative_to(DOCS)) for page in DOCS.rglob('*.md')]
    for name in (*names, *make_site.PROJECT):
        assert re.search(rf'[ ]{re.escape(name)}$', navigation, re.M), name


def test_the_site_has_the_help_of_every_executable() -> None:
    for module in make_site.EXECUTABLES.values():
        assert (PACKAGE / 'ros' / f'{module}_main.py').exists()
    scripts = re.search(r"for name in \(('monitor'[^)]*)\)", (ROOT / 'setup.py').read_text())
    assert set(make_site.EXECUTABLES) == set(re.findall(r"'(\w+)'", scripts[1]))


def test_every_output_service_and_item_of_the_health_has_a_line() -> None:
    assert set(page_tables.output_topics()) == set(page_tables._OUTPUTS)
    assert set(page_tables.service_names()) == set(page_tables._SERVICES)
    assert set(page_health.items()) == set(page_health._ABOUT)


def test_every_study_that_a_page_quotes_is_kept() -> None:
    text = re.sub(r'\s+', ' ', ''.join(page.read_text() for page in PAGES))
    quoted = set(re.findall(r'`(python -m benchmarks\.[^`]*--first[^`]*)`', text))
    results = page_claims.RESULTS.glob('*.json')
    kept = {json.loads(path.read_text()).get('command') for path in results}
    assert len(quoted) > 10
    assert quoted <= kept


def test_what_was_tried_on_jazzy_stands_there_and_came_out() -> None:
    """The table is written where ros2 is installed; nobody may put a failure into it and go on."""
    text = (DOCS / 'jazzy.md').read_text(encoding='utf-8')
    table = text.partition('<!-- tried -->')[2].partition('<!-- end of tried -->')[0]
    rows = [line for line in table.splitlines() if line.startswith('| ') and '`' in line]
    said = (ROOT / 'tools' / 'jazzy.py').read_text(encoding='utf-8')
    for sentence in {row.split(' | ')[0].removeprefix('| ') for row in rows}:
        assert sentence in said or sentence.startswith(('lifecycle ', 'then it is ')), sentence
    assert len(rows) >= 34
    assert 'FAILED' not in table


def test_where_ros2_is_not_installed_nothing_is_said_to_be_tried() -> None:
    if importlib.util.find_spec('ros2cli'):
        pytest.skip('ros2 is installed here')
    done = subprocess.run(
        [sys.executable, str(ROOT / 'tools' / 'jazzy.py')], capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout[:18]) == (0, 'Nothing was tried:')


# --- troubleshooting quotes what the program says --------------------------------------------

HELP = DOCS / 'troubleshooting.md'
GAP = '…'
QUOTES = [line[2:].strip() for line in HELP.read_text().splitlines() if line.startswith('> ')]


def _template(node: ast.expr) -> str | None:
    """Return a text of the code with a gap for each thing that is filled in."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r'\{[^{}]*\}', GAP, node.value)
    if isinstance(node, ast.JoinedStr):
        return ''.join(
            str(part.value) if isinstance(part, ast.Constant) else GAP for part in node.values
        )
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = _template(node.left), _template(node.right)
        return (left or GAP) + (right or GAP) if left or right else None
    return None


@cache
def _nodes(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text())))


def fits(quote: str, text: str) -> bool:
    """Tell whether a line of the text holds the quote, gaps for gaps."""
    parts = filter(None, quote.split(GAP))
    return re.search('.*'.join(map(re.escape, parts)), text) is not None


def test_every_quote_is_a_sentence_of_the_program() -> None:
    nodes = (node for path in PACKAGE.rglob('*.py') for node in _nodes(path))
    said = {_template(node) or '' for node in nodes if isinstance(node, ast.expr)}
    text = '\n'.join(line.replace('\n', ' ') for line in said)
    assert [quote for quote in QUOTES if not fits(quote, text)] == []
    assert len(QUOTES) > 20


def _spoken() -> Iterator[str]:
    """Yield the sentences that the health of the monitor says where something is not well."""
    for node in _nodes(PACKAGE / 'ros' / 'node' / 'health.py'):
        values: list[ast.expr] = []
        if isinstance(node, ast.Call) and getattr(node.func, 'id', '') == 'Item':
            values = node.args[1:3]
        elif isinstance(node, ast.Tuple) and len(node.elts) == 2:
            values = node.elts
        if len(values) == 2 and ast.unparse(values[0]) in (
            'Level.WARN', 'Level.ERROR', 'Level.STALE'
        ):  # fmt: skip
            text = _template(values[1])
            if text and text.strip(GAP):
                yield text
    for node in _nodes(PACKAGE / 'fit' / 'task.py'):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            yield from filter(None, (_template(a) for a in node.exc.args[:1]))


def test_what_the_monitor_complains_of_is_found_on_the_page() -> None:
    page = re.sub(r'\s+', ' ', HELP.read_text())
    sentences = set(_spoken())
    for sentence in sentences:
        if sentence.startswith('Samples in steady-state'):
            continue  # the number, not a sentence; its advice is quoted
        first = max(re.split(r'…|(?<=\.) ', sentence), key=len).strip()
        assert first in page or any(fits(q, sentence) for q in QUOTES), sentence
    assert len(sentences) > 10
