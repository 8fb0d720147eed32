# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The examples of ``docs/python.md`` and the notebook run, one after the other, as shown."""

import json
import re
from pathlib import Path

from streams import needs_jit

DOCS = Path(__file__).resolve().parents[2] / 'docs'
EXAMPLES = re.findall(r'```python\n(.*?)```', (DOCS / 'python.md').read_text(), re.DOTALL)


def cells(kind):
    notebook = json.loads((DOCS / 'python.ipynb').read_text())
    assert (notebook['nbformat'], notebook['nbformat_minor']) == (4, 5)
    return [''.join(c['source']) for c in notebook['cells'] if c['cell_type'] == kind]


def test_the_notebook_shows_the_examples_of_the_page():
    assert [example.strip() for example in EXAMPLES] == cells('code')
    assert len(EXAMPLES) == 5
    page = (DOCS / 'python.md').read_text()
    assert all(text in page for text in cells('markdown')[1:])


@needs_jit
def test_the_cells_of_the_notebook_run_in_their_order(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {'__name__': 'notebook'}
    for number, code in enumerate(cells('code'), 1):
        exec(compile(code, f'cell {number}', 'exec'), names)
    out = capsys.readouterr().out
    assert 'MW per unit of u' in out
    assert 'pieces' in out
    assert (tmp_path / 'told' / 'monitor.json').is_file()
