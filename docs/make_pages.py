# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The generated parts of the pages: tables and texts that the code already holds.

Run: ``python -m docs.make_pages``; with ``--check`` nothing is written and the exit status
says whether a page is out of date. A generated part stands between ``<!-- generated: NAME -->``
and ``<!-- end -->``; what stands outside is written by hand.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

from docs import page_claims, page_effects, page_health, page_tables

ROOT = Path(__file__).resolve().parent.parent
_PART = re.compile(r'(<!-- generated: ([a-z ._-]+) -->\n)(.*?)(<!-- end -->)', re.S)

PARTS: dict[str, Callable[[], str]] = {
    'verbs': page_tables.verbs,
    'inputs': page_tables.inputs,
    'outputs': page_tables.outputs,
    'services': page_tables.services,
    'parameters': page_tables.parameters,
    'messages': page_tables.messages,
    'mapping': page_tables.mapping,
    'effects': page_effects.index,
    'measured': page_claims.measured,
    'results': page_claims.results,
    'acts': page_claims.acts,
    'naming': page_claims.naming,
    'installed': page_claims.installed,
    'diagnostics': page_health.diagnostics,
    'reasons': page_health.reasons,
}


def pages() -> list[Path]:
    """Return every page that may hold generated parts."""
    return [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').rglob('*.md'))]


def made(page: Path, text: str) -> str:
    """Return the text of a page with its generated parts made anew."""

    def part(found: re.Match[str]) -> str:
        head, name, _, end = found.groups()
        if name.startswith('effect '):
            body = page_effects.part(page.stem, name.removeprefix('effect '))
        else:
            body = PARTS[name]()
        return f'{head}{body.rstrip()}\n{end}'

    return _PART.sub(part, text)


def stale() -> list[Path]:
    """Return the pages whose generated parts differ from what the code says."""
    return [p for p in pages() if p.exists() and made(p, p.read_text()) != p.read_text()]


def main(arguments: list[str]) -> int:
    """Write or check."""
    old = stale()
    if '--check' in arguments:
        for page in old:
            print(f'{page.relative_to(ROOT)} is out of date; run python -m docs.make_pages')
        return 1 if old else 0
    for page in old:
        page.write_text(made(page, page.read_text()))
        print(f'wrote {page.relative_to(ROOT)}')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
