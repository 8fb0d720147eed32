"""The command: choose the verb, run it, turn what happens into an exit status."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from valveflow_ros.cli.console import Console
from valveflow_ros.cli.usage import Parser, UsageError, add_common
from valveflow_ros.cli.verbs import load, overview
from valveflow_ros.errors import ValveflowError

DONE, NOT_DONE, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Without the program's name; those of the process by default.

    Returns
    -------
    int
        0 done, 1 could not be done, 2 wrong usage, 130 interrupted.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    console = Console(sys.stdout, sys.stderr, as_json='--json' in words, quiet='--quiet' in words)
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
        console.fail('stopped; nothing was left half-written.')
        return INTERRUPTED
    except BrokenPipeError:
        # Whoever read the output has gone; there is nobody to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except MemoryError:
        console.fail('There is not enough memory for this log; use a shorter part of it.')
    except Exception as error:  # noqa: BLE001 - the last line: a person gets a sentence
        _show_traceback()
        console.fail(_sentence(error))
    return NOT_DONE


def _command(words: list[str], console: Console) -> int:
    if not words or words[0] in ('-h', '--help', 'help'):
        sys.stdout.write(overview())
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
        return int(done.code or DONE)
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
