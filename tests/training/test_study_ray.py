"""Runner on a Ray cluster of two nodes on this machine: same results, and nothing is lost with a process."""

import dataclasses
import hashlib
import json
import os
from pathlib import Path

import pytest
import runner_jobs

from viapoint.training import Study, run_study
from viapoint.training.io.ray_cluster import check_versions, import_ray
from viapoint.training.study.jobs import baseline_jobs, training_jobs
from viapoint.training.study.runners import Job, make_runner
from viapoint.training.study.search_space import SearchSpace
from viapoint.training.study.tuning import Tuning

pytestmark = pytest.mark.usefixtures("no_hang")


@pytest.fixture(scope="module")
def cluster(ray_lock):
    """Two nodes of one core each, which listen on 127.0.0.1."""
    with pytest.MonkeyPatch.context() as patch:
        paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
        patch.setenv("PYTHONPATH", os.pathsep.join(paths))
        ray = import_ray()
        from ray.cluster_utils import Cluster

        nodes = {"num_cpus": 1, "include_dashboard": False, "node_ip_address": "127.0.0.1"}
        with ray_lock:
            made = Cluster(initialize_head=True, head_node_args=nodes)
            made.add_node(num_cpus=1, node_ip_address="127.0.0.1")
            ray.init(address=made.address, log_to_driver=False, logging_level="ERROR")
        yield made
        ray.shutdown()
        made.shutdown()


def job(function, *arguments, label="", **settings):
    return Job(label=label or function.__name__, function=function, arguments=arguments, **settings)


def results_in(folder):
    """Everything that may not depend on where a study ran: weights, evaluations, and learning curves without times."""
    found = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".safetensors" and "checkpoints" not in name:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif "evaluations" in name or "baselines" in name:
            found[name] = json.loads(path.read_text())
        elif path.suffix == ".jsonl":
            curve = [json.loads(line) for line in path.read_text().splitlines()]
            found[name] = [(each["decisions"], each["success"], each["jerk_ratio"]) for each in curve]
    return found


def test_a_study_has_the_same_results_as_on_this_machine(cluster, tmp_path):
    """One training is killed in the middle, and goes on from the checkpoint that the driver has."""
    agent = {
        "n_timesteps": 320,
        "checkpoint_every": 64,
        "eval_every": 128,
        "eval_scenes": 8,
        "checks": [0, 4],
    }
    few = {"learning_starts": 64, "gradient_steps": 2, "policy_kwargs": {"candidates": 16}}
    given = {
        "environments": {"viapoint/PlanarObstacles-v0": {"n_scenes": 8, "scenes": ["test"]}},
        "agents": {"viaq": {**agent, "hyperparameters": few}},
        "baselines": ["search64"],
    }
    here, there = (Study.from_dict({**given, "out": str(tmp_path / name)}) for name in ("here", "there"))
    run_study(here, workers=0, only=["train", "evaluate", "baselines"])
    steps = ("train", "evaluate")
    jobs = [
        dataclasses.replace(each, function=runner_jobs.train_then_die) for each in training_jobs(there, steps)
    ]
    jobs += baseline_jobs(there, of_equal_time=False)
    jobs += [
        job(runner_jobs.fill_disk, "disk", folder="disk"),
        job(runner_jobs.fail, "because"),
        job(runner_jobs.surroundings),
    ]
    with make_runner("ray", there.out) as runner:
        answers = {each.label: answer for each, answer in runner.run(jobs)}
    assert answers["fail"].error == "ValueError: because"
    assert answers["surroundings"].value == ("1", 1)
    assert answers["fill_disk"].value == "written"  # on the other node
    assert answers["PlanarObstacles-v0 viaq seed 0"].value.startswith("node: test, alone")
    (there.out / "disk" / "tried").unlink()
    assert results_in(there.out) == results_in(here.out)
    assert len(results_in(here.out)) == 6
    assert list(training_jobs(there, steps)) == []


def test_a_search_has_the_same_trials_as_on_this_machine(cluster, tmp_path):
    search = SearchSpace(
        env="viapoint/PlanarReach-v0",
        algo="sac",
        n_timesteps=96,
        n_envs=32,
        eval_every=48,
        eval_scenes=8,
        trials=3,
        hyperparameters={"learning_starts": 32, "gradient_steps": 1},
        parameters={"learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True}},
        sampler={"name": "tpe", "seed": 0},
    )
    found = []
    for on in ("local", "ray"):
        tuning = Tuning.create(tmp_path / on, search)
        tuning.work(on=on, workers=0 if on == "local" else None)
        trials = {
            each.params["learning_rate"]: (each.value, each.intermediate_values) for each in tuning.trials
        }
        found.append((trials, results_in(tmp_path / on)))
    assert len(found[0][1]) == 9  # three trials with two models and a curve
    assert found[0] == found[1]


def test_nodes_with_other_versions_are_refused_by_name():
    with pytest.raises(
        ValueError, match=r"node far/1a2b3c has torch 2.0, not 2.1: install the same versions"
    ):
        check_versions({"torch": "2.0", "numpy": "2"}, {"torch": "2.1", "numpy": "2"}, "far/1a2b3c")


def test_an_unreachable_cluster_is_refused(tmp_path):
    with pytest.raises(
        ValueError, match=r"no Ray cluster can be used at ray://127.0.0.1:9 .*ray start --head"
    ):
        make_runner("ray://127.0.0.1:9", tmp_path)
