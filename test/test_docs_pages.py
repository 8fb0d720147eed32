# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pages keep up with the code: tables, effects, links, pictures and quoted figures."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
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
from valveflow_ros.parameters import TABLE
from valveflow_ros.plant.effects import catalogue as effects

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / 'docs'
PAGES = make_pages.pages()
_LINK = re.compile(r'\]\(([^)\s]+)\)')
_LARGEST = 60 * 1024
DRAWN = sorted(picture_data.DATA.parent.glob('*.svg'))
TAKEN = sorted(picture_data.DATA.parent.glob('*.png'))


def test_generated_parts_are_what_the_code_says() -> None:
    assert not make_pages.stale(), 'run python -m docs.make_pages'


def test_a_part_that_was_changed_by_hand_is_noticed() -> None:
    page = DOCS / 'messages.md'
    text = page.read_text().replace('alarm_run_length', 'alarm_run_width')
    assert make_pages.made(page, text) != text


def test_every_effect_has_a_page_a_picture_and_a_case_and_nothing_else_has() -> None:
    known = set(effects())
    assert set(causes()) <= known
    assert set(page_effects.names()) == known
    assert {p.stem for p in (DOCS / 'effects').glob('*.md')} - {'README'} == known
    assert {p.stem for p in picture_data.DATA.parent.glob('*.svg')} == known | {'curve'}
    assert set(picture_data.CASES) == known


@pytest.mark.parametrize('name', sorted(effects()))
def test_a_page_names_parameters_and_units_as_the_code_does(name: str) -> None:
    text = (DOCS / 'effects' / f'{name}.md').read_text()
    for p in effects()[name].parameters:
        assert f'| `{p.name}` | {p.default} | {p.unit} |' in text
    for u in causes()[name].unknowns if name in causes() else ():
        assert f'| `{u.name}` | {u.unit} | {u.low:g} to {u.high:g} |' in text
    for other in causes()[name].confusers if name in causes() else ():
        assert f'[{other}]({other}.md)' in text
    for heading in ('How it looks', 'What it is confused with', 'What to do about it'):
        body = re.sub(r'<!--.*?-->', '', text.split(f'## {heading}\n')[1].split('\n## ')[0])
        assert len(body.split()) > 10


@pytest.mark.parametrize('name', sorted(effects()))
def test_the_trial_shown_is_the_one_in_the_data_and_was_answered_right(name: str) -> None:
    kept = json.loads((picture_data.DATA / f'{name}.json').read_text())
    assert kept['parameters'] == picture_data.CASES[name].parameters
    assert kept['commands'] == picture_data.commands(name)
    assert name in [cause['name'] for cause in kept['diagnosis']['causes']]


@pytest.mark.parametrize('path', [*DRAWN, *TAKEN], ids=lambda p: p.stem)
def test_a_picture_is_small_and_asks_nothing_of_the_network(path: Path) -> None:
    assert path.stat().st_size <= _LARGEST
    if path in TAKEN:
        return
    for element in ElementTree.parse(path).iter():
        assert 'script' not in element.tag
        for key, value in element.attrib.items():
            if key.endswith('href'):
                assert value.startswith(('#', 'data:'))


def test_a_picture_is_drawn_again_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip('matplotlib')
    from docs import make_pictures

    monkeypatch.setattr(make_pictures, 'PICTURES', tmp_path)
    drawn = make_pictures.effect('backlash').read_bytes()
    assert drawn == make_pictures.effect('backlash').read_bytes()
    assert len(drawn) > 10_000


def _anchors(page: Path) -> set[str]:
    text = re.sub(r'^```.*?^```', '', page.read_text(), flags=re.M | re.S)
    heads = re.findall(r'^#+ (.*)$', text, re.M)
    return {re.sub(r'[^\w\- ]', '', h.lower()).strip().replace(' ', '-') for h in heads}


