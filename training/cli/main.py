"""Command `viapoint`."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
import os
import re
import sys
from collections.abc import Sequence
from typing import Any

import tyro

from viapoint.training.cli.doctor import explain_import_error
from viapoint.training.config import configs
from viapoint.training.config.checks import unknown_name
from viapoint.training.config.configs import REGISTRY


class UsageError(ValueError):
    """Error of an invalid command line; the message is one line."""


COMMANDS: dict[str, tuple[type[Any], str]] = {
    "train": (configs.TrainConfig, "cli.commands:train"),
    "evaluate": (configs.EvaluateConfig, "cli.commands:evaluate"),
    "plan": (configs.PlanConfig, "cli.plan:run"),
    "play": (configs.PlayConfig, "cli.commands:play"),
    "record": (configs.RecordConfig, "cli.commands:record"),
    "fit": (configs.FitConfig, "cli.fit:run"),
    "paper": (configs.PaperConfig, "paper.run:run"),
    "demo": (configs.DemoConfig, "cli.demo:run"),
    "study": (configs.StudyConfig, "study.run:run"),
    "live": (configs.LiveConfig, "live.page:run"),
    "doctor": (configs.DoctorConfig, "cli.doctor:run"),
}
"""Configuration and function of each subcommand; the function is imported when it is called."""
OVERVIEW = """usage: viapoint COMMAND [OPTIONS]

Agents that reach around obstacles by placing via-points of minimum-jerk
movements.

{commands}

viapoint COMMAND --help shows the options of a command and an example;
--debug shows where an error came from."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a subcommand; errors print one line to the standard error output and exit with code 2."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    try:
        config = parse(words)
        if isinstance(config, configs.TrainConfig) and config.resume:
            _check_resumed(config, words)
        run_command(config)
    except KeyboardInterrupt:
        _leave("stopped", 130)
    except BrokenPipeError:  # nobody reads the output any more, as in `viapoint --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    except Exception as error:
        if debug:
            raise
        _leave(_one_line(error), getattr(error, "exit_code", 2))


def run_command(config: Any) -> None:
    """Run the subcommand of a configuration."""
    place = next(place for kind, place in COMMANDS.values() if type(config) is kind)
    module, function = place.split(":")
    getattr(importlib.import_module(f"viapoint.training.{module}"), function)(config)


def parse(words: Sequence[str], usual: Any = None) -> Any:
    """Return the configuration that a command line stands for, with defaults of `usual` where it is given.

    Raises:
        SystemExit: Help was asked for; code 0.
        UsageError: A word is not understood or not allowed.
    """
    if words and words[0] in ("-h", "--help"):
        lines = [f"  {name:<10}{str(kind.__doc__).splitlines()[0]}" for name, (kind, _) in COMMANDS.items()]
        print(OVERVIEW.format(commands="\n".join(lines)))
        raise SystemExit(0)
    if not words:
        raise UsageError(f"name a command: {', '.join(COMMANDS)} (viapoint --help)")
    command, *options = words
    if command not in COMMANDS:
        raise UsageError(unknown_name("command", command, COMMANDS))
    kind, _ = COMMANDS[command]
    default = {} if usual is None else {"default": usual}
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, prog=f"viapoint {command}", args=options, registry=REGISTRY, **default)
    except SystemExit as end:
        if not end.code:
            raise
        raise UsageError(_complaint(complaint.getvalue(), command, kind)) from None


def _check_resumed(config: configs.TrainConfig, words: Sequence[str]) -> None:
    """Check that flags equal those of the run to resume, including flags with default values."""
    from viapoint.training.runs.run_dir import Run, check_unchanged

    run = Run(config.folder)
    usual = dataclasses.replace(run.config, out=config.out, resume=True)
    check_unchanged(run, parse(words, usual), usual)


def _complaint(text: str, command: str, kind: type[Any]) -> str:
    """Return the words in tyro's boxes in one line, and fields by their flags.

    Where the output knows only ASCII, there is no frame, and a rule follows the title.
    """
    lines = [line.strip("│╭╮╰╯─ ") for line in text.splitlines() if not line.startswith(("╭", "╰"))]
    if "╭" not in text:
        rule = next((i for i, line in enumerate(lines) if line and not line.strip("-")), -1)
        lines = lines[rule + 1 :]
    said = " ".join(line for line in lines if line.strip("-")) or text
    said = re.sub(
        rf"^Error parsing ({kind.__name__}: )?|( Argument helptext: .*)? For full helptext, .*", "", said
    )
    for each in dataclasses.fields(kind):
        said = re.sub(rf"^{each.name}\b", f"--{each.name.replace('_', '-')}", said)
    return f"{said} (viapoint {command} --help)"


def _one_line(error: Exception) -> str:
    if isinstance(error, ImportError):
        return explain_import_error(error)
    known = isinstance(error, ValueError | OSError) or type(error).__module__.startswith(
        ("viapoint", "gymnasium")
    )
    text = " ".join(str(error).split()) or type(error).__name__
    return text if known else f"{type(error).__name__}: {text} (--debug shows where)"


def _leave(message: str, code: int) -> None:
    print(f"viapoint: {message}", file=sys.stderr)
    raise SystemExit(code)
