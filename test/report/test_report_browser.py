"""The page in a real browser without a head, where there is one."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest

from valveflow_ros.report.identification import identification_report

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome', 'chrome')


@pytest.fixture(scope='module')
def browser():
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f'none of {", ".join(BROWSERS)} is installed')
    return found


@pytest.fixture(scope='module')
def dom(browser, identified, tmp_path_factory):
    """Return the page after its scripts ran, and what the browser said."""
    folder = tmp_path_factory.mktemp('browser')
    page = folder / 'report.html'
    page.write_text(identification_report(identified), encoding='utf-8')
    words = [
        browser, '--headless', '--no-sandbox', '--disable-gpu', '--disable-background-networking',
        f'--user-data-dir={folder / "profile"}', '--virtual-time-budget=20000',
        '--enable-logging=stderr', '--dump-dom', page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(words, capture_output=True, text=True, timeout=180, check=True)
    return done.stdout, done.stderr


def test_every_picture_is_drawn(dom):
    text, _ = dom
    assert 'data-drawn="yes"' in text
    for name in ('curve', 'signals', 'choice', 'dynamics'):
        assert re.search(rf'id="{name}"[^>]*class="[^"]*js-plotly-plot|class="[^"]*js-plotly-plot'
                         rf'[^"]*"[^>]*id="{name}"', text), name  # fmt: skip
    # u and power, each twice: steady state and slope response; the four costs and two turns.
    assert text.count('class="trace scatter') >= 12
    assert 'cannot be drawn' not in text.split('<script')[0]


def test_the_browser_has_nothing_to_complain_of(dom):
    _, said = dom
    assert [line for line in said.splitlines() if 'CONSOLE' in line] == []


def test_no_button_sends_the_data_anywhere(dom):
    text, _ = dom
    titles = set(re.findall(r'class="modebar-btn"[^>]*data-title="([^"]*)"', text))
    assert titles
    assert not [t for t in titles if re.search(r'cloud|studio|share|link', t, re.IGNORECASE)]
