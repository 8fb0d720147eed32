# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import math
import shlex
from pathlib import Path

import pytest
import yaml
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from ros_helpers import spin_until, wait_until

from valveflow_ros.errors import ParameterError
from valveflow_ros.interface.settings import unmatched_files
from valveflow_ros.parameters import TABLE, Settings, as_yaml
from valveflow_ros.ros.declare import changed, declare, unknown_overrides
from valveflow_ros.ros.node.diagnostics import Level
from valveflow_ros.ros.node.monitor_node import MonitorNode

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]
LIVE = [row for row in TABLE if row.live]
FIXED = [row for row in TABLE if not row.live]


def ros(name, value):
    return RosParameter(name, value=value)


@pytest.fixture
def node(context):
    made = MonitorNode(context=context)
    yield made
    made.destroy_node()


class Running:
    """A session that a parameter may reach."""

    def reconfigure(self, settings):
        self.settings = settings


@pytest.fixture
def running(node):
    """The node as it is between configure and clean-up, for its parameters."""
    node.session = Running()
    return node


def bad_values(row):
    """Values that do not fit a row, of every kind that ROS can send."""
    values = ['', [1.0, 2.0], [b'\x01'], None]
    if isinstance(row.default, bool):
        return [*values, 1, 0.5, 'true']
    if isinstance(row.default, str):
        return [1, True, 0.5, [row.default], 'a\nb', 'x' * 501]
    assert row.low is not None
    assert row.high is not None
    values += [True, 'abc', math.nan, math.inf, -math.inf]
    values += [row.low - 1.0, row.high + 1.0, row.high * 2.0 + 1.0]
    return values if isinstance(row.default, float) else [*values, row.default + 0.5]


def good_values(row):
    if isinstance(row.default, bool | str) or row.low is None or row.high is None:
        return [not row.default] if isinstance(row.default, bool) else [row.default]
    return [row.low, row.high, float(row.default)]


def means_the_default(row, value):
    try:
        return row.check(value) == row.default
    except ParameterError:
        return False


def test_every_row_is_declared_with_its_default_and_described(node):
    for row in TABLE:
        assert node.get_parameter(row.name).value == row.default
        found = node.describe_parameter(row.name)
        assert row.sentence in found.description
        assert not row.unit or row.unit in found.description
        assert not found.read_only
        assert ('unconfigured' in found.additional_constraints) != row.live
        for choice in row.choices:
            assert choice in found.additional_constraints
        spans = [*found.integer_range, *found.floating_point_range]
        if row.low is None or row.high is None:
            assert not spans
        else:
            assert (spans[0].from_value, spans[0].to_value) == (row.low, row.high)
    assert node.settings == Settings()


def test_live_parameters_take_good_values_and_refuse_bad_ones(running):
    node = running
    for row in LIVE:
        for value in good_values(row):
            result = node.set_parameters_atomically([ros(row.name, value)])
            assert result.successful, result.reason
            assert node.settings[row.name] == value
        before = node.settings
        for value in bad_values(row):
            result = node.set_parameters_atomically([ros(row.name, value)])
            assert not result.successful, value
            assert result.reason.startswith(f"Parameter '{row.name}' must be"), result.reason
            with pytest.raises(ParameterError) as error:
                row.check(ros(row.name, value).value)
            assert result.reason == str(error.value)
        assert node.settings is before


def test_the_others_stay_while_it_runs_and_may_be_changed_before(running):
    session = running.session
    for row in FIXED:
        for value in [*good_values(row), *bad_values(row)]:
            result = running.set_parameters_atomically([ros(row.name, value)])
            assert result.successful == means_the_default(row, value), (row.name, value)
            assert result.successful or row.name in result.reason
        assert running.get_parameter(row.name).value == row.default
        running.session = None
        for value in good_values(row):
            result = running.set_parameters_atomically([ros(row.name, value)])
            try:
                alone = Settings({row.name: value})
            except ParameterError as error:  # at odds with another
                assert result.reason == str(error)
            else:
                assert result.successful
                assert running.settings == alone
        assert running.set_parameters_atomically([ros(row.name, row.default)]).successful
        running.session = session
    assert running.settings == Settings()


