"""Who publishes an input, seen in the ROS graph: a wrong type makes no noise of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy


@dataclass(frozen=True, slots=True)
class Publishers:
    """The publishers of one topic.

    Attributes
    ----------
    right : int
        Publishers of the type we listen for.
    wrong_types : tuple of str
        Other types somebody publishes on the same topic.
    best_effort : bool
        Whether one of the right ones offers best effort only.
    """

    right: int = 0
    wrong_types: tuple[str, ...] = ()
    best_effort: bool = False


def publishers(node: Node, topics: Mapping[str, tuple[str, str]]) -> dict[str, Publishers]:
    """Look the publishers of some topics up.

    Parameters
    ----------
    topics : mapping
        Name to (full topic name, type we listen for).
    """
    return {
        name: _publishers(node, topic, type_name) for name, (topic, type_name) in topics.items()
    }


def _publishers(node: Node, topic: str, type_name: str) -> Publishers:
    found = node.get_publishers_info_by_topic(topic)
    right = [info for info in found if info.topic_type == type_name]
    wrong = sorted({info.topic_type for info in found} - {type_name})
    weak = ReliabilityPolicy.BEST_EFFORT
    return Publishers(
        len(right), tuple(wrong), any(info.qos_profile.reliability == weak for info in right)
    )
