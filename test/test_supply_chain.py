# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is installed is what was chosen, and nothing that is read is ever run."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
HOUSE = ROOT / 'valveflow_ros'
LOCK = (ROOT / 'requirements.lock').read_text(encoding='utf-8')
HASH = re.compile(r'--hash=sha256:[0-9a-f]{64}')
PINNED = re.compile(r'[A-Za-z0-9][A-Za-z0-9._-]*(\[[A-Za-z0-9,._-]+\])?==[^\s;=]+(\s*;.*)?')

# Modules that nobody imports, built-in functions that nobody names, and what nobody takes from
# any other module, whatever that one is called where it is imported.
MODULES = {
    'builtins', 'cloudpickle', 'code', 'dill', 'joblib', 'marshal', 'pickle', '_pickle', 'runpy',
    'shelve',
}  # fmt: skip
BUILTINS = {'eval', 'exec', 'compile', '__import__', '__builtins__'}
PARTS = {
    'read_pickle', 'load_all', 'full_load', 'full_load_all', 'unsafe_load', 'unsafe_load_all',
    'Loader', 'FullLoader', 'UnsafeLoader', 'system', 'popen', 'getoutput', 'getstatusoutput',
    'mktemp',
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


def runs_what_it_reads(text: str) -> list[str]:
    """Each name in a source by which text or bytes could become code."""
    found: list[str] = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names]
            modules = names if isinstance(node, ast.Import) else [node.module or '']
            found += [name for name in modules if name.partition('.')[0] in MODULES]
            found += PARTS.intersection(names)
            # So that its `load` is known below.
            renamed = isinstance(node, ast.Import) and any(a.asname for a in node.names)
            if 'yaml' in modules and (renamed or 'load' in names):
                found.append('yaml.load by another name')
        elif isinstance(node, ast.Name):
            found += BUILTINS.intersection([node.id])
        elif isinstance(node, ast.Attribute):
            found += PARTS.intersection([node.attr])
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            # As handed to getattr or import_module.
            found += {'eval', 'exec', 'builtins', 'pickle', 'marshal'}.intersection([node.value])
        elif isinstance(node, ast.Call):
            given = {word.arg: ast.unparse(word.value) for word in node.keywords}
            found += [k for k in ('shell', 'allow_pickle') if given.get(k, 'False') != 'False']
            called = ast.unparse(node.func) if getattr(node.func, 'attr', '') == 'load' else ''
            # The default of NumPy is False, and is to be seen to be.
            if called in ('np.load', 'numpy.load') and 'allow_pickle' not in given:
                found.append(called)
            if called == 'yaml.load' and 'SafeLoader' not in given.get('Loader', ''):
                found.append(called)
    return found


def test_nothing_read_is_run() -> None:
    sources = sorted(HOUSE.rglob('*.py'))
    assert len(sources) > 100
    for path in sources:
        assert runs_what_it_reads(path.read_text(encoding='utf-8')) == [], path


def test_the_reader_of_sources_catches_what_it_should_and_lets_the_rest_pass() -> None:
    for text in (
        'f = eval\nf("1")', 'import builtins as b', 'from pickle import loads as json',
        'import yaml\nyaml.load("", yaml.Loader)', 'import yaml as y\ny.full_load("")',
        'from yaml import load', 'import yaml as y', 'import yaml\nyaml.load("", Loader=make())',
        'import os\nos.system("id")', 'import subprocess as s\ns.run("id", shell=True)',
        'import numpy as np\nnp.load("x", allow_pickle=True)', 'import numpy as np\nnp.load("x")',
        'getattr(thing, "exec")("1")',
    ):  # fmt: skip
        assert runs_what_it_reads(text), text
    for text in (
        'import re\nre.compile("a")', 'import yaml\nyaml.safe_load("")', 'executor.executed()',
        'import yaml\nyaml.load("", Loader=yaml.CSafeLoader)', 'import ast\nast.literal_eval("1")',
        'import subprocess\nsubprocess.run(["id"], shell=False)',
        'import numpy as np\nnp.load("x", allow_pickle=False)',
    ):  # fmt: skip
        assert runs_what_it_reads(text) == [], text
