# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is installed is what was chosen, and nothing that is read is ever run."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
HOUSE = ROOT / 'valveflow_ros'
LOCK = (ROOT / 'requirements.lock').read_text(encoding='utf-8')
HASH = re.compile(r'--hash=sha256:[0-9a-f]{64}')
PINNED = re.compile(r'[A-Za-z0-9][A-Za-z0-9._-]*(\[[A-Za-z0-9,._-]+\])?==[^\s;=]+(\s*;.*)?')

# Called by these names, after every import and alias is followed.
FORBIDDEN = {
    'eval', 'exec', 'compile', 'builtins.eval', 'builtins.exec', 'builtins.compile',
    'pickle.load', 'pickle.loads', 'pickle.Unpickler', '_pickle.loads', '_pickle.load',
    'marshal.load', 'marshal.loads', 'shelve.open', 'dill.load', 'dill.loads',
    'cloudpickle.load', 'cloudpickle.loads', 'joblib.load', 'pandas.read_pickle',
    'yaml.load_all', 'yaml.full_load', 'yaml.full_load_all', 'yaml.unsafe_load',
    'yaml.unsafe_load_all', 'yaml.Loader', 'yaml.FullLoader', 'yaml.UnsafeLoader',
    'os.system', 'os.popen', 'subprocess.getoutput', 'subprocess.getstatusoutput',
    'code.interact', 'runpy.run_path', 'runpy.run_module', 'tempfile.mktemp',
}  # fmt: skip


def test_every_package_is_pinned_with_hashes_and_the_lock_leads_nowhere_else() -> None:
    """No second index, no file, no repository, no package that is built from a folder."""
    lines = LOCK.replace('\\\n', ' ').splitlines()
    found = [line for line in lines if line.strip() and not line.lstrip().startswith('#')]
    assert len(found) > 30
    for entry in found:
        requirement, *hashes = re.split(r'\s+(?=--hash)', entry.strip())
        assert PINNED.fullmatch(requirement.strip()), requirement
        assert hashes, f'{requirement} has no hash'
        assert all(HASH.fullmatch(one.strip()) for one in hashes), entry
        assert not re.search(r'://|git\+|@\s|^-|--(extra-)?index|--find-links|--trusted', entry)


def test_the_set_up_installs_only_what_has_the_right_hash() -> None:
    tree = ast.parse((ROOT / 'tools' / 'wheels.py').read_text(encoding='utf-8'))
    lists = [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.List)]
    installs = [words for words in lists if '--no-deps' in words]
    # pip for the installer itself, uv for everything, and pip again where uv does not get through.
    assert len(installs) == 2
    assert all('--require-hashes' in words and '--only-binary' in words for words in installs)
    unchecked = r'pip3? install(?!.*(wheel|break|--require-hashes))|curl |wget '
    for path in [*ROOT.glob('tools/*'), ROOT / 'Makefile', ROOT / 'env.sh']:
        if path.is_file():
            for line in path.read_text(encoding='utf-8').splitlines():
                assert not re.search(unchecked, line), path


def test_the_openssl_that_comes_along_is_named_to_the_reader() -> None:
    found = set()
    for path in Path(sys.prefix, 'lib').glob('python3.*/site-packages/ros_*.libs/libcrypto*'):
        found |= {
            m.decode() for m in re.findall(rb'OpenSSL (\d+\.\d+\.\d+[a-z]?) ', path.read_bytes())
        }
    if not found:
        pytest.skip('this environment has no ROS wheels with OpenSSL in them')
    text = (ROOT / 'SECURITY.md').read_text(encoding='utf-8')
    assert found == set(re.findall(r'OpenSSL (\d+\.\d+\.\d+[a-z]?)', text))


def test_each_promise_names_a_test_that_is_there() -> None:
    named = re.findall(r'`(test/\S+?\.py)`', (ROOT / 'SECURITY.md').read_text(encoding='utf-8'))
    assert len(named) >= 5
    assert [name for name in named if not (ROOT / name).is_file()] == []


def names_of(tree: ast.AST) -> dict[str, str]:
    """What each imported name stands for."""
    known = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                name = alias.asname or alias.name.partition('.')[0]
                known[name] = alias.name if alias.asname else name
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                known[alias.asname or alias.name] = f'{node.module}.{alias.name}'
    return known


