"""The command: choose the verb, run it, turn what happens into an exit status."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from valveflow_ros.cli.console import Console
from valveflow_ros.cli.early import check_paths
from valveflow_ros.cli.stopping import Stop
from valveflow_ros.cli.usage import Parser, UsageError, add_common
from valveflow_ros.cli.verbs import load, overview
from valveflow_ros.errors import ValveflowError

DONE, NOT_DONE, WRONG_USAGE = 0, 1, 2
# As a shell tells of a process that a signal has ended: 130 after Ctrl-C.
_SIGNALLED = 128


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Without the program's name; those of the process by default.

    Returns
    -------
    int
        0 done, 1 could not be done, 2 wrong usage, 130 stopped by Ctrl-C, 143 by the system.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    console = Console(
        sys.stdout, sys.stderr, as_json='--json' in words, quiet='--quiet' in words,
        verb=words[0] if words else '',
    )  # fmt: skip
    with Stop().listening() as stop:
        return _guarded(words, console, stop)


def _guarded(words: list[str], console: Console, stop: Stop) -> int:
    try:
        return _command(words, console)
    except UsageError as error:
        hint = f'valveflow {words[0]} --help' if _is_verb(words) else 'valveflow --help'
        console.fail(f'{error} Try "{hint}".')
        return WRONG_USAGE
    except ValveflowError as error:
        _show_traceback()
        console.fail(str(error))
    except KeyboardInterrupt:
        return _stopped(console, stop)
    except BrokenPipeError:
        # Whoever read the output has gone; there is nobody to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except MemoryError:
        console.fail('There is not enough memory for this log; use a shorter part of it.')
    except Exception as error:  # noqa: BLE001 - the last line: a person gets a sentence
        if stop.number:
            # Libraries that were interrupted while they load raise errors of their own.
            return _stopped(console, stop)
        _show_traceback()
        console.fail(_sentence(error))
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
    verb = load(words[0])
    parser = Parser(f'valveflow {words[0]}')
    verb.arguments(parser)
    add_common(parser)
    try:
        options = parser.parse_args(words[1:])
    except SystemExit as done:  # --help was asked for
        sys.stdout.flush()
        return int(done.code or DONE)
    check_paths(words[0], parser, options)
    console.finish(verb.run(options, console))
    return DONE


def _is_verb(words: list[str]) -> bool:
    try:
        load(words[0])
    except (UsageError, IndexError):
        return False
    return True


def _show_traceback() -> None:
    if os.environ.get('VALVEFLOW_DEBUG') == '1':
        traceback.print_exc()


def _sentence(error: Exception) -> str:
    """Return one sentence for an error nobody foresaw, or one of the operating system."""
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
