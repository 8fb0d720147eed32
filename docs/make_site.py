# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pages of the site, from which mkdocs makes HTML: those of docs/ and some from the code.

Run: ``python -m docs.make_site``; ``make docs`` does, and builds. The pages of docs/ are for the
code host too; here their links to files outside docs/ are turned.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import valveflow_ros
from docs import page_claims, page_tables
from valveflow_ros.cli.main import VERBS

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / 'site' / 'source'
PROJECT = ('CONTRIBUTING.md', 'SECURITY.md', 'QUALITY_DECLARATION.md')
EXECUTABLES = {
    'monitor': 'monitor', 'opcua_gateway': 'gateway', 'page': 'page',
    'plant_simulator': 'simulator', 'replay': 'replay', 'watch': 'watch',
}  # fmt: skip
# What a call returns and takes, beside the functions themselves.
CLASSES = ('valveflow_ros.interface.Progress', 'valveflow_ros.curve.characteristic.Characteristic')
# Of this module the classes alone.
ERRORS = "::: valveflow_ros.errors\n    options: {filters: ['!^[a-z]']}\n"
_FENCE = re.compile(r'^( *```\w+) [\w ]+$', re.M)


def turned(text: str, folder: str) -> str:
    """Return a page with links as they are on the site, and blocks of one word.

    Parameters
    ----------
    text : str
    folder : str
        What stands before a link in this page and not on the site: ``../`` or ``docs/``.
    """
    text = text.replace(f']({folder}', '](').replace('](CHANGELOG.rst)', '](CHANGELOG.md)')
    return _FENCE.sub(r'\1', text)


def changes(text: str) -> str:
    """Return a changelog, which is written in reStructuredText, as Markdown."""
    text = re.sub(r'^\^+\n(.+)\n\^+$', r'# \1', text, flags=re.M)
    return re.sub(r'^(\S.*)\n-+$', r'## \1\n', text, flags=re.M).replace('``', '`')


def verbs() -> str:
    """Return what every verb and every executable says of itself."""
    environment = {**os.environ, 'COLUMNS': '100'}
    parts = ['# Verbs and executables\n', page_tables.verbs()]
    asked = [(f'valveflow {name}', ['valveflow_ros.cli', name]) for name, _, _ in VERBS]
    asked += [
        (f'ros2 run valveflow_ros {name}', [f'valveflow_ros.ros.{module}_main'])
        for name, module in EXECUTABLES.items()
    ]
    for title, words in asked:
        said = subprocess.run(
            [sys.executable, '-m', *words, '--help'],
            env=environment, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        parts.append(f'## {title}\n\n```text\n{said.strip()}\n```\n')
    return '\n'.join(parts)


def interface() -> str:
    """Return the reference of the Python interface, to be filled in from the docstrings."""
    names = [
        f'valveflow_ros.interface.{module}.{name}'
        for name, module in valveflow_ros._MODULES.items()
    ]
    about = '`import valveflow_ros as vf` offers these functions: `vf.identify` and so on.\n'
    parts = [f'::: {name}\n' for name in (*names, *CLASSES)]
    return '\n'.join(['# Python interface\n', about, *parts, ERRORS])


def studies() -> str:
    """Return every study: the table of the handbook, and the kept results."""
    rows = []
    for path in sorted(page_claims.RESULTS.glob('*.json')):
        command = json.loads(path.read_text()).get('command', '')
        rows.append((f'[{path.stem}](results/{path.name})', f'`{command}`' if command else ''))
    kept = page_tables.table(('result', 'command'), rows)
    return '\n'.join(['# Studies\n', page_claims.measured(), '## Kept results\n', kept])


def gallery() -> str:
    """Return the pictures of reports, page and effects, each with the caption of its page."""
    pages = [ROOT / 'README.md', *sorted((ROOT / 'docs').rglob('*.md'))]
    captions = {}
    for page in pages:
        text = page.read_text()
        for caption, name in re.findall(r'!\[(.*?)\]\([^)]*pictures/(\S+)\)', text):
            effect = page.parent.name == 'effects'
            captions[name] = (
                f'[{text.splitlines()[0].lstrip("# ")}](effects/{page.name})'
                if effect
                else caption
            )
    parts = ['# Gallery\n', '[The examples in Python](notebook.md).\n']
    parts += [f'## {captions[name]}\n\n![](pictures/{name})\n' for name in sorted(captions)]
    return '\n'.join(parts)


def notebook() -> str:
    """Return the notebook of the handbook as a page."""
    parts = ['[As a notebook](python.ipynb).\n']
    for cell in json.loads((ROOT / 'docs' / 'python.ipynb').read_text())['cells']:
        text = ''.join(cell['source'])
        parts.append(f'```python\n{text}\n```\n' if cell['cell_type'] == 'code' else f'{text}\n')
    parts[:2] = parts[1::-1]  # the title comes first
    return '\n'.join(parts)


def main() -> int:
    """Write every page."""
    shutil.rmtree(SOURCE, ignore_errors=True)
    pages = {
        'reference/verbs.md': verbs(), 'reference/python.md': interface(),
        'studies.md': studies(), 'gallery.md': gallery(), 'notebook.md': notebook(),
        'CHANGELOG.md': changes((ROOT / 'CHANGELOG.rst').read_text()),
        **{name: turned((ROOT / name).read_text(), 'docs/') for name in PROJECT},
    }  # fmt: skip
    for path in sorted((ROOT / 'docs').rglob('*.md')):
        outside = '../' if path.parent.name == 'docs' else './../'
        pages[str(path.relative_to(ROOT / 'docs'))] = turned(path.read_text(), outside)
    for name, text in pages.items():
        (SOURCE / name).parent.mkdir(parents=True, exist_ok=True)
        (SOURCE / name).write_text(text)
    shutil.copytree(ROOT / 'config', SOURCE / 'config')
    shutil.copytree(
        ROOT / 'docs' / 'pictures', SOURCE / 'pictures', ignore=shutil.ignore_patterns('data')
    )
    shutil.copytree(
        page_claims.RESULTS, SOURCE / 'results', ignore=shutil.ignore_patterns('regression_base')
    )
    for name in ('LICENSE', 'docs/python.ipynb'):
        shutil.copy(ROOT / name, SOURCE)
    return 0


if __name__ == '__main__':
    sys.exit(main())