def dotted(node: ast.AST) -> str:
    """A chain of attributes as text, empty if it is something else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        base = dotted(node.value)
        return f'{base}.{node.attr}' if base else ''
    return ''


def meant(node: ast.AST, known: dict[str, str]) -> str:
    """What a name or a chain of attributes stands for, by its full name."""
    first, _, rest = dotted(node).partition('.')
    return '.'.join(part for part in (known.get(first, first), rest) if part)


def runs_what_it_reads(text: str, name: str = '?') -> list[tuple[int, str]]:
    """Each place where text or bytes could become code."""
    tree = ast.parse(text, name)
    known = names_of(tree)
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Name | ast.Attribute) and meant(node, known) in FORBIDDEN:
            found.append((node.lineno, meant(node, known)))
        if isinstance(node, ast.Call):
            found += [(node.lineno, what) for what in dangerous_arguments(node, known)]
    return sorted(set(found))


def dangerous_arguments(call: ast.Call, known: dict[str, str]) -> Iterator[str]:
    """What is harmless alone and not with this argument."""
    full = meant(call.func, known)
    for word in call.keywords:
        truth = isinstance(word.value, ast.Constant) and word.value.value is False
        if word.arg == 'shell' and not truth:
            yield f'{full}(shell)'
        if word.arg == 'allow_pickle' and not truth:
            yield f'{full}(allow_pickle)'
    if full == 'yaml.load':
        loaders = {meant(word.value, known) for word in call.keywords if word.arg == 'Loader'}
        loaders |= {meant(one, known) for one in call.args[1:]}
        if not loaders or not loaders <= {'yaml.SafeLoader', 'yaml.CSafeLoader'}:
            yield full
    loads = full in ('numpy.load', 'np.load')
    if loads and not any(word.arg == 'allow_pickle' for word in call.keywords):
        # Its default is False, and is to be seen to be.
        yield f'{full} without allow_pickle=False'
    if full in ('getattr', 'importlib.import_module') and len(call.args) > 1:
        what = call.args[1]
        if isinstance(what, ast.Constant) and what.value in ('eval', 'exec', 'loads', 'system'):
            yield f'getattr {what.value}'


def test_nothing_read_is_run() -> None:
    sources = sorted(HOUSE.rglob('*.py'))
    assert len(sources) > 100
    for path in sources:
        assert runs_what_it_reads(path.read_text(encoding='utf-8'), str(path)) == []


@pytest.mark.parametrize(
    ('text', 'caught'),
    [
        ('eval("1")', 'eval'),
        ('f = eval\nf("1")', 'eval'),
        ('import builtins as b\nb.exec("1")', 'builtins.exec'),
        ('import pickle\npickle.loads(b"")', 'pickle.loads'),
        ('from pickle import loads as json\njson(b"")', 'pickle.loads'),
        ('import pickle as p\nx = p.Unpickler', 'pickle.Unpickler'),
        ('import yaml\nyaml.load("", yaml.Loader)', 'yaml.load'),
        ('import yaml\nyaml.load("", Loader=make())', 'yaml.load'),
        ('from yaml import load\nload("")', 'yaml.load'),
        ('from yaml import full_load\nfull_load("")', 'yaml.full_load'),
        ('import os\nos.system("id")', 'os.system'),
        ('import subprocess as s\ns.run("id", shell=True)', 'subprocess.run(shell)'),
        ('import numpy as np\nnp.load("x", allow_pickle=True)', 'numpy.load(allow_pickle)'),
        ('import numpy as np\nnp.load("x")', 'numpy.load without allow_pickle=False'),
        ('def f():\n    import marshal\n    return marshal.loads', 'marshal.loads'),
        ('import builtins\ngetattr(builtins, "exec")("1")', 'getattr exec'),
    ],
)
def test_the_reader_of_sources_catches(text: str, caught: str) -> None:
    assert caught in [what for _, what in runs_what_it_reads(text)]


def test_the_reader_of_sources_lets_pass() -> None:
    for text in (
        'import re\nre.compile("a")',
        'import yaml\nyaml.safe_load("")',
        'import yaml\nfrom yaml import CSafeLoader as S\nyaml.load("", Loader=S)',
        'import json\njson.loads("1")',
        'import subprocess\nsubprocess.run(["id"], shell=False)',
        'import numpy as np\nnp.load("x", allow_pickle=False)',
        'import ast\nast.literal_eval("1")',
        'executor.executed()',
    ):
        assert runs_what_it_reads(text) == []
