# SPDX-License-Identifier: Apache-2.0
"""Classes of the program and its commands: quick help by panel, and rejection of numbers that are
not finite.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import typer
from typer.core import TyperCommand, TyperGroup

HELP_OPTIONS = {"help_option_names": ["-h", "--help"]}


class FiniteCommand(TyperCommand):
    """A command that rejects NaN and infinity in every numeric option; typer's range checks let
    them pass.
    """

    def invoke(self, ctx: Any) -> Any:
        for param in self.params:
            value = ctx.params.get(param.name)
            values = cast("Sequence[Any]", value if isinstance(value, list | tuple) else [value])
            if any(isinstance(v, float) and not math.isfinite(v) for v in values):
                text = "must be a finite number"
                raise typer.BadParameter(text, ctx=ctx, param=param)  # type: ignore[arg-type]
        return super().invoke(ctx)


class ProgramHelp(TyperGroup):
    """The program: lists its commands by panel. Prints ``COMMAND … --help`` before typer prepares
    to parse values, which would load pydantic.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        own = args[: args.index("--")] if "--" in args else args
        command = self.get_command(ctx, args[0]) if args else None
        if command is not None and not ctx.resilient_parsing and {"-h", "--help"} & set(own):
            inner = command.context_class(
                command, info_name=args[0], parent=ctx, **(command.context_settings or {})
            )
            typer.echo(command.get_help(inner))
            ctx.exit()
        return super().parse_args(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each command with the first sentence of its help, one section per panel."""
        for panel, commands in panels_of(self).items():
            with formatter.section(panel):
                formatter.write_dl([(name, first_sentence(c.help)) for name, c in commands.items()])


def panels_of(program: Any) -> dict[str, dict[str, Any]]:
    """Return the commands of the program by panel, in the order of the help."""
    panels: dict[str, dict[str, Any]] = {}
    for name, command in program.commands.items():
        panels.setdefault(str(getattr(command, "rich_help_panel", "")), {})[name] = command
    return panels


def first_sentence(text: str | None) -> str:
    """Return the first sentence of a docstring, without its full stop."""
    line = inspect.cleandoc(text or "").partition("\n\n")[0].replace("\n", " ")
    return line.partition(". ")[0].removesuffix(".")


def add_command(app: typer.Typer, function: Callable[..., None], **options: Any) -> None:
    """Add a function to a program as a command."""
    app.command(cls=FiniteCommand, context_settings=HELP_OPTIONS, **options)(function)
