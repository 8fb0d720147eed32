# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test the nodes with the real ros2 command line, and record the checks and results.

    python tools/jazzy.py [--write]

It needs ros2cli and launch_ros of a ROS 2 installation; without them it prints this and returns
0. Every check is a sentence, the command of a user, and the required output. ``--write`` writes
the table into docs/jazzy.md.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import yaml

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'jazzy.md'
_BEGIN, _END = '<!-- tried -->\n', '<!-- end of tried -->\n'
_NODE = '/valveflow_monitor'
# Time limits on a busy machine of a command, and of the start of a node.
_PATIENCE_S, _START_S, _SETTLE_S = 120.0, 180.0, 20.0


class NotSeenError(Exception):
    """A check did not find the required output."""


class Bench:
    """The running nodes, their folder, and the checks made so far.

    Attributes
    ----------
    rows : list of tuple of str
        Check, command and result; the result begins with 'FAILED' if it is not as required.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: list[tuple[str, str, str]] = []

    def ros2(self, *words: str, patience_s: float = _PATIENCE_S) -> str:
        """Return the output of a ros2 command, stdout and stderr."""
        command = [shutil.which('ros2') or 'ros2', *words]
        done = subprocess.run(
            command, cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            timeout=patience_s, check=False,
        )  # fmt: skip
        return done.stdout

    def check(self, sentence: str, command: str, found: Callable[[], str]) -> None:
        """Make a check; ``found`` returns the result, or raises `NotSeenError`."""
        try:
            seen = found()
        except (NotSeenError, subprocess.TimeoutExpired) as error:
            seen = f'FAILED: {error}'
        print(f'{sentence}: {seen}', flush=True)
        self.rows.append((sentence, command, seen))

    def says(self, sentence: str, pattern: str, words: str) -> None:
        """Check that the output of a ros2 command matches a pattern."""

        def found() -> str:
            end_s, match = time.monotonic() + _SETTLE_S, None
            while match is None:
                # The daemon may not yet know which nodes started and ended.
                said = self.ros2(*words.split())
                match = re.search(pattern, said, re.S)
                if match is None and time.monotonic() > end_s:
                    raise NotSeenError(said.strip()[-300:])
            return ' '.join(match.group(match.lastindex or 0).split())[:120]

        self.check(sentence, f'ros2 {words}', found)

    @contextlib.contextmanager
    def running(self, ready: str, *words: str) -> Iterator[subprocess.Popen[str]]:
        """Run a ros2 command until its output matches ``ready``; end it afterwards."""
        log = self.folder / f'{len(list(self.folder.glob("*.log")))}.log'
        with log.open('w') as out:
            process = subprocess.Popen(
                [shutil.which('ros2') or 'ros2', *words], cwd=self.folder, stdout=out,
                stderr=subprocess.STDOUT, text=True, start_new_session=True,
            )  # fmt: skip
        try:
            _until(lambda: re.search(ready, log.read_text()), f'{ready!r} in {log}')
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGINT)
            process.wait(_PATIENCE_S)

    @property
    def log(self) -> str:
        """Return the output of the last command started."""
        newest = max(self.folder.glob('*.log'), key=lambda path: int(path.stem))
        return newest.read_text()


def _until(condition: Callable[[], object], what: str, patience_s: float = _START_S) -> None:
    end_s = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end_s:
            raise NotSeenError(f'{what} did not come within {patience_s:g} s')
        time.sleep(0.2)


def _monitor(bench: Bench, *more: str) -> contextlib.AbstractContextManager[object]:
    given = ('--ros-args', '-p', f'record_directory:={bench.folder}', *more)
    return bench.running('listening to', 'run', 'valveflow_ros', 'monitor', *given)


def parameters(bench: Bench) -> None:
    """Dump, load and set parameters, running and unconfigured."""
    with _monitor(bench):
        dump = bench.folder / 'dump.yaml'
        dump.write_text(bench.ros2('param', 'dump', _NODE))

        def loads(name: str, file: Path) -> None:
            def found() -> str:
                said = bench.ros2('param', 'load', _NODE, str(file)).splitlines()
                bad = [line for line in said if not line.endswith(' successful')]
                if bad or len(said) < 50:
                    raise NotSeenError('; '.join(bad[:3]) or 'nothing was loaded')
                return f'{len(said)} parameters, each "successful"'

            bench.check(name, f'ros2 param load {_NODE} {file.name}', found)

        loads('What was dumped loads into the running node', dump)
        config = bench.folder / 'monitor.yaml'
        text = (PAGE.parents[1] / 'config' / 'monitor.yaml').read_text()
        own = {'record_directory': str(bench.folder)}
        values = yaml.safe_load(text)['/**']['ros__parameters'] | own
        config.write_text(yaml.safe_dump({_NODE: {'ros__parameters': values}}))
        loads('config/monitor.yaml loads into the running node', config)
        passed = 'Transitioning successful'
        for sentence, pattern, words in (
            ('3.0 for a whole number is taken', 'successful',
             f'param set {_NODE} alarm_flood 3.0'),
            ('and stays one', 'Integer value is: 3', f'param get {_NODE} alarm_flood'),
            ('A value out of range is refused with its range', 'must be from [^\n]*',
             f'param set {_NODE} alarm_dead_band 5.0'),
            ('What only the start may set is refused with what to do', 'cannot be changed[^\n]*',
             f'param set {_NODE} unit_tag U7'),
            ('lifecycle deactivate', passed, f'lifecycle set {_NODE} deactivate'),
            ('then it is inactive', 'inactive', f'lifecycle get {_NODE}'),
            ('lifecycle cleanup', passed, f'lifecycle set {_NODE} cleanup'),
            ('then it is unconfigured', 'unconfigured', f'lifecycle get {_NODE}'),
            ('Unconfigured it may be set', 'successful', f'param set {_NODE} unit_tag U7'),
            ('The unit percent, as YAML takes no bare %', 'successful',
             f'param set {_NODE} valve_opening_unit percent'),
            ('activate is no way from there', '(Unknown transition)',
             f'lifecycle set {_NODE} activate'),
            ('lifecycle configure', passed, f'lifecycle set {_NODE} configure'),
            ('lifecycle activate', passed, f'lifecycle set {_NODE} activate'),
            ('It has the new tag', 'frame_id: U7', 'topic echo --once /diagnostics'),
        ):  # fmt: skip
            bench.says(sentence, pattern, words)


def topics(bench: Bench) -> None:
    """Check topics: latched messages, quality of service, health, samples without a quality."""
    override = f'qos_overrides.{_NODE}/prediction.publisher.reliability:=best_effort'
    with _monitor(bench, '-p', override):
        late = '--once --qos-durability transient_local --qos-reliability reliable'
        for sentence, pattern, words in (
            ('A late subscriber sees that no alarm ever came',
             'state: 0.*Not raised since the monitor started',
             f'topic echo {late} {_NODE}/alarms'),
            ('The first curve message has a time', r'sec: (1[0-9]{9})',
             f'topic echo {late} {_NODE}/characteristic'),
            ('The quality of service is as overridden', '(Reliability: BEST_EFFORT)',
             f'topic info -v {_NODE}/prediction'),
            ('Its type hash is that of the definition', 'Topic type hash: (RIHS01_[0-9a-f]{16})',
             f'topic info -v {_NODE}/characteristic'),
            ('Health items are called NODE: ITEM',
             'name: .?valveflow_monitor: input valve_opening', 'topic echo --once /diagnostics'),
            ('A service answers with a sentence', "message='([^']*)'",
             f'service call {_NODE}/refit std_srvs/srv/Trigger'),
            ('Types of the services', 'valveflow_msgs/srv/OperateAlarm',
             f'service type {_NODE}/operate_alarm'),
        ):  # fmt: skip
            bench.says(sentence, pattern, words)
        sample = '{header: {stamp: now}, valve_opening: 50.0, main_steam_pressure: 13.0}'
        kind = 'valveflow_msgs/msg/PlantSample'
        with bench.running(
            'publishing #3', 'topic', 'pub', '-r', '5', '/plant_sample', kind, sample
        ):
            bench.says(
                'A sample without qualities is not used, and it is said why',
                'does not set (valve_opening_quality)',
                'topic echo --once /diagnostics --full-length',
            )


def launching(bench: Bench) -> None:
    """Check launch: arguments, two units, a killed and an ended monitor, the demo."""
    bench.says(
        'Every argument is explained',
        "'unit_tag':[^']*",
        'launch valveflow_ros monitor.launch.py --show-args',
    )

    def launch(*words: str) -> contextlib.AbstractContextManager[object]:
        more = f'record_directory:={bench.folder}'
        return bench.running('listening to', 'launch', *words, more)

    both = bench.folder / 'both.launch.yaml'
    both.write_text(yaml.safe_dump({'launch': [_unit(1, '1E5'), _unit(2, 'U2')]}))
    with launch(str(both)):
        _until(lambda: bench.log.count('listening to') == 2, 'the second unit')
        bench.says(
            'Two units by namespace in one launch file',
            r'(/unit_1/valveflow_monitor\s+/unit_2/valveflow_monitor)',
            'node list',
        )

        def itself() -> str:
            os.kill(_pid(bench), signal.SIGKILL)
            _until(lambda: bench.log.count('listening to') == 3, 'the monitor')
            said = bench.ros2('param', 'get', '/unit_1/valveflow_monitor', 'unit_tag')
            if 'String value is: 1E5' not in said:
                raise NotSeenError(said)
            return f'of /unit_1: {said.strip()}'

        bench.check(
            'The first, killed, comes again as itself, and a tag like a number stays a text',
            'use_respawn, kill -9, ros2 param get', itself,
        )  # fmt: skip
    managed = bench.folder / 'managed.launch.yaml'
    units = [_unit(k, f'U{k}', autostart='false', use_respawn='false') for k in (1, 2)]
    managed.write_text(yaml.safe_dump({'launch': units}))
    more = f'record_directory:={bench.folder}'
    with bench.running('is not configured', 'launch', str(managed), more):
        _until(lambda: bench.log.count('is not configured') == 2, 'both units')
        bench.check(
            "Two units up and down in the order of Nav2's lifecycle manager, without bonds",
            'autostart:=false, ros2 service call NODE/change_state, NODE/get_state',
            lambda: _managed(bench),
        )
    with launch('valveflow_ros', 'monitor.launch.py', 'use_respawn:=true'):

        def respawned() -> str:
            os.kill(_pid(bench), signal.SIGKILL)
            _until(lambda: bench.log.count('listening to') == 2, 'the monitor')
            return 'a killed monitor listens again'

        bench.check('A killed monitor is started again', 'use_respawn:=true, kill -9', respawned)

        def down() -> str:
            bench.ros2('lifecycle', 'set', _NODE, 'shutdown')
            _until(lambda: 'finished cleanly' in bench.log, 'the end')
            time.sleep(5.0)
            if bench.log.count('process started') != 2:
                raise NotSeenError('it was started again')
            return 'not started again'

        command = f'ros2 lifecycle set {_NODE} shutdown'
        bench.check('One that its lifecycle shut down stays down', command, down)

    def refused() -> str:
        said = bench.ros2('launch', 'valveflow_ros', 'demo.launch.py', 'days:=abc')
        if "days must be a number, not 'abc'" not in said or 'process started' in said:
            raise NotSeenError(said[-300:])
        return "days must be a number, not 'abc'; no process was started"

    line = 'ros2 launch valveflow_ros demo.launch.py days:=abc'
    bench.check('An argument that is no number is refused', line, refused)
    for words in (('effects:=none', 'days:=0.02'), ('days:=0.02',)):

        def plays(words: tuple[str, ...] = words) -> str:
            said = bench.ros2(
                'launch', 'valveflow_ros', 'demo.launch.py', *words,
                f'record_directory:={bench.folder}/demo', patience_s=_START_S,
            )  # fmt: skip
            if said.count('finished cleanly') != 2:
                raise NotSeenError(said[-300:])
            return 'plant and monitor finished cleanly'

        line = f'ros2 launch valveflow_ros demo.launch.py {" ".join(words)}'
        bench.check('The demo runs', line, plays)


def units_of_a_host(bench: Bench) -> None:
    """Check launch: a list of units, each with its parameter file."""
    for k in (1, 2):
        given = {'unit_tag': f'U{k}', 'record_directory': f'{bench.folder}/u{k}'}
        text = yaml.safe_dump({'/**': {'ros__parameters': given}})
        (bench.folder / f'u{k}.yaml').write_text(text)
    units = bench.folder / 'units.yaml'
    rows = [{'namespace': f'/u{k}', 'params_file': f'u{k}.yaml'} for k in (1, 2)]
    units.write_text(yaml.safe_dump(rows))
    with bench.running(
        'listening to', 'launch', 'valveflow_ros', 'units.launch.py', f'units:={units}'
    ):
        _until(lambda: bench.log.count('listening to') == 2, 'the second unit')
        bench.says(
            'Two units by a list of units, units.launch.py',
            r'(/u1/valveflow_monitor\s+/u2/valveflow_monitor)',
            'node list',
        )


def _managed(bench: Bench) -> str:
    """Bring two units up and down as nav2_lifecycle_manager's `changeStateForAllNodes` does."""
    forth = [f'/unit_{k}/valveflow_monitor' for k in (1, 2)]
    up = [('configure', 1, 'inactive', forth), ('activate', 3, 'active', forth)]
    down = [
        ('deactivate', 4, 'inactive', forth[::-1]), ('cleanup', 2, 'unconfigured', forth[::-1])
    ]  # fmt: skip
    end = [('shutdown', 5, 'finalized', forth[::-1])]
    done = 0
    for word, number, state, nodes in [*up, down[0], up[1], *down, *up, *down, *end]:
        for node in nodes:
            said = bench.ros2(
                'service', 'call', f'{node}/change_state', 'lifecycle_msgs/srv/ChangeState',
                f'{{transition: {{id: {number}}}}}',
            )  # fmt: skip
            if 'success=True' not in said:
                raise NotSeenError(f'{word} {node}: {said[-200:]}')
            if state != 'finalized':  # the process has ended
                said = bench.ros2(
                    'service', 'call', f'{node}/get_state', 'lifecycle_msgs/srv/GetState'
                )
                if f"label='{state}'" not in said:
                    raise NotSeenError(f'{word} {node}: {said[-200:]}')
            done += 1
    _until(lambda: bench.log.count('finished cleanly') == len(forth), 'the end of both')
    return f'{done} transitions, each confirmed; both ended cleanly'


