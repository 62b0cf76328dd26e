"""Command `viapoint`, which imports packages of the extra `training` only where it needs them."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import io
import os
import re
import sys
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from viapoint.training.cli import doctor
from viapoint.training.extras import explain_import_error

if TYPE_CHECKING:
    from viapoint.training.configs import TrainConfig


# Module and function of each subcommand, whose configuration is `TrainConfig`, `EvaluateConfig` and so on
COMMANDS = {
    "train": "cli.commands:train",
    "evaluate": "cli.commands:evaluate",
    "plan": "cli.plan:run",
    "play": "cli.commands:play",
    "record": "cli.commands:record",
    "fit": "cli.fit:run",
    "paper": "paper.run:run",
    "demo": "cli.demo:run",
    "study": "study:run",
    "live": "live.page:run",
    "doctor": "cli.doctor:run",
}
OVERVIEW = """usage: viapoint COMMAND [OPTIONS]

Smooth movements of robot arms around obstacles, through via-points: planned
in milliseconds, or learned in Gymnasium.

{commands}

viapoint COMMAND --help shows the options of a command and an example;
--debug shows where an error came from."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a subcommand; warnings and errors are lines on the standard error output, errors exit with code 2."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    usual = warnings.formatwarning
    if not debug:
        warnings.formatwarning = lambda message, *_: f"warning: {_with_flags(str(message), words)}\n"
    if sys.stdout is None:  # it was closed, as by `>&-`
        sys.stdout = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names that a terminal without UTF-8 cannot show
    try:
        try:
            config = parse(words)
            if words[0] == "train" and config.resume:
                _check_resumed(config, words)
            run_command(config)
        finally:
            warnings.formatwarning = usual
            sys.stdout.flush()  # at Python's exit, a closed pipe would print a message
    except KeyboardInterrupt:
        _leave("stopped", 130)
    except BrokenPipeError:  # nobody reads the output any more, as in `viapoint --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python writes the rest at its exit
        raise SystemExit(141) from None
    except Exception as error:
        if _was_interrupted(error):
            _leave("stopped", 130)
        if isinstance(error, ImportError) and words[:1] == ["doctor"]:
            # It says what is missing, without the package that reads options.
            doctor.run(None)
        if debug:
            raise
        _leave(_with_flags(_one_line(error), words), getattr(error, "exit_code", 2))


def run_command(config: Any) -> None:
    """Run the subcommand of a configuration."""
    module, function = COMMANDS[type(config).__name__.removesuffix("Config").lower()].split(":")
    getattr(importlib.import_module(f"viapoint.training.{module}"), function)(config)


def parse(words: Sequence[str], usual: Any = None) -> Any:
    """Return the configuration that a command line stands for, with defaults of `usual` where it is given.

    Raises:
        SystemExit: Help or the version was asked for; code 0.
        ValueError: A word is not understood or not allowed.
    """
    if words[:1] == ["--version"]:
        print(f"viapoint {importlib.metadata.version('viapoint')}")
        raise SystemExit(0)
    import tyro

    from viapoint.training import checks, configs

    kinds = {name: getattr(configs, f"{name.capitalize()}Config") for name in COMMANDS}
    if not words or words[0] in ("-h", "--help", "help"):
        lines = [f"  {name:<10}{str(kind.__doc__).splitlines()[0]}" for name, kind in kinds.items()]
        print(OVERVIEW.format(commands="\n".join(lines)))
        raise SystemExit(0)
    command, *options = words
    if command not in COMMANDS:
        raise ValueError(f"{checks.unknown_name('command', command, COMMANDS)} (viapoint --help)")
    kind = kinds[command]
    flags = [word.partition("=")[0].replace("_", "-") for word in options if word.startswith("--")]
    for each in dataclasses.fields(kind):
        flag = f"--{each.name.replace('_', '-')}"
        several = isinstance(each.default, tuple) or each.default_factory is dict
        if several and flags.count(flag) > 1:  # the last one alone would count
            raise ValueError(f"{flag} is there twice; all its values follow one of them")
    if issubclass(kind, configs.AgentConfig):
        options = _agent_first(options)
    settings: dict[str, Any] = {"prog": f"viapoint {command}", "registry": configs.REGISTRY}
    if usual is not None:
        settings["default"] = usual
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, args=options, **settings)
    except SystemExit as end:
        if not end.code:
            raise
        raise ValueError(_complaint(complaint.getvalue(), command, kind)) from None


def _agent_first(options: Sequence[str]) -> list[str]:
    """Return options with the agent at the front, a word by its place, which --agent NAME or --agent=NAME may name."""
    words: list[str] = []
    for word in options:
        words += word.split("=", 1) if word.startswith("--agent=") else [word]
    if "--agent" not in words:
        return words
    place = words.index("--agent")
    name = words[place + 1 : place + 2]
    if name in ([], [""]) or name[0].startswith("-"):
        raise ValueError("--agent needs a name: a run folder, a model folder or the id of an environment")
    return [*name, *words[:place], *words[place + 2 :]]


def _check_resumed(config: TrainConfig, words: Sequence[str]) -> None:
    """Check that flags equal those of the run to resume, including flags with default values."""
    from viapoint.training.runs import Run, check_unchanged

    run = Run(config.folder)
    usual = dataclasses.replace(run.config, out=config.out, resume=True)
    check_unchanged(run, parse(words, usual), usual)


def _complaint(text: str, command: str, kind: type[Any]) -> str:
    """Return what tyro says below a title, in a frame or in ASCII, as one line with the flags of fields."""
    _, _, body = re.sub(r"\x1b\[[0-9;]*m", "", text).strip().partition("\n")  # without colours
    said = " ".join(re.sub("[│╰╯─]|-{3,}", " ", body).split())
    said = re.sub(rf"^Error parsing ({kind.__name__}: )?", "", said)
    said = re.sub("( Argument helptext: .*)? For full helptext, .*", "", said)
    for each in dataclasses.fields(kind):
        if re.match(rf"(--)?{each.name.replace('_', '[-_]')}\b", said):
            said = re.sub(rf"^{each.name}\b", f"--{each.name.replace('_', '-')}", said)
            numbers = "whole numbers" if "int" in str(each.type) else "numbers"
            said = said.replace("Could not find valid parse for arguments:", f"must be {numbers}, got")
    return f"{said} (viapoint {command} --help)"


def _one_line(error: Exception) -> str:
    if isinstance(error, ImportError):
        return explain_import_error(error)
    kind = type(error)
    text = " ".join(str(error).split()) or kind.__name__
    if isinstance(error, ValueError | OSError) or kind.__module__.startswith(("viapoint", "gymnasium")):
        return text
    return f"{kind.__name__}: {text} (--debug shows where)"


def _with_flags(text: str, words: Sequence[str]) -> str:
    """Return a message to `plan` with flags in place of arguments of load_arm, as in `name one with tool=`."""
    flags = re.sub(r"\b([a-z_]+)=(?=[\s,;]|$)", lambda name: f"--{name[1].replace('_', '-')}", text)
    return flags if words[:1] == ["plan"] else text


def _was_interrupted(error: BaseException | None) -> bool:
    """Return True if an error came up while a library handled Ctrl-C, as Numba's do while they load code."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _leave(message: str, code: int) -> None:
    print(f"viapoint: {message}", file=sys.stderr)
    raise SystemExit(code)


if __name__ == "__main__":
    main()
