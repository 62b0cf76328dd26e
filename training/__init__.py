"""Agents that learn to place via-points: training, evaluation, and planning.

Names are imported when they are first used, so that importing this package alone is fast.
"""

from typing import TYPE_CHECKING

from viapoint.primitives._lazy import lazy_imports

if TYPE_CHECKING:
    from viapoint.training.agents.agent import Agent as Agent
    from viapoint.training.agents.agent import load_agent as load_agent
    from viapoint.training.agents.extractors import SceneExtractor as SceneExtractor
    from viapoint.training.agents.viaq import ViaQ as ViaQ
    from viapoint.training.agents.viarank import ViaRank as ViaRank
    from viapoint.training.configs import TrainConfig as TrainConfig
    from viapoint.training.evaluation import EvaluationResult as EvaluationResult
    from viapoint.training.evaluation import evaluate as evaluate
    from viapoint.training.live.page import LivePage as LivePage
    from viapoint.training.planning.export import read_motion as read_motion
    from viapoint.training.planning.export import write_motion as write_motion
    from viapoint.training.planning.motion_plan import MotionPlan as MotionPlan
    from viapoint.training.planning.motion_plan import UnsafePlanError as UnsafePlanError
    from viapoint.training.planning.plan_motion import plan_motion as plan_motion
    from viapoint.training.planning.plan_motion import plan_motions as plan_motions
    from viapoint.training.planning.search import GeometrySearch as GeometrySearch
    from viapoint.training.runs import Run as Run
    from viapoint.training.scene_sets import FrozenScenes as FrozenScenes
    from viapoint.training.study import Study as Study
    from viapoint.training.study import run_study as run_study
    from viapoint.training.trainer import train as train
    from viapoint.training.vec_env import ViaVecEnv as ViaVecEnv
else:
    _get, __dir__, __all__ = lazy_imports(__name__)

    def __getattr__(name):
        try:
            return _get(name)
        except ModuleNotFoundError as error:
            from viapoint.training.extras import explain_import_error

            raise ImportError(explain_import_error(error, f"viapoint.training.{name}")) from error
