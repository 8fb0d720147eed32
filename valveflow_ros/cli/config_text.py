"""Writes a parameter file in which the fitted values say where they are from."""

from __future__ import annotations

from valveflow_ros import __version__
from valveflow_ros.cli.config_fit import Fitted
from valveflow_ros.parameters import TABLE, Settings, as_yaml
from valveflow_ros.report.terminal.text import clean


def parameter_file(source: str, found: Fitted) -> str:
    """Return the text of a ROS 2 parameter file for any node name.

    Parameters
    ----------
    source : str
        Name of the log.
    found : Fitted
        Parameters that follow from it.

    Raises
    ------
    ParameterError
        Values are at odds with each other.
    """
    values = found.changes()
    Settings(values)
    # Names of files and columns come from others: a line break in one would end the comment.
    lines = [
        f'# Parameters of the monitor, fitted to {clean(source)} by valveflow {__version__}.',
        "# Lines marked 'fitted' follow from the data; all others are the defaults.",
        *(f'# {clean(sentence)}' for sentence in found.left),
        *as_yaml([], {}).splitlines(),
    ]
    for row in TABLE:
        about, value = as_yaml([row], values).splitlines()[2:]
        lines.append(about)
        if row.name in found:
            lines.append(f'    # fitted: {clean(found[row.name].ground)}.')
        lines.append(value)
    return '\n'.join(lines) + '\n'
