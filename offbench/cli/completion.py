"""Shell completion, written out as one static script from the parsers themselves.

    offbench completion bash > ~/.local/share/bash-completion/completions/offbench

What it offers after the words typed so far: commands; a command's flags; an algorithm's own settings; the words that
a flag or a place takes; dataset ids from Minari's folder, looked up when asked; else files.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence

from offbench.benchmarks.grid import shipped_grids
from offbench.data.levels import LEVELS
from offbench.envs.recipes import names
from offbench.training.registry import algorithm_names

SHELLS = ("bash", "zsh", "fish")
DATASETS = "@datasets"  # stands for what is recorded when completion is asked for

BASH = """# offbench completion for bash
_offbench_datasets() { ls "${{MINARI_DATASETS_PATH:-$HOME/.minari/datasets}}" 2>/dev/null; }
_offbench() {
    local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]} found=""
    if [ "$COMP_CWORD" -eq 1 ]; then found="%(commands)s"
    else
        case "${COMP_WORDS[1]} $before" in
%(values)s
        *) case "$word" in
            -*) case "${COMP_WORDS[1]} ${COMP_WORDS[2]}" in
%(flags)s
                esac ;;
            *) case "${COMP_WORDS[1]}" in
%(places)s
                esac ;;
            esac ;;
        esac
    fi
    COMPREPLY=($(compgen -W "$found" -- "$word"))
}
complete -o default -F _offbench offbench""".replace("{{", "{").replace("}}", "}")

FISH = """# offbench completion for fish
function __offbench_datasets
    set -l folder ~/.minari/datasets
    set -q MINARI_DATASETS_PATH; and set folder $MINARI_DATASETS_PATH
    test -d $folder; and ls $folder
end"""


def script(shell: str, commands: Mapping[str, str], parser: Callable[[list[str]], argparse.ArgumentParser]) -> str:
    """Return the completion script of a shell.

    Args:
        commands: each with its help.
        parser: makes a command's parser from the words typed, e.g. ["train", "bdb"].
    """
    tables: dict[tuple[str, ...], argparse.ArgumentParser] = {
        (name,): parser([name]) for name in commands if name != "completion"
    }
    tables |= {("train", name): parser(["train", name]) for name in algorithm_names()}
    if shell == "fish":
        return _fish(commands, tables)
    text = _bash(commands, tables)
    return text if shell == "bash" else f"#compdef offbench\nautoload -U bashcompinit && bashcompinit\n{text}"


def _bash(commands: Mapping[str, str], tables: Mapping[tuple[str, ...], argparse.ArgumentParser]) -> str:
    values, flags, places = [], [], ["                completion) found='bash zsh fish' ;;"]
    # an algorithm's settings stand before the flags of `train` alone: bash takes the first that fits
    for words, parser in sorted(tables.items(), key=lambda item: -len(item[0])):
        options = [flag for action in _options(parser) for flag in action.option_strings]
        pattern = " ".join(words) if len(words) == 2 else f"{words[0]} "
        flags.append(f"                {_quoted(pattern)}{'' if len(words) == 2 else '*'}) found={_list(options)} ;;")
        for action in _options(parser):
            if known := _words(action):
                patterns = "|".join(f'"{words[0]} {flag}"' for flag in action.option_strings)
                values.append(f"        {patterns}) found={_list(known)} ;;")
        if len(words) == 1 and (known := [w for place in _places(parser) for w in _words(place)]):
            places.append(f"                {words[0]}) found={_list(known)} ;;")
    lines = {"values": dict.fromkeys(values), "flags": flags, "places": places}
    return BASH % {"commands": " ".join(commands), **{key: "\n".join(part) for key, part in lines.items()}}


def _fish(commands: Mapping[str, str], tables: Mapping[tuple[str, ...], argparse.ArgumentParser]) -> str:
    lines = [FISH, "complete -c offbench -f"]
    lines += [
        f"complete -c offbench -n __fish_use_subcommand -a {name} -d {_quoted(text)}"
        for name, text in commands.items()
    ]
    lines.append("complete -c offbench -n '__fish_seen_subcommand_from completion' -a 'bash zsh fish'")
    for words, parser in tables.items():
        seen = "; and ".join(f"__fish_seen_subcommand_from {word}" for word in words)
        for action in _options(parser):
            known, name = _words(action), action.option_strings[-1].lstrip("-")
            takes = "" if action.nargs == 0 else f" -x -a {_list(known, fish=True)}" if known else " -r -F"
            text = (action.help or "").replace("%%", "%")
            lines.append(f"complete -c offbench -n '{seen}' -l {name}{takes} -d {_quoted(text)}")
        if known := [word for place in _places(parser) for word in _words(place)]:
            lines.append(f"complete -c offbench -n '{seen}' -a {_list(known, fish=True)}")
        elif _places(parser):
            lines.append(f"complete -c offbench -n '{seen}' -F")
    return "\n".join(dict.fromkeys(lines))


def _options(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    return [action for action in parser._actions if action.option_strings]


def _places(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    return [action for action in parser._actions if not action.option_strings]


def _words(action: argparse.Action) -> Sequence[str]:
    """Return what an argument may be: its choices, or what its name stands for."""
    if action.choices is not None:
        return [str(choice) for choice in action.choices]
    known: dict[str, Sequence[str]] = {
        "env": names(),
        "level": list(LEVELS),
        "algorithm": algorithm_names(),
        "grid": shipped_grids(),
        "dataset": [DATASETS],
        "dataset_id": [DATASETS],
    }
    if action.dest == "dataset_id" and action.option_strings:
        return []  # --id names a new one
    return known.get(action.dest, [])


def _list(words: Iterable[str], fish: bool = False) -> str:
    """Return words as one quoted list that the shell fills in where it must look."""
    text = " ".join(words)
    if DATASETS in text:
        return "'(__offbench_datasets)'" if fish else '"$(_offbench_datasets)"'
    return f"'{text}'"


def _quoted(text: str) -> str:
    """Return text in single quotes; those within it are left out, as shells differ in how to write them."""
    return "'" + text.replace("\\", "\\\\").replace("'", "") + "'"
