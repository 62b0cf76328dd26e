"""Agents that learn to place via-points: training, evaluation, and planning.

Names are imported when they are first used, so that importing this package alone is fast.
"""

from typing import TYPE_CHECKING

from viapoint.primitives._lazy import lazy_imports

if TYPE_CHECKING:
    from viapoint.training.agents.agent import Agent, load_agent
    from viapoint.training.agents.extractors import SceneExtractor
    from viapoint.training.agents.viaq import ViaQ
    from viapoint.training.agents.viarank import ViaRank
    from viapoint.training.configs import TrainConfig
    from viapoint.training.evaluation import EvaluationResult, evaluate
    from viapoint.training.live.page import LivePage
    from viapoint.training.planning.export import read_motion, write_motion
    from viapoint.training.planning.motion_plan import MotionPlan, UnsafePlanError
    from viapoint.training.planning.plan_motion import plan_motion, plan_motions
    from viapoint.training.planning.search import GeometrySearch
    from viapoint.training.runs import Run
    from viapoint.training.study import Study, run_study
    from viapoint.training.trainer import train
    from viapoint.training.vec_env import ViaVecEnv
else:
    _get, __dir__ = lazy_imports(__name__)

    def __getattr__(name):
        try:
            return _get(name)
        except ModuleNotFoundError as error:
            from viapoint.training.extras import explain_import_error

            raise ImportError(explain_import_error(error, f"viapoint.training.{name}")) from error


__all__ = [
    "Agent",
    "EvaluationResult",
    "GeometrySearch",
    "LivePage",
    "MotionPlan",
    "Run",
    "SceneExtractor",
    "Study",
    "TrainConfig",
    "UnsafePlanError",
    "ViaQ",
    "ViaRank",
    "ViaVecEnv",
    "evaluate",
    "load_agent",
    "plan_motion",
    "plan_motions",
    "read_motion",
    "run_study",
    "train",
    "write_motion",
]
