"""Quality of service as rosbag2 writes it down (metadata version 9)."""

from __future__ import annotations

from dataclasses import dataclass

# The longest duration that ROS 2 can express stands for "no limit".
_NO_LIMIT = ('sec: 9223372036', 'nsec: 854775807')


@dataclass(frozen=True, slots=True)
class Qos:
    """What the publisher of a topic offers, in rosbag2's words."""

    reliability: str = 'reliable'
    durability: str = 'volatile'
    history: str = 'keep_last'
    depth: int = 10

    def text(self) -> str:
        """Return the YAML list of one profile that stands in a channel's metadata."""
        lines = [
            f'- history: {self.history}',
            f'  depth: {self.depth}',
            f'  reliability: {self.reliability}',
            f'  durability: {self.durability}',
        ]
        for name in ('deadline', 'lifespan'):
            lines += [f'  {name}:', *(f'    {part}' for part in _NO_LIMIT)]
        lines += ['  liveliness: automatic', '  liveliness_lease_duration:']
        lines += [f'    {part}' for part in _NO_LIMIT]
        lines += ['  avoid_ros_namespace_conventions: false']
        return '\n'.join(lines)


LATCHED = Qos(durability='transient_local', depth=1)
