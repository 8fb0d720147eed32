# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command: select the verb, parse its options, run it, return the exit status."""

from __future__ import annotations

import difflib
import gc
import importlib
import os
import signal
import sys
import time
import traceback
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, Protocol, cast

from valveflow_ros.cli.command import Console, VerbResult, zone_in
from valveflow_ros.errors import (
    LOADING_BYTES,
    UsageError,
    ValveflowError,
    check_address_space,
)
from valveflow_ros.interface.files import check_folder, check_readable, check_writable
from valveflow_ros.report.terminal.text import usage_sentence

DONE, NOT_DONE, WRONG_USAGE = 0, 1, 2
# Exit status of a process ended by a signal, as in a shell: 130 after Ctrl-C.
_SIGNALLED = 128
# A second signal within this many seconds is ignored, so that the clean-up is completed.
_ONCE_S = 2.0
# The matrices are small. On a busy machine OpenBLAS waits so long for its other threads that
# `diagnose` takes twice the processor time. Long loops have threads of their own.
_BLAS_THREADS = ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')

# In the order in which a new user needs them: verb, module, description.
VERBS: tuple[tuple[str, str, str], ...] = (
    ('simulate', 'simulate', 'simulate a plant, with any effect switched on'),
    ('import', 'import_table', 'make a log from a table of a historian'),
    ('info', 'info', 'show the contents and the quality of a log'),
    ('identify', 'identify', 'find the flow characteristic'),
    ('diagnose', 'diagnose', 'find the cause where the power differs from the curve'),
    ('monitor', 'monitor', 'run the monitor over a log: its curves, alarms and diagnoses'),
    ('fleet', 'fleet', 'identify, diagnose and monitor many logs of many units'),
    ('validate', 'validate', 'check a characteristic with a log of other days'),
    ('loop', 'loop', 'judge one control valve: stiction, backlash, sound, or not known'),
    ('compare', 'compare', 'compare the method with two of the literature'),
    ('compensate', 'compensate', 'write the inverse curve as a table for the turbine controller'),
    ('export', 'export', 'write a log as a table'),
    ('recover', 'recover', 'repair a broken recording'),
    ('config', 'config', 'make (init) or check a parameter file for the monitor'),
    ('watch', 'watch', 'show a running monitor in the terminal or on a page'),
    ('completion', 'completion', 'complete commands in the shell'),
)

OVERVIEW = """\
valveflow finds the flow characteristic of main steam valves in ordinary operating data.

{verbs}

Try it:
  valveflow simulate -o plant.mcap
  valveflow identify plant.mcap -o result
and open result/report.html.

A log is an .mcap file (a recording of ROS 2), a rosbag2 folder, or a table: .csv, .xlsx or
.parquet. Exit status: 0 done; 1 not possible, and a sentence says why; 2 wrong use of the command;
130 ended by Ctrl-C.
"valveflow VERB --help" tells more about a verb, "valveflow --version" which version this is.
"""


class Verb(Protocol):
    """The interface of the module of a verb."""

    USAGE: str
    DESCRIPTION: str

    def arguments(self, parser: ArgumentParser) -> None:
        """Add the options."""

    def run(self, options: Namespace, console: Console) -> VerbResult:
        """Run the verb."""


def overview() -> str:
    """Return the text for ``valveflow`` without a verb."""
    lines = [f'  valveflow {name:<11} {about}' for name, _, about in VERBS]
    return OVERVIEW.format(verbs='\n'.join(lines))


def load(name: str) -> Verb:
    """Return the module of a verb; raise `UsageError`, which names the most similar one."""
    modules = {verb: module for verb, module, _ in VERBS}
    if name not in modules:
        near = difflib.get_close_matches(name, modules, n=1)
        hint = f" Did you mean '{near[0]}'?" if near else f' The verbs are {", ".join(modules)}.'
        raise UsageError(f"There is no verb '{name}'.{hint}")
    return cast(Verb, importlib.import_module(f'valveflow_ros.cli.verbs.{modules[name]}'))


