# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pages in a real browser without a head, where there is one: drawn, touched, printed."""

import json
import os
import re
import shutil
import subprocess
from dataclasses import replace

import pytest
from report_stories import diagnosed, history

from valveflow_ros.interface.compare import compare, validate
from valveflow_ros.interface.simulate import simulate
from valveflow_ros.report.diagnosis import diagnosis_page
from valveflow_ros.report.identification import identification_page

PHONE, DESKTOP = 390, 1280
LEAST_PX = 14.0


def made_pages(identified):
    """Every kind of picture: an identification with a history, a reference, holes; a diagnosis."""
    values = identified.table.values.copy()
    values[1000:3000, 2] = float('nan')
    table = replace(identified.table, values=values)
    known = {'reference': identified.characteristic, 'history': history()}
    data = replace(identified, table=table, **known)
    return {'identify': identification_page(data), 'diagnose': diagnosis_page(diagnosed())}


def judged_pages(folder):
    """Three methods on ten hours of the paper's plant, and its curve held against them."""
    plant, truth = simulate(0.4, 1), folder / 'truth.json'
    plant.write(folder / 'plant.mcap', truth=truth)
    log = plant.to_dataframe()[::4]
    quick = {'refine': False, 'selection_rule': 'paper'}
    found = compare(log, truth=truth, parameters=quick)
    checked = validate(log, found.comparison.characteristic)
    return {'compare': found.page(), 'validate': checked.page()}


# What is asked of the page in its present look; one answer serves several tests.
_DRAWN = """
JSON.stringify([...document.querySelectorAll('.js-plotly-plot')].map(p => ({
  name: p.id, width: p.querySelector('.main-svg').getBoundingClientRect().width,
  parts: p.querySelectorAll('.trace path, .hm image, .heatmaplayer image').length,
  y: p.data.map(t => Array.isArray(t.y) ? t.y : null)})))
"""
_WIDE = """
[...document.querySelectorAll('.plot, .svg-container, table, p, figcaption, li, .legendtext, '
  + '[class$=title] text, text[class$=title]')]
  .filter(e => e.getBoundingClientRect().right > innerWidth + 1 && e.offsetWidth)
  .map(e => e.id + e.tagName + e.textContent.slice(0, 40))
"""
_SMALL = """
[...document.querySelectorAll('main p, main td, main th, main li, figcaption, footer, .plot text')]
  .filter(e => e.textContent.trim() && e.getBoundingClientRect().width &&
    parseFloat(getComputedStyle(e).fontSize) < %s)
  .map(e => e.textContent.slice(0, 30))
"""
_COLOURS = """
[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color,
 getComputedStyle(document.querySelector('.xtick text')).fill]
"""
# Listens after the page itself does.
_LISTEN = """
window.addEventListener('beforeprint', () => { window.atPrint = {
  widths: [...document.querySelectorAll('.js-plotly-plot')].map(
    p => p.querySelector('.main-svg').getBoundingClientRect().width),
  paper: getComputedStyle(document.body).backgroundColor,
  folded: document.querySelectorAll('details:not([open])').length}; })
"""


def seen(browser, path, width, *, dark=False):
    browser.look(width, dark=dark)
    browser.open(path)
    browser.settle()
    return browser


def looked_at(browser, path, pdf):
    """Open a page in a light window and on a dark telephone, and return what was seen."""
    seen(browser, path, DESKTOP)
    found = {
        'drawn': json.loads(browser.ask(_DRAWN)),
        'waiting': browser.ask("document.querySelectorAll('.waiting').length"),
        'buttons': browser.ask(
            "[...document.querySelectorAll('.modebar-btn')].map(b => b.dataset.title)"
        ),
        'light': browser.ask(_COLOURS), 'met': browser.said + browser.asked,
    }  # fmt: skip
    seen(browser, path, PHONE, dark=True)
    found |= {
        'scroll': browser.ask('document.documentElement.scrollWidth'),
        'wide': browser.ask(_WIDE), 'small': browser.ask(_SMALL % LEAST_PX),
        'phone': json.loads(browser.ask(_DRAWN)), 'dark': browser.ask(_COLOURS),
        'met_on_phone': browser.said + browser.asked,
    }  # fmt: skip
    browser.ask(_LISTEN)
    pdf.write_bytes(browser.paper())
    printed = browser.ask('window.atPrint')
    return found | {'printed': printed, 'pdf': pdf, 'met_on_paper': browser.said + browser.asked}


@pytest.fixture(scope='module')
def pages(identified, tmp_path_factory):
    """Return the pages by name: their content, and the file."""
    folder = tmp_path_factory.mktemp('pages')
    made = {}
    contents = made_pages(identified)
    if os.environ.get('NUMBA_DISABLE_JIT') != '1':  # hours of data need the compiled engine
        contents |= judged_pages(folder)
    for name, content in contents.items():
        path = folder / f'{name}.html'
        path.write_text(content.to_html(), encoding='utf-8')
        made[name] = content, path
    return made