def _unit(number: int, tag: str, **more: str) -> dict[str, object]:
    """Return the part of a launch file that starts the monitor of a unit."""
    given = {'namespace': f'unit_{number}', 'unit_tag': tag, 'use_respawn': 'true', **more}
    include = {
        'file': '$(find-pkg-share valveflow_ros)/launch/monitor.launch.py',
        'arg': [{'name': name, 'value': value} for name, value in given.items()],
    }
    return {'group': [{'include': include}]}


def _pid(bench: Bench) -> int:
    started = re.findall(r'\[monitor-1\]: process started with pid \[(\d+)\]', bench.log)
    return int(started[-1])


def read(bench: Bench) -> None:
    """Read the recording of the demo with rosbags, and replay it."""
    (folder, *_) = (bench.folder / 'demo').glob('valveflow_*')

    def count_all() -> str:
        from rosbags.highlevel import AnyReader

        with AnyReader([folder]) as reader:
            count = sum(1 for _ in reader.messages())
            told = yaml.safe_load((folder / 'metadata.yaml').read_text())
        info = told['rosbag2_bagfile_information']
        if count != info['message_count']:
            raise NotSeenError(f'{count} messages of {info["message_count"]}')
        return f'metadata version {info["version"]}, {count} messages of {count}'

    bench.check('rosbags reads the recording of the demo', 'rosbags AnyReader', count_all)

    bench.says(
        'Its replay gives every output again, byte for byte',
        '(identical)',
        f'run valveflow_ros replay {folder} --verify',
    )


