"""Laws of decisions made by machine code: they are the same, and never outlive the weights they were made of."""

import copy

import numpy as np
import pytest
import torch

from viapoint.training import cli, compiled, graphs
from viapoint.training.commands import find_agent
from viapoint.training.compiled import CannotCompileError, require_compiler
from viapoint.training.features import foresee
from viapoint.training.frozen_scenes import load
from viapoint.training.online_trial import new_trial
from viapoint.training.policies import ViaPolicy

PLANAR = "viapoint/PlanarReach-v0"
ALL = (
    PLANAR,
    "viapoint/PlanarObstacles-v0",
    "viapoint/PlanarWholeArm-v0",
    "viapoint/PlanarMovingObstacles-v0",
    "viapoint/PandaReach-v0",
)
NUMBER = 40


def compiler():
    try:
        require_compiler()
    except CannotCompileError:
        return False
    return True


needs_compiler = pytest.mark.skipif(not compiler(), reason="there is no C++ compiler")


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def agent_and_scenes(env_id):
    """A trained agent, and what it sees of some scenes."""
    model = find_agent(None, env_id).model
    trial = new_trial(env_id, NUMBER)
    observation = trial.observe(load("validation", env_id).scenes.take(slice(0, NUMBER)))
    trial.close()
    return model, {name: np.array(part) for name, part in observation.items()}


def one_by_one(model, observation):
    rows = range(len(observation["hand"]))
    each = [{name: part[i : i + 1] for name, part in observation.items()} for i in rows]
    return np.concatenate([model.predict(one, deterministic=True)[0] for one in each])


@pytest.mark.parametrize("candidates", [0, 16])
@pytest.mark.parametrize("env_id", ALL)
def test_in_a_graph_the_same_is_decided(env_id, candidates):
    model, observation = agent_and_scenes(env_id)
    model.policy.candidates = candidates
    plain, _ = model.predict(observation, deterministic=True)
    with graphs.drawn():
        drawn, _ = model.predict(observation, deterministic=True)
    far = np.abs(drawn - plain).max(axis=-1) > 1e-4
    assert far.mean() <= 0.05, "but where two movements are worth the same"


def test_via_points_on_the_ends_are_no_trouble_in_a_graph():
    model, observation = agent_and_scenes(PLANAR)
    task, scene = model.policy.task, {name: torch.as_tensor(part) for name, part in observation.items()}
    actions = torch.zeros((NUMBER, 2, task.action.size))
    distance = (scene["goal"] - scene["hand"]).norm(dim=-1)
    actions[:, 0, 0], actions[:, 1, 0] = (sign * distance / 2 / task.action.via_scale[0] for sign in (-1, 1))
    with graphs.drawn():
        assert torch.isfinite(foresee(scene, actions, task).vector()).all()


@needs_compiler
def test_machine_code_decides_the_same_in_single_scenes_until_a_weight_changes(tmp_path, monkeypatch):
    trained, observation = agent_and_scenes(PLANAR)
    torch.manual_seed(0)
    spaces, task = (trained.observation_space, trained.action_space), trained.policy.task
    policy = ViaPolicy(*spaces, lambda _: 1e-3, task=task.as_dict(), width=16, rounds=1, heads=4)
    torch.nn.init.normal_(policy.actor.step.weight, std=0.1)
    before = one_by_one(policy, observation)
    policy.compile_decisions(keep=tmp_path / "code")
    calls, made = [], policy._compiled[0]
    policy._compiled[0] = Counted(made, calls)
    np.testing.assert_allclose(one_by_one(policy, observation), before, atol=1e-5)
    assert len(calls) == NUMBER
    np.testing.assert_allclose(policy.predict(observation)[0], before, atol=1e-5)
    alone = {name: part[0] for name, part in observation.items()}
    np.testing.assert_allclose(policy.predict(alone)[0], before[0], atol=1e-5)
    with pytest.raises(ValueError, match="mixing Gym API"):
        policy.predict((alone, {}))
    np.testing.assert_allclose(one_by_one(copy.deepcopy(policy), observation), before, atol=1e-5)
    assert len(calls) == NUMBER + 1, "many scenes at once, and copies, are not its business"
    again = copy.deepcopy(policy)
    with monkeypatch.context() as without:
        without.setattr(compiled, "require_compiler", no_compiler)
        again.compile_decisions(keep=tmp_path / "code")
        np.testing.assert_array_equal(again.predict(alone)[0], policy.predict(alone)[0])
        with pytest.raises(CannotCompileError):
            again.compile_decisions(candidates=3, keep=tmp_path / "code")
    (kept,) = (tmp_path / "code").iterdir()
    kept.write_bytes(kept.read_bytes()[:1000])
    with pytest.raises(ValueError, match="is no machine code that can be loaded; delete it"):
        copy.deepcopy(policy).compile_decisions(keep=tmp_path / "code")
    with torch.no_grad():
        policy.actor.step.bias += 0.3
    assert np.abs(one_by_one(policy, observation) - before).max() > 0.05
    assert len(calls) == NUMBER + 2
    asked = torch.zeros((NUMBER, 1, task.action.size), requires_grad=True)
    scene = {name: torch.as_tensor(part) for name, part in observation.items()}
    foresee(scene, asked, task).vector().sum().backward()
    assert torch.isfinite(asked.grad).all(), "what a graph was drawn of still has gradients"


def no_compiler():
    raise CannotCompileError


class Counted:
    """Machine code that tells how often it decided."""

    def __init__(self, made, calls):
        self.made, self.calls = made, calls

    def __call__(self, observation):
        action = self.made(observation)
        self.calls += [] if action is None else [observation]
        return action


def test_without_a_compiler_it_says_so(monkeypatch, capsys):
    from torch._inductor import cpp_builder

    cpp_builder.cpp_compiler_search.cache_clear()
    monkeypatch.setattr(cpp_builder.config.cpp, "cxx", ("no-such-compiler",))
    with pytest.raises(CannotCompileError, match=r"need a C\+\+ compiler.*CXX"):
        find_agent(None, PLANAR).model.policy.compile_decisions()
    with pytest.raises(SystemExit):
        cli.main(["evaluate", "--pretrained", PLANAR, "--methods", "agent", "--compiled", "--n-scenes", "2"])
    assert "need a C++ compiler" in capsys.readouterr().err
    cpp_builder.cpp_compiler_search.cache_clear()


def test_a_search_among_links_in_space_cannot_be_compiled():
    with pytest.raises(CannotCompileError, match="links of an arm in space"):
        find_agent(None, "viapoint/PandaObstacles-v0").model.policy.compile_decisions()


def test_only_viatd3_is_compiled():
    agent = find_agent(None, PLANAR)
    other = agent._replace(model=type("SAC", (), {"policy": None})())
    with pytest.raises(ValueError, match="of ViaTD3 only; this agent is a SAC"):
        other.compile_decisions()