@pytest.mark.parametrize('page', PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for link in _LINK.findall(page.read_text()):
        if link.startswith(('http://', 'https://')):
            continue
        name, _, anchor = link.partition('#')
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in _anchors(target), link


def test_every_page_is_reached_from_the_readme() -> None:
    seen, todo = set(), [ROOT / 'README.md']
    while todo:
        page = todo.pop()
        if page in seen:
            continue
        seen.add(page)
        names = (link.partition('#')[0] for link in _LINK.findall(page.read_text()))
        todo += [(page.parent / n).resolve() for n in names if n.endswith('.md')]
    assert set(PAGES) <= seen


def test_every_page_is_in_the_navigation_of_the_site() -> None:
    navigation = (ROOT / 'mkdocs.yml').read_text().partition('nav:\n')[2]
    names = [str(page.relative_to(DOCS)) for page in DOCS.rglob('*.md')]
    for name in (*names, *make_site.PROJECT):
        assert re.search(rf'[ ]{re.escape(name)}$', navigation, re.M), name


def test_links_and_blocks_are_turned_for_the_site() -> None:
    text = '[a](../SECURITY.md) [b](../CHANGELOG.rst) [c](page.md)\n```sh jazzy\nls\n```\n'
    turned = make_site.turned(text, '../')
    assert turned == '[a](SECURITY.md) [b](CHANGELOG.md) [c](page.md)\n```sh\nls\n```\n'
    assert '](../' not in make_site.turned((DOCS / 'index.md').read_text(), '../')


def test_the_changelog_has_headings_and_lists_on_the_site():
    text = '^^^^\nPart\n^^^^\n\nNext\n----\n* ``a`` is\n  new.\n* b\n'
    assert make_site.changes(text) == '# Part\n\n## Next\n\n* `a` is\n  new.\n* b\n'


def test_the_site_has_the_help_of_every_executable() -> None:
    for module in make_site.EXECUTABLES.values():
        assert (ROOT / 'valveflow_ros' / 'ros' / f'{module}_main.py').exists()
    scripts = re.search(r"for name in \(('monitor'[^)]*)\)", (ROOT / 'setup.py').read_text())
    assert scripts
    assert set(make_site.EXECUTABLES) == set(re.findall(r"'(\w+)'", scripts[1]))


def test_every_output_service_and_item_of_the_health_has_a_line() -> None:
    assert set(page_tables.output_topics()) == set(page_tables._OUTPUTS)
    assert set(page_tables.service_names()) == set(page_tables._SERVICES)
    assert set(page_health.items()) == set(page_health._ABOUT)


def test_every_message_and_field_is_in_the_handbook() -> None:
    text = (DOCS / 'messages.md').read_text()
    for path in sorted((ROOT / 'msg').glob('*.msg')):
        _, fields, constants = page_tables.message(path)
        assert f'### {path.stem}\n' in text
        lines = [re.sub(r'#.*', '', line) for line in path.read_text().splitlines()]
        assert len(fields) + len(constants) == sum(bool(line.strip()) for line in lines)
        for name, kind, unit, meaning in fields:
            assert f'| `{name}` | `{kind}` | {unit} | {meaning} |' in text
            assert unit, f'{path.stem}.{name} has no unit'


def test_every_parameter_is_in_the_handbook() -> None:
    text = (DOCS / 'messages.md').read_text()
    assert all(re.search(rf'^\| `{row.name}`', text, re.M) for row in TABLE)


def test_every_study_that_a_page_quotes_is_kept() -> None:
    text = re.sub(r'\s+', ' ', ''.join(page.read_text() for page in PAGES))
    commands = re.findall(r'`(python -m benchmarks\.[^`]*--first[^`]*)`', text)
    assert len(commands) > 10
    for command in commands:
        results = page_claims.RESULTS.glob('*.json')
        assert any(command == json.loads(p.read_text()).get('command') for p in results), command


def test_what_was_tried_on_jazzy_stands_there_and_came_out() -> None:
    """The table is written where ros2 is installed; nobody may put a failure into it and go on."""
    text = (DOCS / 'jazzy.md').read_text(encoding='utf-8')
    table = text.partition('<!-- tried -->')[2].partition('<!-- end of tried -->')[0]
    rows = [line for line in table.splitlines() if line.startswith('| ') and '`' in line]
    sentences = {row.split(' | ')[0].removeprefix('| ') for row in rows}
    said = (ROOT / 'tools' / 'jazzy.py').read_text(encoding='utf-8')
    for sentence in sentences:
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
