"""Closed forms and published values."""

import itertools
import math
from statistics import NormalDist

import numpy as np
import pytest

from viapoint.training.evaluation import statistics


def test_wilson_equals_published_values():
    # Newcombe 1998, Stat. Med. 17, 857-872, table I, method 3
    for successes, trials, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (1, 29, 0.0061, 0.1718),
    ):
        interval = statistics.wilson(successes, trials)
        assert (round(interval.low, 4), round(interval.high, 4)) == (low, high)
    assert statistics.wilson(0, 20).low == 0.0
    assert round(statistics.wilson(0, 20).high, 4) == 0.1611


def test_mcnemar_counts_scenes_in_which_one_alone_succeeds():
    first, second = np.random.default_rng(0).random((2, 80)) < [[0.7], [0.5]]
    result = statistics.mcnemar(first, second)
    assert result["difference"] == pytest.approx(first.mean() - second.mean())
    alone = (first & ~second).sum(), (second & ~first).sum()
    assert (result["only_first"], result["only_second"]) == alone
    assert list(statistics.mcnemar(first, first).values()) == [0.0, 0, 0, 1.0]
    assert statistics.mcnemar([True] * 5, [False] * 5)["p_value"] == pytest.approx(2 / 2**5)


def test_across_seeds_draws_whole_agents():
    """Three agents, each the same in all scenes: all 27 draws of three of them can be written down."""
    rates = np.array([0.2, 0.5, 0.6])
    scores = np.repeat(rates[:, None], 40, axis=1)
    interval = statistics.across_seeds(scores, np.zeros(40), np.random.default_rng(0), samples=20_000)
    draws = sorted(np.mean(each) for each in itertools.product(rates, repeat=3))
    assert interval.estimate == pytest.approx(rates.mean())
    assert interval.low == pytest.approx(draws[0])  # one draw of 27 is more than 2.5 %
    assert interval.high == pytest.approx(draws[-1])
    trimmed = statistics.across_seeds(
        np.array([[0.0], [0.5], [0.6], [0.7], [1.0]]), [0], np.random.default_rng(0)
    )
    assert trimmed.estimate == pytest.approx(0.6)


def test_across_seeds_draws_scenes_within_their_strata():
    success = np.random.default_rng(0).random(400) < 0.7
    one = statistics.across_seeds(success[None], np.zeros(400), np.random.default_rng(1), samples=4000)
    half = 1.96 * math.sqrt(success.mean() * (1 - success.mean()) / 400)
    assert one.high - one.low == pytest.approx(2 * half, rel=0.1)
    score = np.where(success, 0.9, 0.2)
    known = statistics.across_seeds(score[None], success, np.random.default_rng(1))
    assert known == pytest.approx((score.mean(),) * 3)  # within a stratum all are alike


def test_across_seeds_covers_the_truth():
    """Agents of different worth in scenes of different difficulty: other agents and scenes are foreseen."""
    generator = np.random.default_rng(5)
    covered = 0
    for _ in range(100):
        worth, ease = generator.normal(1.0, 0.5, (8, 1)), generator.normal(0.0, 1.0, (1, 100))
        scores = generator.normal(size=(8, 100)) < worth + ease
        interval = statistics.across_seeds(scores, np.zeros(100), generator, samples=200)
        truth = NormalDist().cdf(1.0 / math.sqrt(1.0 + 0.25 + 1.0))
        covered += interval.low <= truth <= interval.high
    assert covered >= 85


def test_across_seeds_without_any_spread_is_wilsons():
    for value in (0.0, 1.0):
        interval = statistics.across_seeds(np.full((5, 20), value), np.zeros(20), np.random.default_rng(0))
        assert interval == statistics.wilson(int(20 * value), 20)
    strata = np.arange(20) < 5
    interval = statistics.across_seeds(np.tile(strata, (3, 1)), strata, np.random.default_rng(0))
    assert interval == statistics.wilson(5, 20)


def test_spl_by_its_formula():
    assert statistics.success_weighted_path_length([1, 1, 0, 1], [1, 1, 1, 2], [1, 2, 1, 1]) == pytest.approx(
        2.5 / 4
    )
