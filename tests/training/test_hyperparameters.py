"""The table knows every hyperparameter, lets through what the algorithms use, and stops what makes no sense."""

import inspect
import math

import pytest

from viapoint.training.algorithms.model_io import ALGORITHMS, _encode, argument_names
from viapoint.training.algorithms.viaq_policy import ViaQPolicy
from viapoint.training.config.checks import HYPERPARAMETERS, PARTICULAR, VIA_POLICY, check_hyperparameters
from viapoint.training.config.presets import PRESETS, REACH_PRESETS, REPLANNING_PRESETS, STEP_PRESETS


def test_every_hyperparameter_is_in_the_table():
    names = set().union(*(argument_names(kind) for kind in ALGORITHMS.values()))
    assert set(HYPERPARAMETERS) == names
    assert set(PARTICULAR) <= set(ALGORITHMS)
    assert all(set(table) <= names for table in PARTICULAR.values())


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_what_the_algorithms_and_the_presets_use_is_allowed(algo):
    for table in (PRESETS, STEP_PRESETS, REACH_PRESETS, REPLANNING_PRESETS):
        if algo in table:
            check_hyperparameters(algo, table[algo].arguments())
    defaults = {
        each.name: _encode(each.default)
        for each in inspect.signature(ALGORITHMS[algo]).parameters.values()
        if each.name in HYPERPARAMETERS and each.default is not each.empty
    }
    assert len(defaults) > 8
    check_hyperparameters(algo, defaults)


@pytest.mark.parametrize("value", [math.nan, -math.inf, "abc", -9, [], {"kind": "eval"}, "auto_0", "auto_1e"])
def test_what_makes_no_sense_is_refused_with_what_is_allowed(value):
    meant = {"target_entropy"} if value == -9 else {"policy_kwargs"} if isinstance(value, dict) else set()
    for name in HYPERPARAMETERS.keys() - meant:
        with pytest.raises(ValueError, match=f"hyperparameter {name} of sac must be .+, got"):
            check_hyperparameters("sac", {name: value})


@pytest.mark.parametrize(
    ("algo", "name", "value"),
    [
        ("sac", "gamma", 7),
        ("sac", "gamma", True),
        ("viaq", "gradient_steps", -9),
        ("viaq", "buffer_size", 0),
        ("viaq", "batch_size", 1.5),
        ("viaq", "batch_size", True),
        ("viaq", "learning_rate", 0.0),
        ("viaq", "learning_rate", {"kind": "linear", "start": 1.0}),
        ("viaq", "policy_kwargs", 3),
        ("viaq", "explore_uniformly", 1.5),
        ("viaq", "temperature", 0),
        ("viaq", "explore_candidates", 1),
        ("viaq", "next_candidates", 0),
        ("viaq", "action_noise", {"kind": "normal", "sigma": 0.1}),
        ("ppo", "batch_size", 1),
        ("ppo", "ent_coef", "auto"),
        ("sac", "train_freq", [1, "episode"]),
        ("sac", "action_noise", {"kind": "normal", "sigma": -0.1}),
    ],
)
def test_ranges_and_types(algo, name, value):
    with pytest.raises(ValueError, match=f"hyperparameter {name} of {algo} must be .+, got"):
        check_hyperparameters(algo, {name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width", 0),
        ("width", 128.0),
        ("width", True),
        ("form", "features"),
        ("pooling", "mean"),
        ("pooling", "sum"),  # with the form "poses"
        ("heads", 0),
        ("heads", None),
        ("instants", 1),
        ("candidates", 0),
        ("candidates", 2.5),
        ("refinements", -1),
        ("per_refinement", 0),
        ("checks", -1),
        ("optimizer_kwargs", 3),
    ],
)
def test_what_makes_no_sense_of_a_policy_of_via_points_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} in policy_kwargs of viaq must be .+, got"):
        check_hyperparameters("viaq", {"policy_kwargs": {name: value}})


@pytest.mark.parametrize("name", ["net_arch", "task", "foo"])
def test_names_that_a_policy_of_via_points_has_not_are_refused_with_those_it_has(name):
    with pytest.raises(ValueError, match=f"no '{name}'; they have form, pooling, heads"):
        check_hyperparameters("viaq", {"policy_kwargs": {name: [3]}})
    check_hyperparameters("sac", {"policy_kwargs": {name: [3]}})


def test_the_table_of_a_policy_of_via_points_is_whole():
    arguments = inspect.signature(ViaQPolicy).parameters.values()
    own = {each.name: each.default for each in arguments if each.default is not each.empty}
    del own["optimizer_class"]
    assert set(VIA_POLICY) == set(own)
    check_hyperparameters("viaq", {"policy_kwargs": own})
