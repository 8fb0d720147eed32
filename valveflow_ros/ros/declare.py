"""The table of parameters as ROS parameters: declared, described, and checked together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from valveflow_ros.errors import ParameterError
from valveflow_ros.parameters import PARAMETERS, TABLE, Parameter, Settings, Value, parameter

# What ROS itself puts among the parameters of every node.
_SIM_TIME = 'use_sim_time'
_FOREIGN = (_SIM_TIME, 'start_type_description_service')
_FOREIGN_PREFIX = 'qos_overrides.'
_AT_THE_START = 'cannot be changed while the monitor runs; set it at the start'


def descriptor(row: Parameter) -> ParameterDescriptor:
    """Describe a parameter to `ros2 param describe` and the like."""
    found = ParameterDescriptor(
        name=row.name,
        description=f'{row.sentence} Unit: {row.unit}.' if row.unit else row.sentence,
        read_only=not row.live,
        # 30 is to be as good as 30.0; the table knows what is meant.
        dynamic_typing=True,
    )
    if row.choices:
        found.additional_constraints = f'One of {", ".join(row.choices)}.'
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
    """Declare parameters and return the values given for them, checked one by one.

    Raises
    ------
    ParameterError
        A value does not fit its row.
    """
    values: dict[str, object] = {}
    for row in table:
        # The table judges first, with its own sentence; then ROS learns the range too.
        loose = ParameterDescriptor(dynamic_typing=True)
        values[row.name] = _checked(
            row, node.declare_parameter(row.name, row.default, loose).value
        )
        node.set_descriptor(row.name, descriptor(row))
    return values


def _checked(row: Parameter, value: object) -> Value:
    if isinstance(row.default, str) and isinstance(value, int | float):
        hint = 'put it in quotes, and those in quotes once more on a command line'
        raise ParameterError(row.name, f'must be a text, not {value!r}: {hint}')
    return row.check(value)


def unknown_overrides(node: Node, known: Iterable[str] = PARAMETERS) -> list[str]:
    """Return a sentence for each parameter that was given and does not exist."""
    given: Mapping[str, object] = getattr(node, '_parameter_overrides', {})
    names = set(known) | set(_FOREIGN)
    sentences = []
    for name in given:
        if name in names or name.startswith(_FOREIGN_PREFIX):
            continue
        try:
            parameter(name)
        except ParameterError as error:
            sentences.append(str(error))
    return sentences


def changed(settings: Settings, wanted: Iterable[RosParameter]) -> Settings:
    """Return settings with some parameters changed.

    Raises
    ------
    ParameterError
        One may not be changed now, does not fit its row, or is at odds with another.
    """
    values = {}
    for item in wanted:
        if item.name == _SIM_TIME:
            # Setting it would replace the node's clock.
            raise ParameterError(item.name, _AT_THE_START)
        if item.name in _FOREIGN:
            continue
        row = parameter(item.name)
        value = row.check(item.value)
        if not row.live:
            raise ParameterError(row.name, _AT_THE_START)
        values[row.name] = value
    return settings.changed(values)
