# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Add the copyright line and the licence to each source file that lacks them.

    python tools/headers.py

A second run changes nothing. Messages get no header, because their first comment is their
documentation. The parts of pages get none, because they become parts of reports.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from tree import ROOT

FOLDERS = ('benchmarks', 'docs', 'launch', 'test', 'tools', 'valveflow_ros')
SUFFIXES = ('.cmake', '.py', '.sh')
HEADER = '# Copyright 2026 valveflow maintainers\n# SPDX-License-Identifier: Apache-2.0\n'


def sources() -> Iterator[Path]:
    """Yield every source file of the tree."""
    yield from (ROOT / 'env.sh', ROOT / 'setup.py', ROOT / 'msg' / 'CMakeLists.txt')
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob('*')):
            if path.suffix in SUFFIXES and path.is_file() and path.stat().st_size:
                yield path


def parts(path: Path) -> tuple[str, str]:
    """Return the interpreter line, if there is one, and the rest of a file."""
    text = path.read_text(encoding='utf-8')
    first, _, rest = text.partition('\n')
    return (f'{first}\n', rest) if first.startswith('#!') else ('', text)


def lacking() -> list[Path]:
    """Return the files without the header."""
    return [path for path in sources() if not parts(path)[1].startswith(HEADER)]


def main() -> int:
    """Add missing headers and print the number of files; return the exit status."""
    missing = lacking()
    for path in missing:
        first, rest = parts(path)
        # A comment at the beginning of a file stays separate from the header.
        gap = '\n' if rest.startswith('#') else ''
        path.write_text(f'{first}{HEADER}{gap}{rest}', encoding='utf-8')
    print(f'{len(missing)} files changed')
    return 0


if __name__ == '__main__':
    sys.exit(main())