@pytest.fixture(scope='module', params=['identify', 'diagnose', 'compare', 'validate'])
def page(request, browser, pages, tmp_path_factory):
    """Return a page's content, and what was seen of it."""
    if request.param not in pages:
        pytest.skip('hours of data need the compiled engine')
    content, path = pages[request.param]
    return content, looked_at(browser, path, tmp_path_factory.mktemp('pdf') / 'page.pdf')


def test_every_picture_is_drawn_with_its_numbers_and_nothing_is_asked_for(page):
    content, found = page
    assert [d['name'] for d in found['drawn']] == [f.name for f in content.figures]
    assert all(d['width'] > 600 and d['parts'] for d in found['drawn'])
    assert found['waiting'] == 0
    assert found['met'] == found['met_on_phone'] == found['met_on_paper'] == []
    for figure, drawn in zip(content.figures, found['drawn'], strict=True):
        given = [t.get('y') for t in json.loads(figure.to_json())['data']]
        assert drawn['y'] == [y if isinstance(y, list) else None for y in given], figure.name


def test_no_button_sends_the_data_anywhere(page):
    titles = page[1]['buttons']
    assert titles
    assert not [t for t in titles if re.search(r'cloud|studio|share|link', t, re.IGNORECASE)]


def test_a_telephone_needs_no_scrolling_to_the_side_and_no_glasses(page):
    found = page[1]
    assert found['small'] == []
    assert found['scroll'] <= PHONE
    assert found['wide'] == []
    assert all(0.8 * PHONE < d['width'] <= PHONE for d in found['phone'])


def test_light_and_dark_differ_and_can_both_be_read(page):
    for look in ('light', 'dark'):
        paper, ink, tick = (sum(map(int, re.findall(r'\d+', c)[:3])) for c in page[1][look])
        assert (paper < ink) is (look == 'dark')
        assert abs(paper - ink) > 450, 'ink stands out'
        assert abs(paper - tick) > 450, 'so do the numbers at an axis'


def test_paper_gets_every_picture_whole_and_light(page):
    """Printed from a dark telephone: as wide as A4, white, opened, each caption there."""
    content, found = page
    at = found['printed']
    assert len(at['widths']) == len(content.figures)
    a4_px = (210 - 28) / 25.4 * 96
    assert all(0.9 * a4_px < w <= a4_px for w in at['widths'])
    assert at['paper'] == 'rgb(255, 255, 255)'
    assert at['folded'] == 0
    if (tool := shutil.which('pdftotext')) is None:
        return
    words = [tool, str(found['pdf']), '-']
    printed = subprocess.run(words, capture_output=True, text=True, check=True)
    told = ' '.join(printed.stdout.split())
    for figure in content.figures:
        first = re.match(r'<b>(.*?)</b>', figure.caption).group(1)
        plain = ' '.join(re.sub(r'<[^>]+>', '', first).split())
        assert plain in told, figure.name


def told_at(browser, figure, x, y):
    """Return what a picture says when the mouse points at a place of its axes."""
    left, top = browser.ask(
        f"(() => {{ const p = document.getElementById('{figure}'), l = p._fullLayout;"
        "p.scrollIntoView({block: 'center'}); const r = p.getBoundingClientRect();"
        f'return [r.left + l.xaxis._offset + l.xaxis.d2p({x}),'
        f' r.top + l.yaxis._offset + l.yaxis.d2p({y})]; }})()'
    )
    browser.hover(left - 40, top - 40)
    browser.hover(left, top)
    return browser.ask(
        'new Promise(done => { const look = () => { const h = '
        f"document.querySelector('#{figure} .hoverlayer .hovertext');"
        'h ? done(h.textContent) : requestAnimationFrame(look); }; look(); })'
    )


def test_a_point_tells_its_value_and_pictures_follow_the_window(browser, pages):
    """The mouse over the breakpoint shows its number; a narrower window, a narrower picture."""
    content, path = pages['identify']
    seen(browser, path, DESKTOP)
    point = next(t for t in content.figures[0].traces if t['name'].startswith('breakpoints'))
    text = told_at(browser, 'curve', point['x'][0], point['y'][0])
    assert f'u {point["x"][0]:.0f}' in text
    browser.look(700)
    width = browser.ask(
        'new Promise(done => { const look = () => { const w = document.querySelector('
        "'.main-svg').getBoundingClientRect().width;"
        'w < 700 ? done(w) : requestAnimationFrame(look); }; look(); })'
    )
    assert 500 < width < 700


def test_everything_that_can_be_pointed_at_has_a_unit(pages):
    unit = re.compile(r'MW|%|°C| s<|\bh<|samples|\bJ\b|\d{4}-\d\d-\d\d')
    for figure in (figure for content, _ in pages.values() for figure in content.figures):
        for trace in figure.traces:
            if trace.get('hoverinfo') != 'skip':
                told = trace.get('hovertext') or [trace.get('hovertemplate', '')]
                assert all(unit.search(h) or h.startswith('breakpoint') for h in told), figure.name
