# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Nobody outside this host is listened to, nobody else may read, and no demand is overheard."""

import json
import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from rclpy.context import Context
from rclpy.parameter import Parameter as RosParameter
from ros_helpers import LOOPBACK, PATIENCE_S, rtps_ports

from valveflow_ros.errors import ParameterError, RecordingError
from valveflow_ros.interface.parameter_files import given_reference
from valveflow_ros.logs import Recorder, RecorderSettings
from valveflow_ros.parameters import TABLE, Settings
from valveflow_ros.ros import domain, monitor_main, replay_main, simulator_main
from valveflow_ros.ros.domain import InsecureError, check_security
from valveflow_ros.ros.node.monitor_node import MonitorNode
from valveflow_ros.ros.node.recording import Recording, new_folder

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
PROFILE = ROOT / 'config' / 'fastdds_loopback.xml'
PROFILES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
AT_NS = 1_700_000_000 * 10**9


# Makes a node and prints its sockets.
NODE = """
import json, sys
import psutil, rclpy
from ros_helpers import bound
rclpy.init()
node = rclpy.create_node('sockets')
json.dump(bound(psutil.Process()), sys.stdout)
rclpy.shutdown()
"""


@pytest.mark.parametrize('discovery_range', ['', 'SYSTEM_DEFAULT', 'LOCALHOST'])
def test_with_the_profile_a_node_listens_to_this_host_alone(ros_environment, discovery_range):
    environment = {**ros_environment, 'PYTHONPATH': f'{os.environ["PYTHONPATH"]}:{HERE}'}
    if discovery_range:
        environment |= dict.fromkeys(PROFILES, str(PROFILE))
        environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = discovery_range
    done = subprocess.run(
        [sys.executable, '-c', NODE],
        env=environment, capture_output=True, text=True, check=True, timeout=PATIENCE_S,
    )  # fmt: skip
    found = json.loads(done.stdout)
    ports = rtps_ports(int(ros_environment['ROS_DOMAIN_ID']))
    listening = {address for address, port in found if port in ports}
    assert listening == {LOOPBACK} if discovery_range else '0.0.0.0' in listening
    if discovery_range == 'SYSTEM_DEFAULT':
        # LOCALHOST adds transports of its own: two sockets that only send, and shared memory.
        assert {address for address, _ in found} == {LOOPBACK}


KEYS = 'KEYS'
ENABLE, STRATEGY, KEYSTORE = (f'ROS_SECURITY_{x}' for x in ('ENABLE', 'STRATEGY', 'KEYSTORE'))
ENFORCED = {ENABLE: 'true', STRATEGY: 'Enforce'}
WITH_KEYS = {**ENFORCED, KEYSTORE: KEYS}
DEMANDS = [
    ({ENABLE: 'true'}, 'ROS_SECURITY_STRATEGY is not set'),
    ({ENABLE: 'true', STRATEGY: 'Permissive'}, "ROS_SECURITY_STRATEGY is 'Permissive'"),
    ({ENABLE: 'True', STRATEGY: 'Enforce'}, "not 'True'"),
    ({ENABLE: '1', STRATEGY: 'Enforce'}, "not '1'"),
    (ENFORCED, 'ROS_SECURITY_KEYSTORE'),
    # What a middleware that has it says of an empty keystore is its own.
    (WITH_KEYS, ''),
]
MAINS = [
    ('monitor', monitor_main.main, []),
    ('plant_simulator', simulator_main.main, []),
    ('replay', replay_main.main, ['nothing.csv', '--wait', '0']),
]
# Each demand of the monitor, and the last one of everybody.
REFUSED = [(MAINS[0], demand) for demand in DEMANDS] + [(main, DEMANDS[-1]) for main in MAINS[1:]]


@pytest.fixture
def demanded(monkeypatch, tmp_path, ros_environment):
    del ros_environment

    def demand(environment):
        (tmp_path / 'keys' / 'enclaves').mkdir(parents=True, exist_ok=True)
        for name in ('ENABLE', 'STRATEGY', 'KEYSTORE', 'ENCLAVE_OVERRIDE'):
            monkeypatch.delenv(f'ROS_SECURITY_{name}', raising=False)
        for name, value in environment.items():
            monkeypatch.setenv(name, value.replace(KEYS, str(tmp_path / 'keys')))

    return demand


def test_no_start_where_security_is_demanded_and_cannot_be_had(demanded, capfd):
    for (name, run, arguments), (environment, words) in REFUSED:
        demanded(environment)
        assert run(arguments) == 1
        said = capfd.readouterr().err
        start = f'valveflow {name}: Not started, because security is demanded '
        (line,) = [line for line in said.splitlines() if line.startswith('valveflow')]
        assert line.startswith(f'{start}(ROS_SECURITY_ENABLE): ')
        assert words in line
        assert line.endswith('.')
        assert 'Traceback' not in said


def test_a_middleware_without_security_is_called_by_its_name(demanded):
    demanded(WITH_KEYS)
    with pytest.raises(InsecureError) as refusal:
        check_security([])
    library = b''.join(
        path.read_bytes() for path in Path(sys.prefix, 'lib').glob('librmw_fastrtps_shared*.so')
    )
    if b"doesn't have the security libraries" in library:
        assert 'built without DDS security' in str(refusal.value)
    else:
        assert 'no node can be made with it' in str(refusal.value)


@pytest.fixture
def contexts(monkeypatch):
    """The contexts in which nodes are tried."""
    made = []

    def make():
        made.append(Context())
        return made[-1]

    monkeypatch.setattr(domain, 'Context', make)
    return made


