# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Troubleshooting quotes what the program says, and what the monitor says is quoted there."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / 'docs' / 'troubleshooting.md'
PACKAGE = ROOT / 'valveflow_ros'
GAP = '…'


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
def said() -> list[str]:
    """Return every text of the package."""
    found = []
    for path in PACKAGE.rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.expr) and (text := _template(node)):
                found.append(text)
    return found


def quotes() -> list[str]:
    """Return what the page quotes."""
    return [line[2:].strip() for line in PAGE.read_text().splitlines() if line.startswith('> ')]


def fits(quote: str, text: str) -> bool:
    """Tell whether a quote is that text, or the beginning or end of it, gaps for gaps."""
    at = 0
    for part in quote.split(GAP):
        if (found := text.find(part, at)) < 0:
            return False
        at = found + len(part)
    return True


@pytest.mark.parametrize('quote', quotes())
def test_every_quote_is_a_sentence_of_the_program(quote: str) -> None:
    assert any(fits(quote, text) for text in said())


def _spoken() -> Iterator[str]:
    """Yield the sentences that the health of the monitor says where something is not well."""
    for node in ast.walk(ast.parse((PACKAGE / 'ros' / 'node' / 'health.py').read_text())):
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
    tree = ast.parse((PACKAGE / 'fit' / 'task.py').read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            yield from filter(None, (_template(a) for a in node.exc.args[:1]))


@pytest.mark.parametrize('sentence', sorted(set(_spoken())))
def test_what_the_monitor_complains_of_is_found_on_the_page(sentence: str) -> None:
    if sentence.startswith('Samples in steady-state'):
        return  # the number, not a sentence; its advice is quoted
    first = max(re.split(r'…|(?<=\.) ', sentence), key=len).strip()
    page = re.sub(r'\s+', ' ', PAGE.read_text())
    assert any(fits(q, sentence) for q in quotes()) or first in page
