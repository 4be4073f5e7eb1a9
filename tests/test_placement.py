"""Placement of work: conservation, capacity, order and proportion."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sdc_taichi.hall.placement import MIN_HEADROOM_K, POLICIES, PlacementError, make_bins, place
from sdc_taichi.types import F64, I64

LIMIT_C = 27.0


@dataclass
class Case:
    start: I64
    utilisation: F64
    count: F64
    capacity: F64
    inlet_c: F64
    weights: F64

    def place(self, policy: str, utilisation: F64 | None = None) -> tuple[F64, F64]:
        return place(
            policy,
            self.utilisation if utilisation is None else utilisation,
            bins=make_bins(self.start),
            count=self.count,
            capacity=self.capacity,
            inlet_c=self.inlet_c,
            limit_c=np.full(len(self.start) - 1, LIMIT_C),
            weights=self.weights if policy == "weights" else None,
        )

    def alone(self, dc: int) -> Case:
        own = slice(self.start[dc], self.start[dc + 1])
        return Case(
            np.array([0, self.start[dc + 1] - self.start[dc]]),
            self.utilisation[dc : dc + 1],
            *(x[own] for x in (self.count, self.capacity, self.inlet_c, self.weights)),
        )

    def sums(self, values: F64) -> F64:
        return np.array([values[a:b].sum() for a, b in itertools.pairwise(self.start)])

    def usable(self, policy: str) -> F64:
        return np.where((self.weights > 0.0) | (policy != "weights"), self.capacity, 0.0)


def case_of(sizes: list[int], utilisation: list[float], **values: list[float]) -> Case:
    """Halls of so many bins of one server and full capacity at 20 C, but for ``values``."""
    n = sum(sizes)
    bins = {"count": [1.0] * n, "capacity": [1.0] * n, "inlet_c": [20.0] * n, "weights": [1.0] * n}
    arrays = {name: np.array(column, float) for name, column in {**bins, **values}.items()}
    return Case(np.cumsum([0, *sizes]), np.array(utilisation), **arrays)


@st.composite
def cases(draw: st.DrawFn) -> Case:
    sizes = draw(st.lists(st.integers(1, 24), min_size=1, max_size=5))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = sum(sizes)
    start = np.concatenate([[0], np.cumsum(sizes)])
    weights = 10.0 ** rng.uniform(-draw(st.sampled_from([0, 3, 30])), 0.0, n)
    weights *= rng.random(n) < draw(st.sampled_from([0.4, 1.0]))
    weights[start[:-1]] += 1.0
    # Rounded, so that capacities, temperatures and full bins tie and utilisation may just fit.
    return Case(
        start,
        np.round(rng.uniform(0.0, 1.0, len(sizes)), draw(st.sampled_from([1, 9]))),
        rng.integers(1, draw(st.sampled_from([2, 400])), n).astype(np.float64),
        np.round(rng.choice([0.0, 0.5, 1.0, rng.random()], n), 3)
        if draw(st.booleans())
        else np.ones(n),
        np.round(rng.uniform(16.0, 34.0, n), draw(st.sampled_from([0, 9]))),
        weights,
    )


@given(cases(), st.sampled_from(POLICIES))
def test_work_is_conserved_within_capacity(case: Case, policy: str) -> None:
    load, placed = case.place(policy)
    assert np.all((load >= 0.0) & (load <= case.capacity))
    servers, room = case.sums(case.count), case.sums(case.count * case.usable(policy))
    np.testing.assert_allclose(placed, np.minimum(case.utilisation, room / servers), rtol=1e-13)
    assert np.all(placed <= case.utilisation)
    np.testing.assert_allclose(case.sums(case.count * load), placed * servers, rtol=1e-12)


@given(cases(), st.sampled_from(POLICIES))
def test_a_data_center_alone_is_placed_as_in_the_batch(case: Case, policy: str) -> None:
    load, placed = case.place(policy)
    for dc, (a, b) in enumerate(itertools.pairwise(case.start)):
        alone_load, alone_placed = case.alone(dc).place(policy)
        np.testing.assert_array_equal(load[a:b], alone_load)
        assert placed[dc] == alone_placed[0]


@given(cases(), st.sampled_from(POLICIES), st.floats(0.0, 1.0))
def test_more_work_lowers_no_load(case: Case, policy: str, share: float) -> None:
    load, _ = case.place(policy)
    less, _ = case.place(policy, share * case.utilisation)
    assert np.all(less <= load + 1e-12)


@given(cases(), st.sampled_from(["fill", "coolest-first"]))
def test_bins_fill_in_order(case: Case, policy: str) -> None:
    load, placed = case.place(policy)
    for dc, (a, b) in enumerate(itertools.pairwise(case.start)):
        order = (
            range(a, b) if policy == "fill" else sorted(range(a, b), key=case.inlet_c.__getitem__)
        )
        work = placed[dc] * case.count[a:b].sum()
        for k in order:
            expected = min(case.capacity[k], max(work, 0.0) / case.count[k])
            assert load[k] == pytest.approx(expected, abs=1e-11)
            work -= expected * case.count[k]


@given(cases(), st.sampled_from(["uniform", "inlet-aware", "weights"]))
def test_loads_are_in_proportion_up_to_capacity(case: Case, policy: str) -> None:
    load, placed = case.place(policy)
    weight = {
        "uniform": np.ones(len(load)),
        "inlet-aware": np.maximum(LIMIT_C - case.inlet_c, MIN_HEADROOM_K),
        "weights": case.weights,
    }[policy]
    for dc, (a, b) in enumerate(itertools.pairwise(case.start)):
        count, cap, w = case.count[a:b], case.capacity[a:b], weight[a:b]
        # Independent of the code: halve the interval of the logarithm of the level.
        low, high = -800.0, 800.0
        for _ in range(200):
            middle = 0.5 * (low + high)
            done = float(count @ np.minimum(cap, np.exp2(middle) * w))
            low, high = (middle, high) if done < placed[dc] * count.sum() else (low, middle)
        if placed[dc] > 0.0:
            expected = np.minimum(cap, np.exp2(high) * w)
            np.testing.assert_allclose(load[a:b], expected, rtol=1e-9, atol=1e-11)
        else:
            np.testing.assert_array_equal(load[a:b], 0.0)


def test_a_hall_by_hand() -> None:
    case = case_of(
        [4],
        [0.4],
        count=[10, 20, 10, 10],
        capacity=[1, 0.25, 1, 0],
        inlet_c=[26, 20, 22, 18],
        weights=[1, 0, 3, 9],
    )
    # 20 servers' worth of work; rack 1 takes at most 5 of it and rack 3 none.
    for policy, load in {
        "uniform": [0.75, 0.25, 0.75, 0.0],
        "fill": [1.0, 0.25, 0.5, 0.0],
        "coolest-first": [0.5, 0.25, 1.0, 0.0],
        "inlet-aware": [0.5, 0.25, 1.0, 0.0],
        "weights": [1.0, 0.0, 1.0, 0.0],
    }.items():
        found, placed = case.place(policy)
        np.testing.assert_allclose(found, load, rtol=1e-15, err_msg=policy)
        assert placed[0] == pytest.approx(0.4)
    found, placed = case.place("weights", np.array([0.2]))
    np.testing.assert_allclose(found, [0.25, 0.0, 0.75, 0.0])
    found, placed = case.place("weights", np.array([0.8]))
    np.testing.assert_array_equal(found, [1.0, 0.0, 1.0, 0.0])
    assert placed[0] == 0.4


def test_a_limited_neighbour_changes_no_bit_of_a_uniform_load() -> None:
    # Through servers and back, a tenth or so of these would come out rounded otherwise.
    rng = np.random.default_rng(2)
    size = 200
    counts = rng.integers(1, 100, 3 * size).tolist()
    case = case_of([3] * size, rng.random(size).tolist(), count=counts)
    case.capacity[0] = 0.0
    load, placed = case.place("uniform")
    np.testing.assert_array_equal(load[3:], np.repeat(case.utilisation[1:], 3))
    np.testing.assert_array_equal(placed[1:], case.utilisation[1:])


def test_coolest_first_breaks_ties_by_index() -> None:
    case = case_of([3], [0.5], inlet_c=[20.0, 19.0, 19.0])
    np.testing.assert_allclose(case.place("coolest-first")[0], [0.0, 1.0, 0.5])
    # Temperatures of alike bins differ in their last bits, by the processor.
    case.inlet_c[1] = np.nextafter(19.0, 20.0)
    np.testing.assert_allclose(case.place("coolest-first")[0], [0.0, 1.0, 0.5])


def test_a_data_center_without_capacity_places_nothing() -> None:
    case = case_of([2, 2], [0.5, 0.5], count=[3.0] * 4, capacity=[0.0, 0.0, 1.0, 1.0])
    for policy in POLICIES:
        load, placed = case.place(policy)
        np.testing.assert_array_equal(load[:2], 0.0)
        np.testing.assert_allclose(placed, [0.0, 0.5])


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([1.0, 1.0, 1.0, -2.0], "oslo: placement weight 1 is -2.0; valid is a finite number"),
        ([1.0, np.nan, 1.0, 1.0], "bergen: placement weight 1 is nan"),
        ([1.0, 0.0, 0.0, 0.0], "oslo: all placement weights are 0; valid is at least one above 0"),
    ],
)
def test_weights_that_cannot_be_used_are_named(weights: list[float], message: str) -> None:
    with pytest.raises(PlacementError, match=message):
        place(
            "weights",
            np.array([0.5, 0.5]),
            bins=make_bins(np.array([0, 2, 4]), ["bergen", "oslo"]),
            count=np.ones(4),
            capacity=np.ones(4),
            inlet_c=np.full(4, 20.0),
            limit_c=np.full(2, LIMIT_C),
            weights=np.array(weights),
        )
