# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Declares, describes and checks the parameters of the table as ROS parameters."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from valveflow_ros.errors import ParameterError, listed
from valveflow_ros.interface.settings import check_names
from valveflow_ros.logs.names import last_part
from valveflow_ros.parameters import (
    NOT_NOW,
    PARAMETERS,
    TABLE,
    Parameter,
    Settings,
    Value,
    parameter,
)
from valveflow_ros.ros.decoding import INPUT_BY_NAME, inputs_of

# Parameters that ROS itself adds to every node.
_SIM_TIME = 'use_sim_time'
_FOREIGN = (_SIM_TIME, 'start_type_description_service')
_FOREIGN_PREFIX = 'qos_overrides.'
_DEEPEST = 1_000_000


def descriptor(row: Parameter) -> ParameterDescriptor:
    """Return the descriptor of a parameter, for tools such as `ros2 param describe`."""
    found = ParameterDescriptor(
        name=row.name,
        description=f'{row.sentence} Unit: {row.unit}.' if row.unit else row.sentence,
        # Accept 30 for 30.0; `in_type` converts it.
        dynamic_typing=True,
    )
    limits = [f'One of {", ".join(row.choices)}.'] if row.choices else []
    limits += [] if row.live else ['To be changed while the node is unconfigured.']
    found.additional_constraints = ' '.join(limits)
    if row.low is None or row.high is None:
        return found
    if isinstance(row.default, int):
        found.integer_range = [IntegerRange(from_value=int(row.low), to_value=int(row.high))]
    else:
        found.floating_point_range = [
            FloatingPointRange(from_value=float(row.low), to_value=float(row.high))
        ]
    return found


def declare(node: Node, table: Iterable[Parameter] = TABLE) -> dict[str, object]:
    """Declare parameters and return their given values, each of them checked.

    Raises `ParameterError` if a value does not match its row in the table.
    """
    values: dict[str, object] = {}
    for row in table:
        # The table checks first, for its own messages; ROS gets the range afterwards.
        loose = ParameterDescriptor(dynamic_typing=True)
        value = _checked(row, node.declare_parameter(row.name, row.default, loose).value)
        node.set_parameters([RosParameter(row.name, value=value)])
        node.set_descriptor(row.name, descriptor(row))
        values[row.name] = value
    return values


def declare_all(node: Node, table: Iterable[Parameter], *others: str) -> dict[str, object]:
    """Do the same as `declare`, and warn of given parameters that are neither rows nor others."""
    values = declare(node, table)
    for sentence in unknown_overrides(node, [*values, *others]):
        node.get_logger().warning(f'{sentence} It is ignored.')
    return values


def in_type(wanted: Iterable[RosParameter]) -> list[RosParameter]:
    """Return parameters converted to the types of the table; invalid ones are unchanged."""
    found = []
    for item in wanted:
        with contextlib.suppress(ParameterError):
            item = RosParameter(item.name, value=parameter(item.name).check(item.value))
        found.append(item)
    return found


def stands(node: Node, wanted: RosParameter) -> bool:
    """Return True if a parameter already has this value, as most in a loaded file do."""
    if not node.has_parameter(wanted.name):
        return False
    now = node.get_parameter(wanted.name)
    return (now.type_, now.value) == (wanted.type_, wanted.value)


def _checked(row: Parameter, value: object) -> Value:
    if isinstance(row.default, str) and isinstance(value, int | float):
        in_file, in_shell = f"{row.name}: '{value}'", f'-p {row.name}:="\'{value}\'"'
        raise ParameterError(
            row.name,
            f'must be a text, not {value!r}; write {in_file} in a file, '
            f'{in_shell} on a command line',
        )
    return row.check(value)


def unknown_overrides(node: Node, known: Iterable[str] = PARAMETERS) -> list[str]:
    """Return a sentence for each given parameter that does not exist."""
    given: Mapping[str, RosParameter] = getattr(node, '_parameter_overrides', {})
    names = set(known) | set(_FOREIGN)
    sentences = []
    for name, item in given.items():
        if name in names or name.startswith(_FOREIGN_PREFIX):
            continue
        try:
            parameter(name, item.value)
        except ParameterError as error:
            sentences.append(str(error))
    return sentences


_POLICIES = {'history': ('keep_last', 'keep_all'), 'reliability': ('reliable', 'best_effort')}


def check_qos_overrides(node: Node, topics: Mapping[str, Iterable[str]]) -> list[str]:
    """Return a sentence for each QoS override that is for none of our topics.

    ``topics`` are full names by 'publisher' and 'subscription'. Raises `ParameterError` if an
    override has an invalid value.
    """
    given: Mapping[str, RosParameter] = getattr(node, '_parameter_overrides', {})
    known = {
        f'{_FOREIGN_PREFIX}{topic}.{entity}.{policy}'
        for entity, names in topics.items() for topic in names for policy in (*_POLICIES, 'depth')
    }  # fmt: skip
    sentences = []
    for name, item in given.items():
        words, value = _POLICIES.get(name.rpartition('.')[2]), item.value
        if not name.startswith(_FOREIGN_PREFIX):
            continue
        if name not in known:
            sentences.append(f"Parameter '{name}' is for no topic and policy of the monitor.")
        elif words and value not in words:
            raise ParameterError(name, f'must be {listed(words, "or")}, not {value!r}')
        elif not words and not (type(value) is int and 0 < value <= _DEEPEST):
            raise ParameterError(
                name, f'must be a whole number from 1 to {_DEEPEST}, not {value!r}'
            )
    return sentences


def inputs(node: Node, settings: Settings) -> dict[str, str]:
    """Return the full name of each topic to which the monitor subscribes, by name of the input.

    Raises `ParameterError` if a covariate has a name or a topic that cannot be used.
    """
    check_names(settings)
    found: dict[str, str] = {}
    for topic in reversed(inputs_of(settings)):
        own = topic.name in INPUT_BY_NAME
        try:
            full_name = node.resolve_topic_name(topic.topic)
        except RuntimeError:
            why = f"entry '{topic.topic}' is no name of a topic"
            raise ParameterError('covariates', f'cannot be used: {why}') from None
        # A log is read by the last part of a topic's name.
        if not own and (full_name in found.values() or last_part(full_name) in INPUT_BY_NAME):
            why = f"entry '{topic.topic}' is the topic of another input"
            raise ParameterError('covariates', f'cannot be used: {why}')
        found[topic.name] = full_name
    return dict(reversed(found.items()))


def changed(settings: Settings, wanted: Iterable[RosParameter], *, running: bool) -> Settings:
    """Return settings with some parameters changed.

    While ``running``, only live parameters may change. Raises `ParameterError` if a parameter may
    not be changed now, is invalid, or conflicts with another one.
    """
    values = {}
    for item in wanted:
        if item.name == _SIM_TIME and running:
            # Setting it would replace the node's clock.
            raise ParameterError(item.name, NOT_NOW)
        if item.name not in _FOREIGN and not item.name.startswith(_FOREIGN_PREFIX):
            values[item.name] = parameter(item.name).check(item.value)
    new = settings.changed(values)
    if running:
        settings.live_changes(new)
    return new
