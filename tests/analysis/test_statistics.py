"""Statistics of few seeds against numbers worked out by hand, slow enumerations and SciPy."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from offbench.analysis.statistics import Estimate, curve, improvement, iqm, paired, profile
from offbench.common.errors import OffbenchError
from tests import few_seeds

# Two tasks, two seeds each, few enough that every resample can be listed.
TINY = {"one": [0.0, 4.0], "two": [10.0, 20.0]}


def test_iqm_by_hand() -> None:
    # four runs 0, 4, 10, 20: a quarter is one run, off each end: (4 + 10) / 2
    assert iqm(TINY).value == 7.0
    # six runs 1..6: a quarter of six is 1.5, one whole run off each end: (2 + 3 + 4 + 5) / 4
    assert iqm({"a": [6.0, 1.0, 2.0], "b": [3.0, 5.0, 4.0]}).value == 3.5
    # eight runs: two off each end
    assert iqm({"a": [0.0, 0.0, 1.0, 2.0], "b": [3.0, 4.0, 90.0, 99.0]}).value == 2.5
    # three runs lose none
    assert iqm({"a": [1.0, 2.0, 9.0]}).value == 4.0


def test_the_interval_of_the_iqm_by_hand() -> None:
    # each task resamples to (x,x), (x,y), (y,x), (y,y), so 16 equally likely resamples. Sorted, the middle two of the
    # four values are always the larger of task one and the smaller of task two:
    #   larger of one: 0 with 1/4, 4 with 3/4;  smaller of two: 20 with 1/4, 10 with 3/4
    #   IQM 5 (0, 10): 3/16, 7 (4, 10): 9/16, 10 (0, 20): 1/16, 12 (4, 20): 3/16
    # both tails of 2.5% lie within the outermost values, 3/16 each
    assert iqm(TINY) == Estimate(7.0, 5.0, 12.0)


def test_one_seed_has_no_interval() -> None:
    assert iqm({"one": [3.0], "two": [1.0, 2.0]}) == Estimate(2.0)
    assert iqm({"one": [3.0]}).span() == ""
    assert str(iqm(TINY)) == "7.0 [5.0, 12.0]"


def test_improvement_by_hand() -> None:
    a = {"one": [1.0, 5.0], "two": [2.0, 2.0]}
    b = {"one": [3.0, 0.0], "two": [2.0, 9.0]}
    # task one: 1>0, 5>3, 5>0, not 1>3: 3/4. task two: 2=2 twice (1/2 each), 2<9 twice: 1/4. mean 1/2
    assert improvement(a, b).value == 0.5
    assert improvement(b, a).value == 0.5
    # task one alone: 3/4
    assert improvement({"one": a["one"]}, b).value == 0.75
    # against itself every pair is matched by its mirror
    assert improvement(TINY, TINY).value == 0.5


def test_improvement_of_a_certain_winner_is_certain() -> None:
    better = {task: [value + 100 for value in values] for task, values in TINY.items()}
    assert improvement(better, TINY) == Estimate(1.0, 1.0, 1.0)
    assert improvement(TINY, better) == Estimate(0.0, 0.0, 0.0)


def test_groups_without_a_common_task_are_said() -> None:
    with pytest.raises(OffbenchError, match="share no task"):
        improvement({"one": [1.0]}, {"two": [1.0]})


def test_profile_by_hand() -> None:
    # runs 0, 4, 10, 20: above -1 all, above 0 three (0 is not above 0), above 10 one, above 20 none
    found = profile(TINY, [-1.0, 0.0, 4.0, 10.0, 20.0])
    assert [point.value for point in found] == [1.0, 0.75, 0.5, 0.25, 0.0]
    assert (found[0].low, found[0].high) == (1.0, 1.0)
    # above 10: the number of 20s in task two's resample over 4: 0, 1/4, 2/4 with 1/4, 1/2, 1/4
    assert (found[3].low, found[3].high) == (0.0, 0.5)
    assert profile({"one": [1.0]}, [0.0]) == [Estimate(1.0)]


def test_paired_by_hand() -> None:
    # one task, differences 1, 2, 3: mean 2, standard deviation 1. Of 27 resamples the lowest mean is 1 (1/27 = 3.7%,
    # more than 2.5%), the highest 3. Of 8 sign patterns only +++ and --- reach a mean of 2: p = 1/4
    found = paired({"one": [1.0, 2.0, 3.0]})
    assert found.difference == Estimate(2.0, 1.0, 3.0)
    assert (found.standardized, found.p, found.pairs) == (2.0, 0.25, 3)


def test_paired_weighs_tasks_equally() -> None:
    # task means 4 and 1: mean 2.5, not the 3.0 of the six pairs' values 4 4 4 4 1 1
    found = paired({"one": [4.0, 4.0, 4.0, 4.0], "two": [1.0, 1.0]})
    assert found.difference == Estimate(2.5, 2.5, 2.5)
    assert found.p == 2 / 64  # all six of one sign, or all of the other
    assert paired({"x": [1e-13, 2e-13, 3e-13, 2e-13, 1e-13, 2e-13]}).p == 2 / 64  # in any unit


def test_a_difference_that_does_not_vary_is_not_standardized() -> None:
    found = paired({"one": [0.0, 0.0]})
    assert (found.difference, found.standardized, found.p) == (Estimate(0.0, 0.0, 0.0), None, 1.0)
    rounded = paired({"one": [0.1 + 0.2, 0.3, 0.3]})
    assert rounded.standardized is None
    alone = paired({"one": [5.0]})
    assert (alone.difference, alone.standardized, alone.p) == (Estimate(5.0), None, 1.0)


def test_many_pairs_are_sampled() -> None:
    strong = paired({"one": [5.0 + i for i in range(20)]})
    assert strong.p == 1 / 10_001  # none of 10,000 random patterns comes near
    null = paired({"one": [1.0, -1.0] * 10})
    assert null.p == 1.0


def test_curve_by_hand() -> None:
    # two seeds: the mean resamples to low, middle, high with 1/4, 1/2, 1/4
    assert curve(np.array([[0.0, 1.0], [2.0, 5.0]])) == [Estimate(1.0, 0.0, 2.0), Estimate(3.0, 1.0, 5.0)]
    assert curve(np.array([[7.0, 8.0]])) == [Estimate(7.0), Estimate(8.0)]


few = st.lists(st.integers(-5, 5).map(float), min_size=2, max_size=3)
matrices = st.dictionaries(st.sampled_from(["x", "y"]), few, min_size=1)


def interquartile(values: list[float]) -> float:
    """The definition, slowly: drop the lowest and the highest quarter, average the rest."""
    cut = math.floor(len(values) / 4)
    kept = sorted(values)[cut : len(values) - cut]
    return sum(kept) / len(kept)


def resampled(scores: dict[str, list[float]]) -> list[dict[str, tuple[float, ...]]]:
    """Every resample of every task's seeds."""
    choices = [list(itertools.product(values, repeat=len(values))) for values in scores.values()]
    return [dict(zip(scores, parts, strict=True)) for parts in itertools.product(*choices)]


