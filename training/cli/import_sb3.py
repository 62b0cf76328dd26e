"""Command `import-sb3`: convert an archive of Stable-Baselines3 into a model folder."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from typing import Any

from viapoint.training.algorithms.agent import Agent, load_agent
from viapoint.training.algorithms.model_io import ALGORITHMS, save_model
from viapoint.training.algorithms.sb3_archive import algorithm_of, environment_of, open_archive
from viapoint.training.config.checks import DEFAULT_ENV, check_env
from viapoint.training.config.configs import ImportConfig
from viapoint.training.io.files import BadFileError, write_folder
from viapoint.training.io.model_limits import check_env_arguments
from viapoint.training.rollouts.vec_env import ViaVecEnv

WARNING = (
    "{file} is an archive of Stable-Baselines3. Opening one runs whatever code its author put into it, with your "
    "rights. Open only archives that you made or whose author you trust."
)


class NotTrustedError(Exception):
    """Error of an archive that the user did not allow to open."""


def run(config: ImportConfig) -> None:
    """Convert an archive and print where the model is.

    Raises:
        NotTrustedError: `--trust` was not given and the question not answered with yes.
        BadFileError: The file is no such archive, or its model is for another environment; or the folder is in use.
    """
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
