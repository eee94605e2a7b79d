"""Reference of the command line, generated from the commands."""

import re
from typing import Any

import typer

from ltsim.cli.main import COMMANDS, app


def verbs() -> str:
    """Markdown with a section per command, with its arguments and options."""
    group: Any = typer.main.get_command(app)
    context = group.make_context("ltsim", ["--help"], resilient_parsing=True)
    lines: list[str] = []
    for name in COMMANDS:
        lines += _verb(name, group.get_command(context, name), context)
    return "\n".join(lines)


def _verb(name: str, command: Any, above: Any) -> list[str]:
    context = type(above)(command, info_name=name, parent=above)
    usage = " ".join(command.collect_usage_pieces(context))
    text, _, example = (command.help or "").strip().partition("Example: ")
    lines = ["", f"## ltsim {name}", "", *(_plain(line) for line in text.strip().splitlines()), ""]
    lines += ["```text", f"ltsim {name} {usage}", "```", ""]
    if example:
        lines += ["Example:", "", "```text", " ".join(example.split()), "```", ""]
    rows = [record for record in (p.get_help_record(context) for p in command.get_params(context)) if record]
    lines += ["| argument or option | meaning |", "|---|---|"]
    lines += [f"| `{_cell(what)}` | {_plain(_cell(meaning))} |" for what, meaning in rows]
    return lines


def _cell(text: str) -> str:
    text = re.sub(r"<(int|float) range>", "N", text).replace(" <str>", "").replace(" <path>", "")
    return " ".join(text.split()).replace("|", "\\|")


def _plain(text: str) -> str:
    """Text with escaped Markdown characters, except those of code."""
    return re.sub(r"([*_<\[])(?![^`]*`(?:[^`]*`[^`]*`)*[^`]*$)", r"\\\1", text)
