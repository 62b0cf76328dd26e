"""Runner on a Ray cluster of two nodes on this machine: same results, and nothing is lost with a process."""

import os
from pathlib import Path

import pytest
import runner_jobs

from viapoint.training.io.ray_cluster import LOOPBACK, check_versions, import_ray
from viapoint.training.study.runner import Job, make_runner


@pytest.fixture(scope="module")
def cluster():
    """Two nodes of one core each, which listen on 127.0.0.1."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in LOOPBACK.items():
            patch.setenv(name, value)
        patch.setenv(
            "PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
        )
        ray = import_ray()
        from ray.cluster_utils import Cluster

        nodes = {"num_cpus": 1, "include_dashboard": False, "node_ip_address": "127.0.0.1"}
        made = Cluster(initialize_head=True, head_node_args=nodes)
        made.add_node(num_cpus=1, node_ip_address="127.0.0.1")
        ray.init(address=made.address, log_to_driver=False, logging_level="ERROR")
        yield made
        ray.shutdown()
        made.shutdown()


def job(function, *arguments, label="", **settings):
    return Job(label=label or function.__name__, function=function, arguments=arguments, **settings)


def test_jobs_run_on_all_nodes_and_killed_ones_go_on(cluster, tmp_path):
    (tmp_path / "twice").mkdir()
    (tmp_path / "twice" / "calls").write_text("5")
    jobs = [
        job(runner_jobs.die_first, "twice", 6, label="twice", folder="twice"),
        job(runner_jobs.square, 3),
        job(runner_jobs.fail, "because"),
        job(runner_jobs.surroundings),
    ]
    with make_runner("ray", tmp_path) as runner:
        answers = {each.label: answer for each, answer in runner.run(jobs)}
    assert answers["twice"].value == 7
    assert (tmp_path / "twice" / "calls").read_text() == "7"
    assert answers["square"].value == 9
    assert answers["fail"].error == "ValueError: because"
    assert answers["surroundings"].value == ("1", 1)


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