def test_who_demands_nothing_is_let_through(demanded, contexts):
    for value in ('', 'False', '0', 'no', 'off'):
        demanded({ENABLE: value, STRATEGY: 'Permissive'})
        check_security([])
    check_security([], {})
    assert not contexts, 'no node has to be tried'


def test_a_node_that_can_be_made_is_let_through_and_leaves_nothing_behind(
    demanded, contexts, tmp_path
):
    demanded({})
    wish = {**ENFORCED, KEYSTORE: str(tmp_path / 'keys')}
    # The stack itself sees no wish, so that its node stands for one that got what it wished for.
    check_security(['--ros-args', '--enclave', '/a'], wish)
    check_security(None, wish)
    assert [context.ok() for context in contexts] == [False, False]


def test_an_unknown_middleware_is_not_trusted_to_refuse(demanded, monkeypatch):
    demanded(WITH_KEYS)
    monkeypatch.setattr(domain, 'get_rmw_implementation_identifier', lambda: 'rmw_new_cpp')
    with pytest.raises(InsecureError, match='of rmw_new_cpp it is not known'):
        check_security([])


# Paths


def test_a_file_that_is_none_is_refused_in_a_sentence_at_once(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'round').symlink_to(tmp_path / 'round')
    (tmp_path / 'endless').symlink_to('/dev/zero')
    (tmp_path / 'bytes').write_bytes(b'\xff\xfe\x00')
    (tmp_path / 'empty').touch()
    (tmp_path / 'deep').write_text('[' * 100_000)
    with (tmp_path / 'large').open('wb') as file:
        file.truncate(1 << 34)
    given = [
        '/dev/zero', '/dev/stdin', '/', f'{tmp_path}/pipe', f'{tmp_path}/round',
        f'{tmp_path}/endless', f'{tmp_path}/bytes', f'{tmp_path}/empty', f'{tmp_path}/deep',
        f'{tmp_path}/large', f'{tmp_path}/none', f'{tmp_path}/empty/below', 'x' * 300,
        '../' * 100 + 'etc/passwd', '~nobody-of-that-name/file',
    ]  # fmt: skip
    for path in given:
        with pytest.raises(ParameterError) as error:
            within(20.0, lambda: given_reference(Settings({'reference_file': path})))  # noqa: B023
        sentence = str(error.value)
        assert sentence.startswith("Parameter 'reference_file' names '"), path
        assert sentence.endswith('.')
        assert '\n' not in sentence


def within(limit_s, work):
    """Do work that must not wait for anybody; raises what it raises."""
    with ThreadPoolExecutor(1) as pool:
        pool.submit(work).result(limit_s)


def test_a_path_is_one_printable_line(context):
    names = [row.name for row in TABLE if row.name.endswith(('_directory', '_file', '_tag'))]
    for text in ('a\0b', 'a\nb', 'a\x1b[2Jb', 'x' * 501, 'a\u202eb'):
        for name in names:
            with pytest.raises(ParameterError, match='must be one line of at most 500 printable'):
                Settings({name: text})
        overrides = [RosParameter(names[0], value=text)]
        with pytest.raises(ParameterError) as error:
            MonitorNode(context=context, parameter_overrides=overrides)
        assert str(error.value).isprintable()


def test_a_folder_that_cannot_be_made_is_a_sentence_and_the_run_goes_on(tmp_path):
    (tmp_path / 'file').touch()
    (tmp_path / 'round').symlink_to(tmp_path / 'round')
    for given in (
        f'{tmp_path}/file', f'{tmp_path}/file/below', '/proc/nowhere', '/dev/null',
        f'{tmp_path}/' + 'x' * 300, f'{tmp_path}/round',
    ):  # fmt: skip
        settings = Settings({'record_directory': given})
        with pytest.raises(RecordingError) as error:
            new_folder(settings, 1.7e9)
        recording = Recording(settings, {}, 1.7e9)
        assert not recording.on
        assert recording.problem == str(error.value)
        assert recording.problem.startswith(given)
        assert recording.problem.endswith('.')
        recording.write('/a', b'', AT_NS, AT_NS)
        assert recording.close() is None


def test_a_tag_does_not_lead_out_of_the_folder(tmp_path):
    home = tmp_path / 'home'
    tags = ('../../x', '/etc', '..', '.', '~', 'a/b', 'x' * 500, '$(id)', '*', 'ä/ö', '-rf')
    for tag in tags:
        made = new_folder(Settings({'record_directory': str(home), 'unit_tag': tag}), 1.7e9)
        assert made.parent == home
        assert made.resolve() == made
        assert stat.S_IMODE(made.stat().st_mode) == 0o700
    assert list(tmp_path.iterdir()) == [home]
    assert len(list(home.iterdir())) == len(tags)


def test_a_planted_link_is_not_followed(tmp_path):
    home, elsewhere = tmp_path / 'home', tmp_path / 'elsewhere'
    settings = Settings({'record_directory': str(home)})
    expected = new_folder(settings, 1.7e9)
    expected.rmdir()
    elsewhere.mkdir()
    expected.symlink_to(elsewhere)
    made = new_folder(settings, 1.7e9)
    assert made == expected.with_name(expected.name + '_2')
    # The same for the file and for what is put beside it.
    (elsewhere / 'victim').write_text('untouched')
    for name in (f'{made.name}_0.mcap.part', f'{made.name}_0.mcap', 'metadata.yaml'):
        (made / name).symlink_to(elsewhere / 'victim')
    recorder = Recorder(made, RecorderSettings(free_floor_bytes=0, retry_s=0.01))
    recorder.add_topic('/a', 'std_msgs/msg/Float64')
    recorder.record('/a', bytes(12), AT_NS, AT_NS)
    recorder.close(10.0)
    assert [path.read_text() for path in elsewhere.iterdir()] == ['untouched']