def test_values_have_the_type_of_the_table(context):
    given = [ros('hold_limit', 20), ros('record_queue', 2000.0)]
    node = MonitorNode(context=context, parameter_overrides=given)
    assert type(node.get_parameter('hold_limit').value) is float
    assert type(node.get_parameter('record_queue').value) is int
    assert node.set_parameters_atomically([ros('alarm_flood', 7.0)]).successful
    (set_one,) = node.set_parameters([ros('alarm_dead_band', 0)])
    assert set_one.successful
    assert type(node.get_parameter('alarm_flood').value) is int
    assert type(node.get_parameter('alarm_dead_band').value) is float
    node.destroy_node()


def test_what_was_dumped_can_be_loaded_while_it_runs(running):
    declared = [running.get_parameter(name) for name in running._parameters]
    declared += [ros(row.name, row.default) for row in TABLE]
    for one in declared:
        assert running.set_parameters_atomically([one]).successful, one.name
    assert running.set_parameters_atomically(declared).successful


def test_setting_one_after_the_other_is_judged_too_and_together_it_is_all_or_nothing(node):
    both = [ros('alarm_limit', 5), ros('alarm_dead_band', 0.95)]
    assert not node.set_parameters_atomically(both).successful
    assert node.settings == Settings()
    good, bad = node.set_parameters(both)
    assert (good.successful, bad.successful) == (True, False)
    assert (node.settings['alarm_limit'], node.settings['alarm_dead_band']) == (5.0, 0.3)


def test_bad_values_at_the_start_are_refused_with_the_tables_sentence(context):
    for row in TABLE:
        node = Node(
            'start', context=context, parameter_overrides=[ros(row.name, bad_values(row)[-1])]
        )
        with pytest.raises(ParameterError) as error:
            declare(node, [row])
        assert error.value.name == row.name
        node.destroy_node()
    overrides = [ros('max_pieces', 'many')]
    with pytest.raises(ParameterError, match='must be a whole number'):
        MonitorNode(context=context, parameter_overrides=overrides)
    overrides = [ros('valve_opening_low', 49.0), ros('steady_limit', 9.0)]  # at odds
    with pytest.raises(ParameterError):
        MonitorNode(context=context, parameter_overrides=overrides)


def test_misspelt_parameters_are_named(context):
    overrides = [ros('refit_periodd', 30.0), ros('use_sim_time', False), ros('record', False)]
    node = MonitorNode(context=context, parameter_overrides=overrides)
    (sentence,) = unknown_overrides(node)
    assert sentence == "Parameter 'refit_periodd' does not exist; did you mean 'refit_period'?"
    (item,) = node.unknown_parameters()
    assert (item.name, item.level) == ('parameters', Level.WARN)
    assert item.sentence == f'{sentence} It is ignored.'
    node.destroy_node()


# Names of sections, and of the nodes to which each of them applies.
HERE, THERE, DEEP = '/valveflow_monitor', '/u1/valveflow_monitor', '/a/u1/valveflow_monitor'
SECTIONS = {
    '/**': {HERE, THERE, DEEP}, '**': {HERE, THERE, DEEP}, 'valveflow_monitor': {HERE},
    HERE: {HERE}, '/*': {HERE}, 'u1/valveflow_monitor': {THERE}, '/u1/*': {THERE},
    '/u1/**': {THERE}, '/*/valveflow_monitor': {THERE}, '/**/valveflow_monitor':
    {HERE, THERE, DEEP}, 'monitor': set(), '/valveflow_monitor/*': set(),
}  # fmt: skip


@pytest.mark.usefixtures('ros_environment')
def test_a_parameter_file_without_effect_is_told(tmp_path):
    file = tmp_path / 'x.yaml'
    for section, nodes in SECTIONS.items():
        file.write_text(f"'{section}':\n  ros__parameters:\n    delay: 3.0\n")
        for name in (HERE, THERE, DEEP):
            namespace = name.removesuffix(HERE) or '/'
            args = ['--ros-args', '--params-file', str(file), '-r', f'__ns:={namespace}']
            context = Context()
            context.init(args)
            node = Node('valveflow_monitor', context=context)
            taken = 'delay' in node._parameter_overrides
            node.destroy_node()
            assert taken == (name in nodes), (section, name)
            assert bool(unmatched_files(args, name)) == (not taken), (section, name)
            context.try_shutdown()
    args = ['--ros-args', '--params-file', str(file)]
    context = Context()
    context.init(args)
    node = MonitorNode(args=args, context=context)
    (item,) = node.unknown_parameters()
    assert item.level == Level.WARN
    assert item.sentence == (
        f'The parameter file {file} has no section for the node {HERE}, only '
        "'/valveflow_monitor/*'. It is ignored."
    )
    node.destroy_node()
    context.try_shutdown()


