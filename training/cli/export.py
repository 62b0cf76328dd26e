"""Command `export`: write an agent as an archive of Stable-Baselines3 with a model card for Hugging Face."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from viapoint.training.algorithms.agent import Agent, find_model, load_agent
from viapoint.training.algorithms.sb3_archive import write_archive
from viapoint.training.cli.progress import progress_bar
from viapoint.training.config.checks import SHIPPED
from viapoint.training.config.configs import ExportConfig, TrainConfig
from viapoint.training.evaluation.evaluator import evaluate
from viapoint.training.io.files import BadFileError, read_json, write_bytes
from viapoint.training.io.installed import versions
from viapoint.training.runs.run_dir import Run

CARD = "README.md"
SHIPPED_SEED = 0
"""Seed of the trainings of the shipped agents."""
CLASSES = {
    "viaq": ("viapoint.training", "ViaQ", ", trust=True"),
    "sac": ("stable_baselines3", "SAC", ""),
    "td3": ("stable_baselines3", "TD3", ""),
    "ppo": ("stable_baselines3", "PPO", ""),
    "tqc": ("sb3_contrib", "TQC", ""),
}
"""Module and name of the class that loads the archives of each algorithm, and its further arguments."""


def run(config: ExportConfig) -> None:
    """Export an agent and print where it is.

    Raises:
        ValueError: There is no such agent, or no such scenes for it.
        BadFileError: The archive or the card exists already.
    """
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
    """Return the paths of the archive and of the card.

    Raises:
        BadFileError: One of them exists already.
    """
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
    algo, env_id, kwargs = record["algorithm"], record["env"]["id"], record["env"]["kwargs"]
    module, name, more = CLASSES[algo]
    header = yaml.safe_dump(_header(name, env_id, evaluations, license_), sort_keys=False, allow_unicode=True)
    arguments = "".join(f", {argument}={value!r}" for argument, value in kwargs.items())
    lines = [
        f"# {name} on {env_id}",
        "",
        f"An agent for an arm that reaches around obstacles, in the environment `{env_id}` of the Python package "
        f"viapoint. The agent was trained with {record['num_timesteps']} decisions.",
        "",
        "## Use",
        "",
        "Opening an archive of Stable-Baselines3 runs code from it. viapoint must be installed.",
        "",
        "```python",
        "import gymnasium as gym",
        f"from {module} import {name}",
        "",
        f'env = gym.make("viapoint.envs:{env_id}"{arguments})',
        f'agent = {name}.load("{archive}"{more})',
        "observation, _ = env.reset(seed=0)",
        "action, _ = agent.predict(observation, deterministic=True)",
        "```",
        "",
        f"`viapoint import-sb3 {archive} --out FOLDER` converts it to a model without pickled objects.",
        "",
        *_table(evaluations),
        "## Training",
        "",
        f"```sh\n{command}\n```" if command else "The command that trained the agent is not known.",
        "",
        f"SHA-256 of the weights (`weights.safetensors` of the model folder): `{record['weights_sha256']}`",
        "",
        f"Written by {', '.join(f'{package} {version}' for package, version in versions().items())}.",
        "",
    ]
    return f"---\n{header}---\n\n" + "\n".join(lines)


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


def _table(evaluations: list[dict[str, Any]]) -> list[str]:
    rows = [
        f"| {each['scenes']} (sha256 `{each['sha256'][:12]}`) | {summary['scenes']} | {method} "
        f"| {100.0 * summary['success']['rate']:.1f} % "
        f"({100.0 * summary['success']['low']:.1f}-{100.0 * summary['success']['high']:.1f}) "
        f"| {100.0 * summary['collision']['rate']:.1f} % |"
        for each, method, summary in _rows(evaluations)
    ]
    if not rows:
        return []
    return [
        "## Results", "",
        "Brackets hold the 95 % interval. With N checks, the agent computes the exact clearance of N proposals.", "",
        "| scene set | scenes | method | success | collision |", "|---|---|---|---|---|", *rows, "",
    ]  # fmt: skip


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