def table(bench: Bench) -> str:
    """Return the page's table."""

    def clean(text: str) -> str:
        return text.replace(str(bench.folder), 'FOLDER').replace('|', '\\|')

    lines = [
        f'Tried with Python {platform.python_version()}, ros2cli '
        f'{_version("ros2cli")}, launch {_version("launch")}, rclpy {_version("ros-rclpy")}.',
        '', '| check | command | found |', '| --- | --- | --- |',
    ]  # fmt: skip
    lines += [f'| {clean(a)} | `{clean(b)}` | {clean(c)} |' for a, b, c in bench.rows]
    return '\n'.join(lines) + '\n'


def _version(package: str) -> str:
    from importlib import metadata

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return 'of this installation'


def main() -> int:
    """Make all checks; return 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--write', action='store_true', help='put the table into docs/jazzy.md')
    options = parser.parse_args()
    missing = [name for name in ('ros2cli', 'launch_ros') if not importlib.util.find_spec(name)]
    if missing or shutil.which('ros2') is None:
        print(f'Nothing was tried: {", ".join(missing) or "the command ros2"} is not here.')
        return 0
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 90 + 10)
    with tempfile.TemporaryDirectory(prefix='valveflow_jazzy_') as name:
        bench = Bench(Path(name))
        for part in (parameters, topics, launching, units_of_a_host, read):
            try:
                part(bench)
            except NotSeenError as error:
                bench.rows.append((part.__doc__ or '', '', f'FAILED: {error}'))
                print(error)
        subprocess.run(['ros2', 'daemon', 'stop'], capture_output=True, check=False)
        if options.write:
            text = PAGE.read_text()
            before, after = text.index(_BEGIN) + len(_BEGIN), text.index(_END)
            PAGE.write_text(text[:before] + table(bench) + text[after:])
    failed = sum(row[2].startswith('FAILED') for row in bench.rows)
    print(f'{len(bench.rows)} checks, {failed} failed')
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
