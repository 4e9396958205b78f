"""Command line of ``napari-hmrf``: its options and help are made from the classes of `commands`.

The help imports only the standard library. The module `run`, which imports the solver, is imported
when a command runs.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from collections.abc import Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin

import napari_hmrf
from napari_hmrf import commands
from napari_hmrf.arguments import did_you_mean
from napari_hmrf.errors import ArgumentError
from napari_hmrf.io import case_options
from napari_hmrf.solver.model_names import as_word

#: Types that the annotations of options name.
_TYPES = vars(case_options) | vars(commands)
#: Message of argparse about an unknown command: the argument, the word, and the known words.
_CHOICE = re.compile(r"(.*?)invalid choice: '?([^' ]*)'? \(choose from (.*)\)$", re.DOTALL)
#: Entry of a docstring: the names of fields, their type, and the text.
_ENTRY = re.compile(r"^(\w[\w, ]*)(?: : .*)?\n((?:    .*(?:\n|$))+)", re.M)


class _Parser(argparse.ArgumentParser):
    """Parser whose errors are one sentence, with a suggestion for a misspelt word."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        options, rest = self.parse_known_args(args, namespace)
        if rest:
            wrong = next((word for word in rest if word.startswith("-")), rest[0])
            known = [*options.parser._option_string_actions]
            hint = did_you_mean(wrong.partition("=")[0], known) if wrong.startswith("-") else ""
            options.parser.error(f"unrecognized argument {wrong}.{hint}")
        return options

    def error(self, message: str) -> NoReturn:
        choice = _CHOICE.match(message)
        if choice is not None:
            hint = did_you_mean(choice[2], re.findall(r"[\w.-]+", choice[3]))
            message = f"{choice[1]}there is no {choice[2]!r}.{hint} Choose from {choice[3]}."
        self.exit(2, f"{self.prog}: error: {message}\nSee {self.prog} --help for all options.\n")


class _Formatter(argparse.HelpFormatter):
    """Help formatter that does not wrap the example, so that the user can copy it."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("example: ") else super()._fill_text(text, width, indent)


def parser_of_commands() -> argparse.ArgumentParser:
    """Return the parser for all commands, which stores the class of a command as `command`."""
    parser = _Parser(
        prog="napari-hmrf",
        description="Compute the deformation of soft tissue on the pixel grid of an image.",
        epilog="napari-hmrf COMMAND --help describes a command and shows an example.",
    )
    version = f"napari-hmrf {napari_hmrf.__version__}"
    parser.add_argument("--version", action="version", version=version)
    added = parser.add_subparsers(required=True, metavar="COMMAND")
    for kind in commands.COMMANDS:
        text, _, example = _sections(kind)
        sentence = text.partition("\n\n")[0].rstrip(".")
        command = added.add_parser(
            kind.__name__.lower(),
            help=f"{sentence[0].lower()}{sentence[1:]}",
            description=_in_shell(kind, text),
            epilog=f"example: {example}",
            formatter_class=_Formatter,
            argument_default=argparse.SUPPRESS,
        )
        command.set_defaults(command=kind, parser=command)
        help_of = _help_of(kind)
        for each in fields(kind):
            text = _in_shell(kind, help_of[each.name]).replace("%", "%%")
            _add_option(command, each, text)
    return parser


def _add_option(command: argparse.ArgumentParser, option: Field[Any], text: str) -> None:
    """Add an option; its value is text, and is converted when the command runs."""
    is_list, content = re.findall(r"^(tuple\[)?(\w+)", str(option.type))[0]
    type_of = _TYPES.get(content)
    words = [as_word(word) for word in get_args(type_of)] if get_origin(type_of) is Literal else []
    more: dict[str, Any] = {"nargs": "+"} if is_list else {}
    if _is_argument(option):
        command.add_argument(option.name, metavar=option.name.upper(), help=text, **more)
        return
    if option.default not in (MISSING, None, False, ()):
        text = f"{text.rstrip('.')} (default: {option.default})"
    names = ["-o"] if option.name == "out" else []
    if option.metadata.get("flags"):
        group = command.add_mutually_exclusive_group()
        for word in words:
            group.add_argument(
                f"--{word}", action="store_const", const=word, dest=option.name, help=text
            )
    elif content == "Flag":
        command.add_argument(_option(option.name), action="store_true", help=text)
    else:
        is_file = isinstance(type_of, type) and issubclass(type_of, Path | str)
        metavar = f"{{{','.join(words)}}}" if words else content if is_file else option.name
        more["metavar"] = metavar if words else metavar.upper()
        required = option.default is MISSING
        command.add_argument(*names, _option(option.name), required=required, help=text, **more)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _sections(kind: type) -> tuple[str, str, str]:
    """Return the description, the entries of the fields and the example of a docstring."""
    text, _, example = inspect.cleandoc(kind.__doc__ or "").partition("\n\nExamples\n--------\n")
    description, _, entries = text.partition("\n\nAttributes\n----------\n")
    return description, entries, example


def _help_of(kind: type) -> dict[str, str]:
    """Return the help of each field, also of those of the base classes."""
    return {
        name: text
        for each in reversed(kind.__mro__[:-1])
        for names, text in _ENTRY.findall(_sections(each)[1])
        for name in names.split(", ")
    }


def _in_shell(kind: type, text: str) -> str:
    """Return text of a docstring on one line, in which a field has its name in the shell."""
    arguments = {each.name for each in fields(kind) if _is_argument(each)}

    def name_of(match: re.Match[str]) -> str:
        return match[1].upper() if match[1] in arguments else _option(match[1])

    return re.sub(r"`(\w+)`", name_of, " ".join(text.split()))


def _is_argument(option: Field[Any]) -> bool:
    """Return whether a field is an argument, which is given by position."""
    return option.default is MISSING and not option.kw_only


def read_command(arguments: Sequence[str] | None = None) -> Any:
    """Return the command, one of `commands.COMMANDS`, that is given by arguments of the shell.

    An invalid argument ends the process with exit code 2, and help with 0.
    """
    texts = vars(parser_of_commands().parse_args(arguments))
    command, parser = texts.pop("command"), texts.pop("parser")
    from napari_hmrf.io.option_texts import values_of  # heavy: pydantic

    try:
        return command(**values_of(command, texts, _option))
    except ArgumentError as error:
        parser.error(f"{error}.")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments after ``napari-hmrf``; by default those in `sys.argv`.

    Returns
    -------
    int
        Exit code: 0 on success, 1 on failure, 130 after an interrupt.
    """
    command = read_command(arguments)
    from napari_hmrf.run import run_and_report  # heavy: the solver

    return run_and_report(command)


if __name__ == "__main__":
    sys.exit(main())