class Parser(ArgumentParser):
    """A parser that raises `UsageError` and keeps the layout of the help texts."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog=prog, formatter_class=_Formatter, allow_abbrev=False, add_help=False)
        self._positionals.title = 'arguments'
        self.add_argument('-h', '--help', action='help', help='show this page')

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; an unknown option is reported before a missing one."""
        for word in [] if args is None else list(args):
            if word == '--':
                break
            name = word.partition('=')[0]
            if name.startswith('--') and name not in self._option_string_actions:
                known = [o for o in self._option_string_actions if o.startswith('--')]
                near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
                hint = f" Did you mean '{near[0]}'?" if near else ''
                raise UsageError(f"There is no option '{name}'.{hint}")
        return super().parse_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Raise the error of argparse as a sentence."""
        output = ''
        if message.startswith('unrecognized') and '-o' in self._option_string_actions:
            output = ' Write an output as -o OUTPUT.'
        raise UsageError(f'{usage_sentence(message)}{output}')


class _Formatter(RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28, width=92)


def parser_of(name: str, verb: Verb | None = None) -> Parser:
    """Return the parser of a verb; raises `UsageError` if there is none of that name."""
    parser = Parser(f'valveflow {name}')
    verb = verb or load(name)
    parser.usage, parser.description = f'valveflow {name} {verb.USAGE}', verb.DESCRIPTION
    verb.arguments(parser)
    parser.add_argument(
        '--json', action='store_true', help='print the result as JSON, for programs'
    )
    parser.add_argument(
        '--quiet', action='store_true', help='say nothing but warnings and the result'
    )
    return parser


def check_paths(parser: ArgumentParser, options: Namespace) -> None:
    """Raise `RecordingError` for the first path in the options that cannot be read or written.

    The content of files is checked by the verb.
    """
    for action in parser._actions:
        path = getattr(options, action.dest, None)
        if not isinstance(path, Path):
            continue
        if action.metavar == 'DIR':
            check_folder(path)
        elif action.dest == 'truth' and 'seed' in options:  # the only FILE option for output
            check_writable(path)
        elif action.metavar == 'FILE' and action.dest != 'output':
            check_readable(path.expanduser(), 'cannot be read')
        elif action.metavar in ('LOG', 'LOG2', 'TABLE', 'BROKEN') and action.dest != 'output':
            check_readable(path, 'cannot be opened')


class Stop:
    """Turns signals into `KeyboardInterrupt`; ``number`` is the first received one, or 0."""

    def __init__(self) -> None:
        self.number = 0
        self._at_s = 0.0

    def _come(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.number and now - self._at_s < _ONCE_S:
            return
        self.number, self._at_s = number, now
        # Incomplete objects of libraries may raise errors when they are deleted; ignore them.
        sys.unraisablehook = lambda _: None
        raise KeyboardInterrupt

    @contextmanager
    def listening(self, ends_process: bool = False) -> Iterator[Stop]:
        """Handle the signals within a block; the earlier handlers are restored after it.

        If the process ends after the block, Ctrl-C is ignored from then on: the output is
        complete, and the interpreter needs a part of a second to end.
        """
        before: dict[int, object] = {}
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # Background jobs of a shell ignore Ctrl-C, and nohup ignores a hang-up: keep this.
            if signal.getsignal(number) == signal.SIG_IGN:
                continue
            with suppress(ValueError):  # not in the main thread
                before[number] = signal.signal(number, self._come)
        try:
            yield self
        finally:
            for taken, handler in before.items():
                if ends_process and taken == signal.SIGINT:
                    handler = signal.SIG_IGN
                signal.signal(taken, handler)  # type: ignore[arg-type]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Without the program name; those of the process by default.

    Returns
    -------
    int
        0 done, 1 not possible, 2 wrong usage, 130 stopped by Ctrl-C, 143 by the system.
    """
    if '_ARGCOMPLETE' in os.environ:
        from valveflow_ros.cli.verbs.completion import complete

        complete([(name, about) for name, _, about in VERBS], parser_of)
    for variable in _BLAS_THREADS:  # NumPy is not yet loaded
        os.environ.setdefault(variable, '1')
    words = list(sys.argv[1:] if arguments is None else arguments)
    console = Console(sys.stdout, sys.stderr, as_json='--json' in words, quiet='--quiet' in words)
    # Compilation creates millions of permanent objects: garbage collection with the usual
    # frequency takes a tenth of the time of the first run.
    gc.set_threshold(50_000, 20, 50)
    with Stop().listening(ends_process=arguments is None) as stop:
        return _guarded(words, console, stop)


def _guarded(words: list[str], console: Console, stop: Stop) -> int:
    try:
        return _command(words, console)
    except UsageError as error:
        verb = f'{words[0]} ' if words[0] in {name for name, _, _ in VERBS} else ''
        console.fail(f'{error} Try "valveflow {verb}--help".')
        return WRONG_USAGE
    except ValveflowError as error:
        _show_traceback()
        console.fail(str(error))
    except KeyboardInterrupt:
        return _stopped(console, stop)
    except BrokenPipeError:
        # The reader of the output has closed it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except MemoryError:
        console.fail('There is not enough memory for this log; use a shorter part of it.')
    except Exception as error:  # noqa: BLE001 - the last line: a person gets a sentence
        if stop.number:
            # Libraries that are interrupted during import raise other errors.
            return _stopped(console, stop)
        _show_traceback()
        console.fail(_unforeseen(error))
    return NOT_DONE


def _stopped(console: Console, stop: Stop) -> int:
    console.fail('stopped; nothing was left half-written.')
    return _SIGNALLED + (stop.number or 2)


def _command(words: list[str], console: Console) -> int:
    if not words or words[0] in ('-h', '--help', 'help'):
        sys.stdout.write(overview())
        sys.stdout.flush()
        return DONE
    if words[0] == '--version':
        from valveflow_ros import __version__

        sys.stdout.write(f'valveflow {__version__}\n')
        return DONE
    if words[0].startswith('-'):
        raise UsageError(f"The verb comes first, options after it: '{words[0]}' is no verb.")
    check_address_space(LOADING_BYTES)
    verb = load(words[0])
    parser = parser_of(words[0], verb)
    try:
        options = parser.parse_args(words[1:])
    except SystemExit as done:  # --help
        sys.stdout.flush()
        return int(done.code or DONE)
    console.times_in(zone_in(options))
    # watch waits for missing paths and reports them itself.
    if words[0] != 'watch':
        check_paths(parser, options)
    console.finish(verb.run(options, console))
    return DONE


def _show_traceback() -> None:
    if os.environ.get('VALVEFLOW_DEBUG') == '1':
        traceback.print_exc()


def _unforeseen(error: Exception) -> str:
    """Return a sentence for an unexpected error, or one of the operating system."""
    if isinstance(error, OSError) and error.strerror:
        named = f'{error.filename}: ' if error.filename else ''
        return f'{named}{error.strerror.lower()}.'
    place = traceback.extract_tb(error.__traceback__)[-1]
    about = ' '.join(f'{type(error).__name__}: {error}'.split())[:200]
    return (
        f'This should not have happened ({about}, in {Path(place.filename).name} line '
        f'{place.lineno}); please report it with this line. '
        'VALVEFLOW_DEBUG=1 before the command shows more.'
    )


if __name__ == '__main__':
    sys.exit(main())
