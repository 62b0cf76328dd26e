"""Commands `export` and `import-sb3`: agents as archives of Stable-Baselines3, with model cards, and back."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml

from viapoint.training.algorithms.agent import Agent, find_model, load_agent
from viapoint.training.algorithms.model_io import ALGORITHMS, save_model
from viapoint.training.algorithms.sb3_archive import algorithm_of, environment_of, open_archive, write_archive
from viapoint.training.config.checks import DEFAULT_ENV, SHIPPED, check_env
from viapoint.training.config.configs import ExportConfig, ImportConfig, TrainConfig
from viapoint.training.evaluation.evaluator import evaluate
from viapoint.training.evaluation.report import progress_bar
from viapoint.training.io.files import BadFileError, read_json, write_bytes, write_folder
from viapoint.training.io.installed import versions
from viapoint.training.io.model_limits import check_env_arguments
from viapoint.training.io.template import load_template, packaged
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.run_dir import Run

CARD = "README.md"
SHIPPED_SEED = 0
"""Seed of the trainings of the shipped agents."""
WARNING = (
    "{file} is an archive of Stable-Baselines3. Opening one runs whatever code its author put into it, with your "
    "rights. Open only archives that you made or whose author you trust."
)


def export(config: ExportConfig) -> None:
    """Export an agent and print where it is."""
    folder = find_model(config.agent)
    record = read_json(folder / "model.json")
    archive, card = paths(config, record)
    agent = load_agent(folder)
    measured = [*_stored_evaluations(folder, record), *_measured(agent, config.scenes)]
    archive.parent.mkdir(parents=True, exist_ok=True)
    write_archive(agent, archive, record["hyperparameters"])
    license_ = "mit" if config.license is None and folder.parent == SHIPPED else config.license
    text = model_card(record, archive.name, measured, command=_command(folder, record), license_=license_)
    write_bytes(card, text.encode())
    print(f"{record['algorithm']} on {record['env']['id']}: {archive}, card: {card}")
    if not measured:
        print("the card states no success rate; --scenes test measures it")


def paths(config: ExportConfig, record: Mapping[str, Any]) -> tuple[Path, Path]:
    """Return the paths of the archive and of the card."""
    name = f"{record['algorithm']}-{record['env']['id'].replace('/', '-')}.zip"
    archive = config.out if config.out.suffix == ".zip" else config.out / name
    card = archive.parent / CARD
    for path in (archive, card):
        if path.exists():
            raise BadFileError(path, "exists already; name another folder")
    return archive, card


def model_card(
    record: Mapping[str, Any],
    archive: str,
    evaluations: list[dict[str, Any]],
    *,
    command: str | None,
    license_: str | None,
) -> str:
    """Return the card of a model in Markdown, with the header that Hugging Face reads.

    Args:
        record: Content of `model.json`.
        archive: Name of the archive.
        evaluations: Results of evaluations, as `viapoint evaluate --json` writes them.
        command: Command that trained the model; None if it is not known.
        license_: Identifier of the model's licence; None to leave it open.
    """
    name, package = ALGORITHMS[record["algorithm"]].__name__, ALGORITHMS[record["algorithm"]].__module__
    own = package.startswith("viapoint")
    module, more = ("viapoint.training", ", trust=True") if own else (package.partition(".")[0], "")
    env_id = record["env"]["id"]
    header = yaml.safe_dump(_header(name, env_id, evaluations, license_), sort_keys=False, allow_unicode=True)
    written_by = ", ".join(f"{package} {version}" for package, version in versions().items())
    template = load_template(
        packaged("cli/templates/model_card.md.j2"),
        filters={"repr": repr, "percent": lambda rate: f"{100.0 * rate:.1f}"},
    )
    return template.render(
        header=header, name=name, env_id=env_id, record=record, module=module, more=more, archive=archive,
        rows=list(_rows(evaluations)), command=command, versions=written_by,
    )  # fmt: skip


def _header(
    name: str, env_id: str, evaluations: list[dict[str, Any]], license_: str | None
) -> dict[str, Any]:
    """Return the metadata of a card: https://huggingface.co/docs/hub/model-cards."""
    metrics = [
        {
            "type": "success_rate",
            "name": f"success rate, {summary['scenes']} scenes of {each['scenes']}, {method}",
            "value": round(summary["success"]["rate"], 4),
            "verified": False,
        }
        for each, method, summary in _rows(evaluations)
    ]
    task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
    result = {"task": task, "dataset": {"name": env_id, "type": env_id}, "metrics": metrics}
    return {
        "library_name": "stable-baselines3",
        **({} if license_ is None else {"license": license_}),
        "tags": [
            env_id,
            "deep-reinforcement-learning",
            "reinforcement-learning",
            "stable-baselines3",
            "viapoint",
        ],
        **({"model-index": [{"name": name, "results": [result]}]} if metrics else {}),
    }