def test_the_clock_cannot_be_taken_over_while_it_runs(running):
    foreign = [ros('start_type_description_service', True)]
    assert changed(Settings(), foreign, running=True) == Settings()
    result = running.set_parameters_atomically([ros('use_sim_time', True)])
    assert (result.successful, result.reason) == (
        False,
        "Parameter 'use_sim_time' cannot be changed while the monitor runs; set it at the start, "
        'or after a clean-up.',
    )
    assert running.get_parameter('use_sim_time').value is False


@pytest.fixture
def ask(context, running):
    """Ask a service of the running node from another one."""
    asking = Node('asking', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(running)
    executor.add_node(asking)
    clients = {}

    def answer(kind, name, request):
        if name not in clients:
            clients[name] = asking.create_client(kind, f'/valveflow_monitor/{name}')
            wait_until(clients[name].service_is_ready, 'the service', 20.0)
        future = clients[name].call_async(request)
        spin_until(executor, future.done, name, 60.0)
        return future.result()

    yield answer
    executor.shutdown()
    asking.destroy_node()


HOSTILE = [math.nan, -math.inf, -1, 1e308, -(2**63), True, '', 'nan', 'a\nb', 'x' * 100_000,
           [math.nan], ['a'], [b'\x00'], None]  # fmt: skip
STRANGE_NAMES = [
    'no_such_thing', '', ' ', 'Record', 'record_directory.', '../record', 'record\n', 'ä' * 2000,
    'qos_overrides./valve_opening.subscription.depth',
]  # fmt: skip


def hostile_wishes():
    """Everything for every parameter of the table, apart from what a live one may be set to."""
    wishes = [ros(name, value) for name in STRANGE_NAMES for value in (1.0, 'a', None)]
    wishes += [ros('use_sim_time', value) for value in (True, 1, 'yes', None)]
    for row in TABLE:
        values = [*HOSTILE, *bad_values(row)]
        for value in values:
            try:
                row.check(value)
            except ParameterError:
                pass
            else:
                if row.live or means_the_default(row, value):
                    continue
            wishes.append(ros(row.name, value))
    return wishes


def test_from_afar_nothing_hostile_gets_in(ask, running):
    declared = {name: running.get_parameter(name).value for name in running._parameters}
    wishes = hostile_wishes()
    assert len(wishes) >= 15 * len(TABLE)
    request = SetParameters.Request(parameters=[wish.to_parameter_msg() for wish in wishes])
    answers = list(zip(wishes, ask(SetParameters, 'set_parameters', request).results, strict=True))
    # One bad value among good ones spoils them all; enough to ask it once for each name.
    for wish in {wish.name: wish for wish in wishes}.values():
        both = [ros('alarm_off_delay', 7.0).to_parameter_msg(), wish.to_parameter_msg()]
        request = SetParametersAtomically.Request(parameters=both)
        result = ask(SetParametersAtomically, 'set_parameters_atomically', request).result
        answers.append((wish, result))
    for wish, result in answers:
        assert not result.successful, (wish.name, wish.value)
        assert len(result.reason) > 10, (wish.name, wish.value)
        if wish.name in declared:
            assert wish.name in result.reason
    assert {name: running.get_parameter(name).value for name in running._parameters} == declared
    assert running.settings == Settings()


def test_a_text_of_digits_is_given_as_the_refusal_of_a_number_says(context):
    written = shlex.split('''--ros-args -p unit_tag:="'7'"''')
    node = MonitorNode(context=context, cli_args=written)
    assert node.settings.text('unit_tag') == '7'
    node.destroy_node()


def test_the_parameter_file_is_the_table_and_ros_reads_it_as_the_defaults(context):
    # After a change of the table:
    #   python -c "from valveflow_ros.parameters import as_yaml; print(as_yaml(), end='')"
    # goes to config/monitor.yaml.
    text = (ROOT / 'config' / 'monitor.yaml').read_text()
    assert text == as_yaml()
    content = yaml.safe_load(text)
    assert Settings(content['/**']['ros__parameters']) == Settings()
    path = ROOT / 'config' / 'monitor.yaml'
    node = MonitorNode(context=context, cli_args=['--ros-args', '--params-file', str(path)])
    assert node.settings == Settings()
    assert unknown_overrides(node) == []
    node.destroy_node()
