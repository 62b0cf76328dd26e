"""Prose of docs/results.md; page.py fills in the numbers."""

INTRODUCTION = """# Results

This page is made by one command from files that the trainings left; no number in it is typed by hand.

    python benchmarks/learning.py --jobs 2

It trains every method with every seed, measures each agent on the frozen `test` and `hard` scenes, measures the
baselines on the same scenes, and writes this page, its figures and [results.json](results.json), which holds every
number shown here. Called again it goes on where it stopped, and what was measured on another machine, on the same
scenes, keeps its place on the page. Models are chosen on `validation` scenes alone; `test` and `hard` are looked at
once training is over.

{seeds}

**How to read the tables.** Success: at rest within 1 cm of the goal, no contact at any physics step, joint limits
kept. Of several seeds the number is the interquartile mean (of five seeds: the mean of the middle three), with the
95 % interval of a bootstrap that draws seeds and scenes anew (2,000 draws; whole agents, and scenes within their
bands). A method without seeds has the interval over scenes. The bands are those of the *solution share*, the
fraction of uniformly random actions that solve a scene: easy scenes prove little. Jerk and duration are those of
successes as multiples of the planner's in the same scene: the median over scenes, then over seeds. Jerk is taken at
equal duration. Decision: the median time of one decision on one thread; of the planner, of one scene; of an agent that
acts in every control step, of one step. Minutes: wall time of a training without validation, median over seeds, with
the cores it could use; other programs on the machine make it longer.
"""

KNOWLEDGE = """## What is computed, and what is learned

Computed: the plan of each candidate (an action is a minimum-jerk movement by a formula), its jerk, its duration, and
the planned poses of the arm. Learned: clearance, contact and success. The critic of `viaq` never computes a distance to
an obstacle; it is a minimum over obstacles, bodies of the arm and instants, and learns from the terms of the reward.

*Policy alone* takes the candidate of the greatest value. *Checked proposals* computes clearance and reach of the most
promising candidates and takes the best of them; no movement is simulated. *Untrained, checked proposals* does so with
the same network before training. *Search* checks as many or more plans without a network: it uses the same geometry,
so the difference between the two is what was learned.
"""

FAILURES = """## Failures, drawn

Failures of the shipped agent in the `hard` scenes of PlanarWholeArm-v0, policy alone, from the deepest of a kind to its
mildest (`viapoint evaluate viapoint/PlanarWholeArm-v0 --baselines --scenes hard --failures
docs/images/failures`).

![The plan enters an obstacle by 5 mm or less](images/failures/graze.png)

![A clear collision, and no other proposal would have succeeded](images/failures/collision.png)
"""

FREEDOM = """## When does more freedom pay?

K via-points, passage times of least jerk (*optimal*) or chosen by the agent (*learned*). The scenes are the same;
bands are those of one via-point with optimal timing. The planner searches anew with the same budget in the first
{planned} test scenes. With K = 1 and optimal timing it solves them all, as a scene is in the set only if it did; the
question is what more freedom does to its jerk.
"""

TAGS = {
    "rollout/ep_rew_mean": "mean reward of the last 100 decisions (Stable-Baselines3)",
    "rollout/success_rate": "successes among the last 100 decisions (Stable-Baselines3)",
    "rollout/collision_rate": "of the last 20 steps of all environments",
    "rollout/reachable_rate": "plans within the arm's reach",
    "rollout/min_clearance": "mean clearance, m",
    "rollout/jerk_ratio": "mean jerk relative to the straight movement",
    "rollout/duration": "mean duration, s",
    "validation/success_rate": "of the policy alone on the validation scenes",
    "validation/success_rate_share_above_20": "the same by band; also `5_to_20`, `1_to_5`, `below_1`",
    "validation/collision_rate": "of the policy alone on the validation scenes",
    "validation/min_clearance": "median of all scenes, m",
    "validation/goal_error": "median of all scenes, m",
    "validation/jerk_ratio": "median of successes",
    "validation/duration": "median of successes, s",
    "validation/decision_time": "median of single decisions, s",
    "time/simulated_seconds": "simulated so far; `time/fps` is decisions per second",
}
"""Meanings of the tags in the log."""
