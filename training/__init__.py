"""Agents that learn to place via-points: training, evaluation, and planning.

Names are imported when they are first used, so that importing this package alone is fast.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viapoint.training.algorithms.agent import Agent, load_agent
    from viapoint.training.algorithms.extractors import SceneExtractor
    from viapoint.training.algorithms.viaq import ViaQ
    from viapoint.training.config.configs import TrainConfig
    from viapoint.training.evaluation.evaluator import EvaluationResult, evaluate
    from viapoint.training.live.page import LivePage
    from viapoint.training.rollouts.vec_env import ViaVecEnv
    from viapoint.training.runs.run_dir import Run
    from viapoint.training.runs.trainer import train
    from viapoint.training.search.geometry_search import GeometrySearch
    from viapoint.training.search.observe_candidates import ObserveCandidates, VectorObserveCandidates
    from viapoint.training.study.config import Study
    from viapoint.training.study.run import run_study
else:
    _MODULES = {
        "Agent": "viapoint.training.algorithms.agent",
        "EvaluationResult": "viapoint.training.evaluation.evaluator",
        "GeometrySearch": "viapoint.training.search.geometry_search",
        "ObserveCandidates": "viapoint.training.search.observe_candidates",
        "LivePage": "viapoint.training.live.page",
        "Run": "viapoint.training.runs.run_dir",
        "SceneExtractor": "viapoint.training.algorithms.extractors",
        "Study": "viapoint.training.study.config",
        "TrainConfig": "viapoint.training.config.configs",
        "VectorObserveCandidates": "viapoint.training.search.observe_candidates",
        "ViaQ": "viapoint.training.algorithms.viaq",
        "ViaVecEnv": "viapoint.training.rollouts.vec_env",
        "evaluate": "viapoint.training.evaluation.evaluator",
        "load_agent": "viapoint.training.algorithms.agent",
        "run_study": "viapoint.training.study.run",
        "train": "viapoint.training.runs.trainer",
    }

    def __getattr__(name):
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        try:
            return getattr(importlib.import_module(_MODULES[name]), name)
        except ModuleNotFoundError as error:
            from viapoint.training.cli.doctor import explain_import_error

            raise ImportError(explain_import_error(error, f"viapoint.training.{name}")) from error

    def __dir__():
        return sorted({*globals(), *_MODULES})


__all__ = [
    "Agent",
    "EvaluationResult",
    "GeometrySearch",
    "LivePage",
    "ObserveCandidates",
    "Run",
    "SceneExtractor",
    "Study",
    "TrainConfig",
    "VectorObserveCandidates",
    "ViaQ",
    "ViaVecEnv",
    "evaluate",
    "load_agent",
    "run_study",
    "train",
]
