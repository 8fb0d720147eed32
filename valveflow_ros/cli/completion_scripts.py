"""The scripts of `valveflow completion`, one for each shell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from valveflow_ros.cli.completion_table import Kind, Option, Verb

_FIRST = ('--help', '--version')


def script(shell: str, verbs: Sequence[Verb]) -> str:
    """Return the script for ``bash``, ``zsh`` or ``fish``."""
    lines = {'bash': _bash, 'zsh': _zsh, 'fish': _fish}[shell](verbs)
    return '\n'.join(lines) + '\n'


def _bash(verbs: Sequence[Verb]) -> Iterator[str]:
    first = ' '.join([*(v.name for v in verbs), *_FIRST])
    yield '# valveflow, completion for bash: source <(valveflow completion bash)'
    yield '_valveflow() {'
    yield '    local cur=${COMP_WORDS[COMP_CWORD]} prev=${COMP_WORDS[COMP_CWORD-1]}'
    yield '    local verb=${COMP_WORDS[1]} words='
    yield '    COMPREPLY=()'
    yield '    if [[ $COMP_CWORD -eq 1 ]]; then'
    yield f'        COMPREPLY=($(compgen -W "{first}" -- "$cur"))'
    yield '        return'
    yield '    fi'
    yield '    case "$verb $prev" in'
    for verb in verbs:
        for option in verb.options:
            pattern = '|'.join(f'"{verb.name} {flag}"' for flag in option.flags)
            if option.kind is Kind.FILE or option.kind is Kind.VALUE:
                yield f'        {pattern}) return ;;'
            elif option.kind is not Kind.NOTHING:
                yield f'        {pattern}) words="{" ".join(option.words)}" ;;'
    yield '    esac'
    yield '    if [[ -z $words ]]; then'
    yield '        case "$verb" in'
    for verb in verbs:
        flags = ' '.join(flag for o in verb.options for flag in o.flags)
        yield f'        {verb.name}) words="{" ".join([*verb.words, flags]).strip()}" ;;'
    yield '        esac'
    # Without a dash a file is meant, which the shell finds by itself.
    own = '|'.join(v.name for v in verbs if v.words)
    yield f'        [[ $cur == -* || $verb == @({own or "-"}) ]] || return'
    yield '    fi'
    yield '    COMPREPLY=($(compgen -W "$words" -- "$cur"))'
    yield '    if [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *= ]]; then'
    yield '        compopt -o nospace 2>/dev/null'
    yield '    fi'
    yield '}'
    yield 'shopt -s extglob'
    yield 'complete -o default -F _valveflow valveflow'


def _zsh(verbs: Sequence[Verb]) -> Iterator[str]:
    yield '#compdef valveflow'
    yield '# valveflow, completion for zsh: source <(valveflow completion zsh)'
    yield '_valveflow() {'
    yield '    local -a verbs'
    yield '    verbs=('
    for verb in verbs:
        yield f'        {_quoted(f"{verb.name}:{verb.about}")}'
    yield '    )'
    yield '    if (( CURRENT == 2 )); then'
    yield "        _describe 'verb' verbs"
    yield '        return'
    yield '    fi'
    yield '    local verb=$words[2]'
    yield '    shift words'
    yield '    (( CURRENT-- ))'
    yield '    case $verb in'
    for verb in verbs:
        yield f'        {verb.name})'
        yield '            _arguments -S \\'
        for option in verb.options:
            for flag in option.flags:
                yield f'                {_quoted(_zsh_option(flag, option))} \\'
        rest = f'*:word:({" ".join(verb.words)})' if verb.words else '*:file:_files'
        yield f'                {_quoted(rest)} ;;'
    yield '    esac'
    yield '}'
    yield 'compdef _valveflow valveflow'


def _zsh_option(flag: str, option: Option) -> str:
    about = option.about
    for sign in '\\[]:':
        about = about.replace(sign, f'\\{sign}')
    text = f'*{flag}[{about}]'
    if option.kind is Kind.FILE:
        return f'{text}:file:_files'
    if option.kind is Kind.VALUE:
        return f'{text}:value:'
    if option.kind is Kind.NOTHING:
        return text
    if option.kind is Kind.NAME and any(w.endswith('=') for w in option.words):
        # What follows the sign is written without a blank between.
        return f"{text}:name:compadd -S '' - {' '.join(option.words)}"
    return f'{text}:name:({" ".join(option.words)})'


def _fish(verbs: Sequence[Verb]) -> Iterator[str]:
    yield '# valveflow, completion for fish: valveflow completion fish | source'
    yield 'complete -c valveflow -e'
    names = ' '.join(v.name for v in verbs)
    none = f"-n 'not __fish_seen_subcommand_from {names}'"
    yield f"complete -c valveflow -f {none} -l help -d 'what the command does'"
    yield f"complete -c valveflow -f {none} -l version -d 'which version this is'"
    for verb in verbs:
        about = _quoted(verb.about, fish=True)
        yield f'complete -c valveflow -f {none} -a {verb.name} -d {about}'
    for verb in verbs:
        seen = f"-n '__fish_seen_subcommand_from {verb.name}'"
        if verb.words:
            yield f"complete -c valveflow -f {seen} -a '{' '.join(verb.words)}'"
        for option in verb.options:
            yield f'complete -c valveflow {seen} {_fish_option(option)}'


def _fish_option(option: Option) -> str:
    flags = [f'-s {f[1:]}' if not f.startswith('--') else f'-l {f[2:]}' for f in option.flags]
    tail = {
        Kind.NOTHING: '',
        Kind.FILE: ' -r -F',
        Kind.VALUE: ' -x',
    }.get(option.kind, f" -x -a '{' '.join(option.words)}'")
    return f'{" ".join(flags)}{tail} -d {_quoted(option.about, fish=True)}'


def _quoted(text: str, fish: bool = False) -> str:
    """Return a text in single quotes, as the shell wants an apostrophe in it."""
    if fish:
        text = text.replace('\\', '\\\\')
    return "'" + text.replace("'", "\\'" if fish else "'\\''") + "'"
