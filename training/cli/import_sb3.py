"""Command `import-sb3`: convert an archive of Stable-Baselines3 into a model folder."""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path
from typing import Any

from viapoint.training.algorithms.agent import Agent, load_agent
from viapoint.training.algorithms.model_io import ALGORITHMS, save_model
from viapoint.training.config.configs import ImportConfig
from viapoint.training.io.files import BadFileError, write_folder
from viapoint.training.rollouts.vec_env import ViaVecEnv

WARNING = (
    "{file} is an archive of Stable-Baselines3. Opening one runs whatever code its author put into it, with your "
    "rights. Open only archives that you made or whose author you trust."
)
LARGEST_DATA = 64 << 20
"""Size of an archive's description at most, [bytes]."""
TELLTALE = {
    "tqc": "top_quantiles_to_drop_per_net",
    "sac": "target_entropy",
    "td3": "policy_delay",
    "ppo": "clip_range",
}
"""Name in the description of each algorithm's archives, and of no algorithm below it."""


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
    print(WARNING.format(file=config.file), file=sys.stderr)
    if not (config.trust or _answered_yes()):
        raise NotTrustedError(f"{config.file} was not opened; --trust says that it may be")
    model = convert(config.file, algo, config.env, config.out)
    print(f"{algo} of {model.num_timesteps} decisions on {config.env}: {config.out}")
    print(f"measure it with: viapoint evaluate {config.out}")


def algorithm_of(path: Path) -> str:
    """Return the algorithm of an archive from the names in its description, without opening its objects.

    Raises:
        BadFileError: The file is no archive of Stable-Baselines3, or of another algorithm.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.getinfo("data").file_size > LARGEST_DATA:
                raise BadFileError(path, f"has a description of more than {LARGEST_DATA} bytes")
            names = set(json.loads(archive.read("data")))
            archive.getinfo("policy.pth")
    except FileNotFoundError:
        raise BadFileError(path, "is missing") from None
    except (OSError, zipfile.BadZipFile, KeyError, TypeError, ValueError, RecursionError) as error:
        raise BadFileError(path, f"is no archive of Stable-Baselines3 ({error})") from None
    for algo, telltale in TELLTALE.items():
        if telltale in names:
            return algo
    raise BadFileError(path, f"is of none of {', '.join(TELLTALE)}")


def convert(path: Path, algo: str, env_id: str, out: Path) -> Agent:
    """Open an archive, which runs its code, write its model, and return the agent loaded from it.

    Raises:
        BadFileError: The archive cannot be opened, is for another environment, or holds objects of other packages.
    """
    kind: Any = ALGORITHMS[algo]
    try:
        small: dict[str, Any] = {} if algo == "ppo" else {"buffer_size": 1}
        model = super(Agent, kind).load(path, device="cpu", **small)
    except Exception as error:  # whatever the archive does
        raise BadFileError(path, f"cannot be opened as {algo} ({type(error).__name__}: {error})") from None
    env = ViaVecEnv(env_id, model.n_envs or 1)
    try:
        model.set_env(env)
        write_folder(out, lambda temporary: save_model(model, temporary))
    except (ValueError, KeyError) as error:
        if isinstance(error, BadFileError):
            raise
        raise BadFileError(path, f"holds no plain {algo} model for {env_id}: {error}") from None
    finally:
        env.close()
    return load_agent(out)


def _answered_yes() -> bool:
    return sys.stdin.isatty() and input("open it? [yes/no] ").strip().lower() == "yes"
