# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page in a real browser without a head: drawn, brought up to date, lost and found again."""

import time

import pytest
from page_units import alarm, predict, shown_now, told

DESKTOP, PHONE = 1280, 390
LEAST_PX = 13.9
_TEXT = 'document.getElementById("page").innerText'
_NARROW = """
[...document.querySelectorAll('.unit *')].filter(e => e.offsetWidth &&
  e.getBoundingClientRect().right > innerWidth + 1 && !e.closest('.js-plotly-plot'))
  .map(e => e.tagName + e.className)
"""
_SMALL = """
[...document.querySelectorAll('main p, main td, main th, figcaption, footer, main button, .pill')]
  .filter(e => e.offsetWidth && parseFloat(getComputedStyle(e).fontSize) < %s)
  .map(e => e.textContent)
"""
_PLOTS = """
[...document.querySelectorAll('.js-plotly-plot')].map(p =>
  [p.data.length, p.querySelectorAll('.trace path').length, p.layout.xaxis.title.text])
"""


def until(browser, script, what=True, patience_s=30.0):
    """Wait until an expression has a value; a page that is being loaded has none."""
    end_s = time.monotonic() + patience_s
    while True:
        try:
            found = browser.ask(script)
        except RuntimeError:
            found = None
        if found == what:
            return
        assert time.monotonic() < end_s, f'{script} is {found!r}'
        time.sleep(0.1)


def has(browser, text, patience_s=30.0):
    until(browser, f'{_TEXT}.includes({text!r})', patience_s=patience_s)


def drag(browser, element, by):
    """Drag an element's middle to the right with the mouse."""
    browser.ask(f'{element}.scrollIntoView({{block: "center"}})')
    box = browser.ask(f'{element}.getBoundingClientRect().toJSON()')
    at = {'x': box['x'] + box['width'] / 2, 'y': box['y'] + box['height'] / 2}
    more = {'button': 'left', 'buttons': 1, 'clickCount': 1}
    browser.call('Input.dispatchMouseEvent', type='mousePressed', **at, **more)
    for share in (0.5, 1.0):
        to = {**at, 'x': at['x'] + share * by}
        browser.call('Input.dispatchMouseEvent', type='mouseMoved', **to, **more)
    browser.call('Input.dispatchMouseEvent', type='mouseReleased', **to, **more)
    browser.settle()


@pytest.fixture(autouse=True)
def away(browser):
    """Leave the page, so that what another test sets does not reach it."""
    yield
    browser.call('Page.navigate', url='about:blank')
    browser.look(DESKTOP)


@pytest.fixture(autouse=True)
def quick_ticks(monkeypatch):
    """Let the page ask its server more often than every two seconds."""
    monkeypatch.setattr('valveflow_ros.page.view.TICK_MS', 400)


@pytest.fixture
def unit():
    made = told()
    alarm(made, 1, second=199)
    return made


@pytest.mark.parametrize(('width', 'dark'), [(DESKTOP, False), (PHONE, True)])
def test_everything_is_drawn_and_nothing_is_asked_elsewhere(serve, browser, unit, width, dark):
    server = serve(shown_now(unit, told('/other', tag='U2')))
    browser.look(width, dark=dark)
    browser.visit(server.address)
    has(browser, 'What to do: Lubricate, retighten.')
    # Words of a message are words, whatever they look like.
    has(browser, 'The unit gives 9 MW less. <b>')
    until(browser, 'document.querySelectorAll(".js-plotly-plot").length', 6)
    until(browser, f'{_PLOTS}.filter(p => p[1] > 0).length', 6)
    assert [url for url in browser.asked if not url.startswith(server.address)] == []
    assert browser.said == []
    assert browser.ask('document.documentElement.scrollWidth') == width
    assert browser.ask(_NARROW) == []
    assert browser.ask(_SMALL % LEAST_PX) == []
    assert browser.ask('document.querySelectorAll(".ask").length') == 0


def test_it_updates_itself_and_stays_where_it_was_scrolled_to(serve, browser, unit):
    shown = shown_now(unit)
    server = serve(shown)
    browser.look(DESKTOP)
    browser.visit(server.address)
    until(browser, f'{_PLOTS}.filter(p => p[1] > 0).length', 3)
    day = 'document.querySelector(".history .js-plotly-plot")'
    shown_from = f'{day}.layout.xaxis.range[0]'
    drag(browser, f'{day}.querySelector(".nsewdrag")', 200)
    scrolled = browser.ask(shown_from)
    alarm(unit, 2, second=200)
    for k in range(200, 400):
        predict(unit, k, measured=260.0)
    shown.put([unit.snapshot(unit.frame('m'))])
    has(browser, 'alarm, acknowledged')
    until(browser, f'{day}.data[2].y.length', 6)
    assert browser.ask(shown_from) == scrolled
    shown.put([unit.snapshot(unit.frame('m', 'The monitor has gone.'), present=False)])
    has(browser, 'no monitor')


def test_it_says_that_nobody_answers_and_goes_on_by_itself(serve, browser, unit):
    server = serve(shown_now(unit))
    browser.look(DESKTOP)
    browser.visit(server.address)
    has(browser, 'The valve sticks.')
    server.close()
    has(browser, "No answer from the page's process since")
    assert browser.ask('getComputedStyle(document.querySelector(".units")).opacity') < '1'
    serve(shown_now(told('/other', tag='U9')), port=server.port)
    has(browser, 'U9')
    until(browser, 'document.getElementById("lost").innerText', '')


def test_a_button_asks_the_monitor_for_those_who_know_the_token(serve, browser, unit):
    from valveflow_ros.page.view import Asking

    asked = []
    asking = Asking('the right one', lambda *what: asked.append(what) or (True, 'Acknowledged.'))
    server = serve(shown_now(unit), asking=asking)
    browser.look(PHONE)
    browser.visit(server.address)
    has(browser, 'Acknowledge')
    button = 'document.querySelector(".ask button")'
    browser.ask(f'{button}.click()')
    has(browser, 'The token is not the right one.')
    assert browser.ask(f'{button}.getBoundingClientRect().height') >= 40
    browser.ask('document.getElementById("token").focus()')
    browser.call('Input.insertText', text='the right one')
    browser.ask('document.getElementById("token").blur()')
    browser.ask(f'{button}.click()')
    has(browser, 'Acknowledged.')
    assert asked == [('/valveflow_monitor', 'acknowledge residual')]
    assert 'the right one' not in browser.ask(_TEXT)
