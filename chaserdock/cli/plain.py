"""The group of verbs whose ``--help`` loads nothing but typer, and says what each verb does in a whole sentence."""

from __future__ import annotations

import inspect
from typing import Any

import typer
from typer.core import TyperGroup


class PlainGroup(TyperGroup):
    """Answers ``VERB … --help`` before typer prepares to check any value, for which it would load pydantic."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        own = args[: args.index("--")] if "--" in args else args
        command = self.get_command(ctx, args[0]) if args else None
        if command is not None and "--help" in own and not ctx.resilient_parsing:
            below = command.context_class(command, info_name=args[0], parent=ctx)
            if isinstance(command, PlainGroup) and args[1] in command.commands:
                command.parse_args(below, args[1:])
            typer.echo(command.get_help(below))
            ctx.exit()
        return super().parse_args(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Every verb with the first sentence of what it says of itself, in the order they were added."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, first_sentence(c.help)) for name, c in self.commands.items()])


def first_sentence(text: str | None) -> str:
    """The first sentence of a docstring, without its full stop."""
    line = inspect.cleandoc(text or "").partition("\n\n")[0].replace("\n", " ")
    return line.partition(". ")[0].removesuffix(".")