def check_interval(found: Estimate, every: list[float]) -> None:
    """The interval's ends must be quantiles of all resamples, up to the chance of drawing 10,000 of them."""
    assert found.low is not None
    assert found.high is not None
    for end, share in ((found.low, 0.025), (found.high, 0.975)):
        low, high = np.quantile(every, (max(share - 0.01, 0), min(share + 0.01, 1)), method="inverted_cdf")
        assert low - 1e-9 <= end <= high + 1e-9


@settings(max_examples=40, deadline=None)
@given(matrices)
def test_the_iqm_against_a_slow_enumeration(scores: dict[str, list[float]]) -> None:
    found = iqm(scores)
    assert found.value == pytest.approx(interquartile([v for values in scores.values() for v in values]), abs=1e-12)
    check_interval(
        found, [interquartile([v for values in drawn.values() for v in values]) for drawn in resampled(scores)]
    )


@settings(max_examples=30, deadline=None)
@given(matrices, few, few)
def test_improvement_against_a_slow_enumeration(a: dict[str, list[float]], x: list[float], y: list[float]) -> None:
    b = {"x": x, "y": y}

    def probability(first: dict[str, tuple[float, ...]], second: dict[str, tuple[float, ...]]) -> float:
        per_task = []
        for task in a:
            wins = sum(1.0 if p > q else 0.5 if p == q else 0.0 for p in first[task] for q in second[task])
            per_task.append(wins / (len(first[task]) * len(second[task])))
        return sum(per_task) / len(per_task)

    found = improvement(a, b)
    seen = probability({k: tuple(v) for k, v in a.items()}, {k: tuple(v) for k, v in b.items()})
    assert found.value == pytest.approx(seen)
    u = np.mean([stats.mannwhitneyu(a[k], b[k]).statistic / (len(a[k]) * len(b[k])) for k in a])
    assert found.value == pytest.approx(u)
    if len(a) == 1:  # two tasks of both sides have too many resamples to list
        (task,) = a
        pairs = itertools.product(resampled(a), resampled({task: b[task]}))
        check_interval(found, [probability(first, second) for first, second in pairs])


@settings(max_examples=30, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(["x", "y"]), st.lists(st.integers(-4, 4).map(float), min_size=1, max_size=3), min_size=1
    )
)
def test_the_sign_flip_against_a_slow_enumeration(differences: dict[str, list[float]]) -> None:
    def mean_of_means(drawn: dict[str, list[float]]) -> float:
        return sum(sum(v) / len(v) for v in drawn.values()) / len(drawn)

    observed, hits, count = abs(mean_of_means(differences)), 0, sum(map(len, differences.values()))
    for signs in itertools.product((1, -1), repeat=count):
        left = iter(signs)
        flipped = {task: [next(left) * v for v in values] for task, values in differences.items()}
        hits += abs(mean_of_means(flipped)) >= observed - 1e-9
    assert paired(differences).p == hits / 2**count


def test_intervals_against_scipys_bootstrap(rng: np.random.Generator) -> None:
    """SciPy resamples several samples independently of one another: strata, for the mean of all."""
    scores = {name: rng.normal(size=6).tolist() for name in ("a", "b", "c")}

    def statistic(*parts: np.ndarray, axis: int) -> np.ndarray:
        return np.asarray(stats.trim_mean(np.concatenate(parts, axis), 0.25, axis=axis))

    theirs = stats.bootstrap(tuple(scores.values()), statistic, n_resamples=10_000, method="percentile", rng=7)
    ours = iqm(scores)
    assert (ours.low, ours.high) == pytest.approx(tuple(theirs.confidence_interval), abs=0.02)
    assert ours == iqm(scores)  # drawn with a fixed generator


@pytest.mark.slow
def test_what_few_seeds_can_tell_is_as_the_page_says() -> None:
    written = few_seeds.FILE.read_text().splitlines()[2:]
    assert [[cell.strip() for cell in line.split("|")[1:-1]][:2] for line in written] == [
        [str(tasks), str(seeds)] for tasks, seeds in few_seeds.SIZES
    ]
    assert written[1] == "| " + " | ".join(few_seeds.row(*few_seeds.SIZES[1])) + " |"