def _rows(evaluations: list[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], str, dict[str, Any]]]:
    """Yield evaluation, method and summary of each measurement of the agent."""
    for each in evaluations:
        for method, summary in each["methods"].items():
            if method.startswith("agent"):
                yield each, method, summary


def _stored_evaluations(folder: Path, record: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the complete evaluations of a run that measured this model."""
    for path in sorted((folder.parent / "evaluations").glob("*.json")):
        found = read_json(path)
        if found.get("weights_sha256") == record["weights_sha256"] and not found.get("partial", True):
            yield found


def _measured(agent: Agent, scenes: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    for name in scenes:
        with progress_bar() as progress:
            yield evaluate(agent, scenes=name, time_decisions=False, progress=progress).to_dict()


def _command(folder: Path, record: Mapping[str, Any]) -> str | None:
    """Return the command that trained a model; None if it is not known."""
    if folder.parent == SHIPPED:
        return TrainConfig(env=record["env"]["id"], algo=record["algorithm"], seed=SHIPPED_SEED).command
    if (folder.parent / "config.json").is_file():
        return Run(folder.parent).config.command
    return None


class NotTrustedError(Exception):
    """Error of an archive that the user did not allow to open."""


def import_sb3(config: ImportConfig) -> None:
    """Convert an archive and print where the model is."""
    if config.out.exists() and (not config.out.is_dir() or any(config.out.iterdir())):
        raise BadFileError(config.out, "is not empty; name another folder")
    algo = config.algo or algorithm_of(config.file)
    named = environment_of(config.file)
    if named is None or config.env not in (None, named["id"]):
        named = {"id": config.env or DEFAULT_ENV, "kwargs": {}}
    env_id, env_kwargs = named["id"], named["kwargs"]
    check_env(env_id)
    check_env_arguments(env_kwargs)
    print(WARNING.format(file=config.file), file=sys.stderr)
    asks = not config.trust and sys.stdin.isatty()
    if not (config.trust or (asks and input("open it? [yes/no] ").strip().lower() == "yes")):
        raise NotTrustedError(f"{config.file} was not opened; --trust says that it may be")
    model = convert(config.file, algo, env_id, config.out, **env_kwargs)
    print(f"{algo} of {model.num_timesteps} decisions on {env_id}: {config.out}")
    print(f"measure it with: viapoint evaluate {config.out}")


def convert(path: Path, algo: str, env_id: str, out: Path, **env_kwargs: Any) -> Agent:
    """Open an archive, which runs its code, write its model, and return the agent loaded from it.

    Raises:
        BadFileError: The archive cannot be opened, is for another environment, or holds objects of other packages.
    """
    with closing(ViaVecEnv(env_id, 1, **env_kwargs)) as env:
        try:
            model = open_archive(path, ALGORITHMS[algo], env)
            write_folder(out, lambda temporary: save_model(model, temporary))
        except BadFileError:
            raise
        except (ValueError, KeyError) as error:
            raise BadFileError(path, f"holds no plain {algo} model for {env_id}: {error}") from None
    return load_agent(out)
