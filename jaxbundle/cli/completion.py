"""`jaxbundle completion`: what a shell needs to complete the command line, from the parsers."""

import shlex
from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple

import typer

from jaxbundle.cli import COMMANDS, import_command
from jaxbundle.cli.app import app, choice

SHELLS = ("bash", "zsh", "fish")


class CommandNode(NamedTuple):
    """A command: the words that lead to it, the commands below it (or the words that an argument is
    one of), its options."""

    words: tuple[str, ...]
    below: tuple[str, ...]
    options: dict[str, tuple[str, ...]]
    """By name the allowed words; empty: a flag, or any value."""
    flags: frozenset[str]
    helps: dict[str, str]


@app.command(example="bash", computes=False)
def completion(shell: Annotated[str, choice(SHELLS, argument=True)]) -> None:
    """Print what a shell needs to complete commands, options and their words.

    Put it where the shell looks: of bash ~/.local/share/bash-completion/completions/jaxbundle, of
    zsh a file that ~/.zshrc sources after compinit, of fish
    ~/.config/fish/completions/jaxbundle.fish.
    """
    # A command registers itself when its file is imported.
    for command in COMMANDS:
        import_command(command)
    parser = typer.main.get_command(app)
    nodes = list(walk(parser, typer.Context(parser, info_name="jaxbundle"), ("jaxbundle",)))
    print(for_fish(nodes) if shell == "fish" else for_bash(nodes, shell == "zsh"), end="")


def walk(command: Any, context: Any, words: tuple[str, ...]) -> Iterator[CommandNode]:
    """All commands, from the program down."""
    options: dict[str, tuple[str, ...]] = {}
    flags, helps = set(), {}
    subcommands = dict(getattr(command, "commands", {}))
    words_after = list(subcommands)
    for parameter in command.get_params(context):
        if parameter.param_type_name != "option":
            words_after += [
                i.value for i in parameter.shell_complete(context, "") if i.type == "plain"
            ]
            continue
        for name in (*parameter.opts, *parameter.secondary_opts):
            words_of = () if parameter.is_flag else parameter.shell_complete(context, "")
            options[name] = tuple(item.value for item in words_of if item.type == "plain")
            helps[name] = (parameter.help or "").split("; ")[0]
            if parameter.is_flag:
                flags.add(name)
    yield CommandNode(words, tuple(words_after), options, frozenset(flags), helps)
    for name, subcommand in subcommands.items():
        yield from walk(
            subcommand, type(context)(subcommand, parent=context, info_name=name), (*words, name)
        )


def for_bash(nodes: list[CommandNode], zsh: bool = False) -> str:
    """For zsh by its emulation of bash."""
    ways = [" ".join(node.words) for node in nodes if len(node.words) > 1]
    lines = ["autoload -U +X bashcompinit && bashcompinit"] if zsh else []
    lines += [
        "_jaxbundle() {",
        "  local current=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]}",
        "  local way=jaxbundle words= k",
        "  for ((k = 1; k < COMP_CWORD; k++)); do",
        '    case "$way ${COMP_WORDS[k]}" in',
        f'      {"|".join(map(_quoted, ways))}) way="$way ${{COMP_WORDS[k]}}" ;;',
        "    esac",
        "  done",
        '  case "$way:$before" in',
    ]
    for node in nodes:
        typed = " ".join(node.words)
        for name, words in node.options.items():
            if words:
                lines.append(
                    f"    {_quoted(f'{typed}:{name}')}) words={_quoted(' '.join(words))} ;;"
                )
            elif name not in node.flags:
                lines.append(f"    {_quoted(f'{typed}:{name}')}) return ;;")
    lines += ["    *)", '      case "$way:$current" in']
    for node in nodes:
        typed = " ".join(node.words)
        options = " ".join(node.options)
        lines.append(f"        {_quoted(f'{typed}:')}-*) words={_quoted(options)} ;;")
        if node.below:
            subcommands = _quoted(" ".join(node.below))
            lines.append(f"        {_quoted(f'{typed}:')}*) words={subcommands} ;;")
    lines += [
        "      esac ;;",
        "  esac",
        '  COMPREPLY=($(compgen -W "$words" -- "$current"))',
        "}",
        "complete -o default -F _jaxbundle jaxbundle",
    ]
    return "\n".join(lines) + "\n"


def for_fish(nodes: list[CommandNode]) -> str:
    """One line for each command and option."""
    lines = []
    for node in nodes:
        is_under = "; and ".join(f"__fish_seen_subcommand_from {word}" for word in node.words[1:])
        if node.below:
            and_not = f"{is_under}; and not" if is_under else "not"
            when = f"{and_not} __fish_seen_subcommand_from {' '.join(node.below)}"
            subcommands = _quoted(" ".join(node.below))
            lines.append(f"complete -c jaxbundle -f -n {_quoted(when)} -a {subcommands}")
        for name, words in node.options.items():
            if not (is_under and name.startswith("--")):
                continue
            line = f"complete -c jaxbundle -n {_quoted(is_under)} -l {name[2:]}"
            line += f" -x -a {_quoted(' '.join(words))}" if words else ""
            line += "" if words or name in node.flags else " -r"
            lines.append(f"{line} -d {_quoted(node.helps[name])}")
    return "\n".join(lines) + "\n"


_quoted = shlex.quote
