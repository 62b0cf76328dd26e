"""Runners: each job has one answer, whatever happens to its process."""

import dataclasses
import os
import sys
import time

import pytest
import runner_jobs

from viapoint.training import Study, run_study
from viapoint.training.study.runners import Job, LocalRunner, make_runner


def job(function, *arguments, label="", **settings):
    return Job(label=label or function.__name__, function=function, arguments=arguments, **settings)


@pytest.mark.parametrize("workers", [0, 2])
def test_each_job_has_one_answer(tmp_path, workers):
    jobs = [job(runner_jobs.square, number, label=str(number)) for number in range(5)]
    jobs.append(job(runner_jobs.fail, "on\ntwo lines"))
    with make_runner("local", tmp_path, workers) as runner:
        answers = {each.label: answer for each, answer in runner.run(iter(jobs))}
    assert answers.pop("fail").error == "ValueError: on two lines"
    assert {label: answer.value for label, answer in answers.items()} == {str(n): n**2 for n in range(5)}


def test_killed_jobs_run_again_and_others_go_on(tmp_path):
    jobs = [
        job(runner_jobs.die_first, "twice", 2, label="twice"),
        job(runner_jobs.die_first, "always", 9, label="always", retries=1),
        job(runner_jobs.square, 3),
    ]
    with LocalRunner(tmp_path, 1) as runner:
        answers = {each.label: answer for each, answer in runner.run(jobs)}
        (late,) = runner.run([job(runner_jobs.surroundings, cpus=8)])
    assert answers["twice"].value == 3
    assert answers["always"].error == "its process ended with code -9"
    assert (tmp_path / "always" / "calls").read_text() == "2"
    assert answers["square"].value == 9
    assert late[1].value == ("1", len(os.sched_getaffinity(0)))


def test_processes_are_used_again_and_jobs_are_taken_when_there_is_room(tmp_path):
    taken = []

    def endless():
        while True:
            taken.append(len(taken))
            yield job(runner_jobs.identity)

    with LocalRunner(tmp_path, 1) as runner:
        processes = set()
        answers = runner.run(endless())
        for number, (_, answer) in enumerate(answers):
            processes.add(answer.value)
            assert len(taken) == number + 1
            if number == 3:
                answers.close()
    assert len(processes) == 1


def test_what_is_interrupted_saves_itself(tmp_path, capsys):
    with LocalRunner(tmp_path, 2) as runner:
        answers = runner.run([job(runner_jobs.square, 2), job(runner_jobs.wait_for_interrupt, "one")])
        assert next(answers)[1].value == 4
        while not (tmp_path / "one" / "state").exists():
            time.sleep(0.05)
        answers.close()
    assert (tmp_path / "one" / "state").read_text() == "saved"
    assert "saving 1 running jobs" in capsys.readouterr().err


def test_studies_on_this_machine_need_no_ray(tmp_path, monkeypatch):
    """Neither here nor in workers; on Ray, the error names the extra."""
    (tmp_path / "without" / "ray").mkdir(parents=True)
    (tmp_path / "without" / "ray" / "__init__.py").write_text("raise ImportError('no module named ray')")
    path = [str(tmp_path / "without"), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    monkeypatch.setitem(sys.modules, "ray", None)
    environment = {"viapoint/PlanarReach-v0": {"n_scenes": 4, "scenes": ["test"]}}
    study = Study.from_dict(
        {"out": str(tmp_path / "out"), "environments": environment, "baselines": ["straight"]}
    )
    record = run_study(study, workers=1, only=["baselines", "page"])
    assert len(record["environments"]["viapoint/PlanarReach-v0"]["rows"]) == 1
    with pytest.raises(ImportError, match=r"Ray is not installed: pip install 'viapoint\[cluster\]'"):
        run_study(dataclasses.replace(study, out=tmp_path / "other"), on="ray", only=["baselines"])


def test_an_unknown_runner_is_refused(tmp_path):
    with pytest.raises(ValueError, match="on must be local, ray or ray://HOST:PORT, got 'slurm'"):
        make_runner("slurm", tmp_path)
