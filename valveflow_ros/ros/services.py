"""What a running monitor can be asked to do, each a `std_srvs/Trigger` of the node."""

from __future__ import annotations

SERVICES = (
    'refit',
    'acknowledge_alarms',
    'shelve_alarms',
    'unshelve_alarms',
    'set_reference',
    'diagnose',
)
