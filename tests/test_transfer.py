"""Fleets whose sites share work: flows, ledgers, deadlines, clocks, budgets and bad input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sdc_taichi import (
    Actions,
    ConfigError,
    DataCenterConfig,
    SdcError,
    Simulator,
    drivers_from_arrays,
    load_config,
    make_configs,
    with_values,
)
from sdc_taichi.control.view import view_maker
from sdc_taichi.envs.costs import Costs, fleet_carbon
from sdc_taichi.run.metrics import add_step, empty_totals, metrics_of_fleet, metrics_per_dc
from sdc_taichi.sim.drivers import Drivers, local_start
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.shared_work import SharedWork
from sdc_taichi.sim.transfer import Flows, Transfer
from sdc_taichi.types import F64

SITES = ["AZ", "CA", "NY", "WA"]
NO_LINKS = {"link_share_per_hour": None}


def fleet_of(sites: list[str] = SITES, **fields: Any) -> DataCenterConfig:
    """The tiny preset at some sites, with much flexible work."""
    values = {"sites": sites, **NO_LINKS, **fields}
    return with_values(load_config("tiny", ["workload.flexible_share=0.4"]), {"fleet": values})


def links(pairs: Any, allowed: Any = 1.0, site: float = np.inf) -> SharedWork:
    """Links of one fleet or several; ``pairs`` (F, S, S)."""
    pairs = np.asarray(pairs, dtype=np.float64)
    fleets, sites = pairs.shape[:2]
    both = np.broadcast_to(np.asarray(allowed) * (1 - np.eye(sites)), pairs.shape)
    none = np.full(fleets * sites, np.nan)
    rows = pairs.reshape(-1, sites)
    of_sites = np.full(len(rows), site)
    return SharedWork(both.reshape(-1, sites).copy(), rows, of_sites, 1, none, none, none)


def flows(shares: Any, flexible: Any, room: Any, of: SharedWork) -> tuple[Any, ...]:
    """Flow (F, S, S), and what is sent, got and refused, (F S,) each."""
    kernel = Flows(of)
    sites = of.allowed.shape[1]
    rows = np.asarray(shares, dtype=np.float64).reshape(-1, sites)
    totals = kernel.of(rows, np.ravel(flexible).astype(float), np.ravel(room).astype(float))
    return kernel.flow.copy(), *totals


PAIRS = [[1, 1, 0], [1, 1, 0], [0, 0, 1]]


@pytest.mark.parametrize(
    ("shares", "flexible", "link", "room", "allowed", "expected"),
    [
        pytest.param(
            [[0, 0.5, 0.5], [0, 0, 1], [0, 0, 0]], [10, 20, 5], 8.0, [100, 5, 12], 1.0,
            [[0, 5, 60 / 13], [0, 0, 96 / 13], [0, 0, 0]], id="link first, then room in proportion",
        ),
        pytest.param(
            [[0, 0.8, 0.8], [0, 0, 0], [0, 0, 0]], [10, 0, 0], 99.0, [9, 9, 9], 1.0,
            [[0, 5, 5], [0, 0, 0], [0, 0, 0]], id="shares above 1 in sum",
        ),
        pytest.param(
            [[0, 1, 0], [0, 0, 1], [1, 0, 0]], [10, 10, 10], 99.0, [99, 99, 99], PAIRS,
            [[0, 10, 0], [0, 0, 0], [0, 0, 0]], id="residency groups",
        ),
        pytest.param(
            [[0.5, 0.5, 0], [-1, 0, 2], [0, 0.25, 0]], [8, 6, 4], 5.0, [9, 2.5, 4], 1.0,
            [[0, 2, 0], [0, 0, 4], [0, 0.5, 0]], id="own and negative shares stay",
        ),
    ],
)  # fmt: skip
def test_flows_by_hand(
    shares: Any, flexible: Any, link: float, room: Any, allowed: Any, expected: Any
) -> None:
    of = links(np.full((1, 3, 3), link), allowed)
    flow, sent, got, _ = flows(shares, flexible, room, of)
    np.testing.assert_allclose(flow[0], expected, rtol=1e-12)
    np.testing.assert_allclose(sent, np.sum(expected, axis=1), rtol=1e-12)
    np.testing.assert_allclose(got, np.sum(expected, axis=0), rtol=1e-12)


def test_a_site_sends_and_gets_at_most_what_its_link_carries() -> None:
    of = links(np.full((1, 3, 3), np.inf), site=6.0)
    shares = [[0, 0.5, 0.5], [0, 0, 0.5], [0, 0, 0]]
    flow, sent, got, refused = flows(shares, [20, 10, 0], [99, 99, 99], of)
    # Site 0 asks for 20 and sends 3 + 3; site 2 is to get 3 + 5 and gets 6.
    expected = [[0.0, 3.0, 2.25], [0.0, 0.0, 3.75], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose(flow[0], expected, rtol=1e-12)
    np.testing.assert_allclose(refused, [14.75, 1.25, 0], rtol=1e-12)
    np.testing.assert_allclose(np.concatenate([sent, got]), [5.25, 3.75, 0, 0, 3, 6], rtol=1e-12)


def test_flows_are_feasible_and_feasible_flows_stay() -> None:
    rng = np.random.default_rng(2)
    n, sites = 300, 6
    flexible, room = rng.uniform(0, 50, (n, sites)), rng.uniform(0, 30, (n, sites))
    of = links(rng.uniform(0, 9, (n, sites, sites)), site=20.0)
    flow, sent, _, _ = flows(rng.uniform(-1, 1, (n, sites, sites)), flexible, room, of)
    assert sent.max() > 15
    again, *_ = flows(flow / flexible[..., None], flexible, room, of)
    np.testing.assert_allclose(again, flow, atol=1e-12)
    assert np.all(flow >= 0)
    assert np.all(flow - of.pair_tasks.reshape(flow.shape) <= 1e-12)
    assert np.all(flow.sum(axis=1) - np.minimum(room, 20.0) <= 1e-12)
    assert np.all(flow.sum(axis=2) - np.minimum(flexible, 20.0) <= 1e-12)
    # Each fleet has the same bits alone.
    one = links(of.pair_tasks.reshape(flow.shape)[7:8], site=20.0)
    alone, *_ = flows(flow[7] / flexible[7][:, None], flexible[7], room[7], one)
    assert np.array_equal(alone[0], again[7])


TROUBLE = [
    "hvac.crac.units=2",
    "workload.flexible_share=0.5",
    "workload.queue_limit_h=0.75",
    "protection.ashrae_class=A1",
    "protection.trip_margin_k=2",
    "hvac.sizing.design_wet_bulb_c=10",
    "hvac.sizing.margin=1",
    "events.sampled=[{kind: crac_down, per_year: 800, duration_h: [1, 4]}]",
]


def troubled() -> tuple[list[DataCenterConfig], Drivers]:
    """Two fleets of three sites with full queues and failures."""
    rng = np.random.default_rng(3)
    config = with_values(
        load_config("corrected", TROUBLE),
        {"fleet": {"sites": ["AZ", "NY", "WA"], "delay_steps": 3, "link_share_per_hour": 0.3}},
    )
    wet_bulb = rng.uniform(18, 28, (6, 400))
    demand = rng.uniform(0.2, 1.0, (6, 400))
    drivers = drivers_from_arrays(wet_bulb + 6, wet_bulb, rng.uniform(50, 600, (6, 400)), demand)
    return make_configs(config, count=2), drivers


@pytest.fixture(scope="module")
def fleet_run() -> dict[str, F64]:
    """Sums over each fleet of all that its sites did by each step, (T, F)."""
    configs, drivers = troubled()
    rng = np.random.default_rng(0)
    rows: dict[str, list[F64]] = {}
    with Simulator(configs, drivers=drivers) as sim:
        sim.reset(seed=1)
        for _ in range(400):
            shares = rng.uniform(-0.5, 1, (6, 3))
            result = sim.step(Actions(load=rng.uniform(-1, 1, 6), transfer=shares))
            for name, value in result.per_dc().items():
                rows.setdefault(name, []).append(value.reshape(2, 3).sum(axis=1))
    return {name: np.array(values) for name, values in rows.items()}


def ledgers(run: dict[str, F64]) -> dict[str, list[F64]]:
    """Terms of each ledger of a fleet since the start, with their signs, (T, F) each."""
    total = {name: np.cumsum(values, axis=0) for name, values in run.items()}
    return {
        "work": [
            total["arrived_tasks"],
            -total["executed_tasks"],
            -run["queue_tasks"],
            -run["in_flight_tasks"],
            -total["dropped_tasks"],
            -total["lost_tasks"],
        ],
        "transfers": [total["sent_tasks"], -total["landed_tasks"], -run["in_flight_tasks"]],
    }


@pytest.mark.parametrize("name", ["work", "transfers"])
def test_ledger_of_a_fleet_closes_and_needs_each_term(name: str, fleet_run: Any) -> None:
    terms = ledgers(fleet_run)[name]
    scale = terms[0].max()
    assert np.abs(np.sum(terms, axis=0)).max() <= 1e-12 * scale
    for i in range(len(terms)):
        without = np.sum([term for j, term in enumerate(terms) if j != i], axis=0)
        assert np.abs(without).max() > 1e-4 * scale, i


def test_work_of_each_site_adds_up_with_what_it_sends_and_gets() -> None:
    configs, drivers = troubled()
    rng = np.random.default_rng(0)
    waited = np.zeros(6)
    with Simulator(configs, drivers=drivers) as sim:
        sim.reset()
        for _ in range(60):
            r = sim.step(Actions(load=-1.0, transfer=rng.uniform(0, 1, (6, 3))))
            came = r.arrived_tasks - r.sent_tasks + r.landed_tasks + waited
            went = r.executed_tasks + r.lost_tasks + r.dropped_tasks + r.queue_tasks
            np.testing.assert_allclose(came, went, rtol=1e-12)
            waited = r.queue_tasks


def test_no_work_is_dropped_on_arrival() -> None:
    config = with_values(fleet_of(delay_steps=4), {"workload.queue_limit_h": 0.5})
    rng = np.random.default_rng(4)
    arrived = refused = 0.0
    fullest = np.zeros(4)
    demand = np.repeat(rng.uniform(0.3, 1, (4, 75)), 4, axis=1)
    drivers = drivers_from_arrays([20.0] * 300, [15.0] * 300, [300.0] * 300, demand)
    with Simulator(config, drivers=drivers) as sim:
        sim.reset()
        for t in range(300):
            shares = np.zeros((4, 4))
            shares[:, t // 50 % 4] = 1.0
            result = sim.step(Actions(transfer=shares, load=rng.choice([0.0, 0.5, 1.0], 4)))
            assert not result.dropped_tasks.any(), t
            fullest = np.maximum(fullest, result.queue_tasks)
            arrived += result.landed_tasks.sum()
            refused += result.refused_tasks.sum()
    assert np.all(fullest > 150)
    assert min(arrived, refused) > 3000


def test_landed_work_keeps_its_deadline() -> None:
    """Queues of cohorts by step of arrival at the first site, oldest first, against the kernel."""
    times = {"workload.deadline_h": 2, "workload.queue_limit_h": 50}
    config = with_values(fleet_of(["NY", "WA"], delay_steps=3), times)
    rng = np.random.default_rng(5)
    steps, due_steps = 150, 8
    queues: list[dict[int, float]] = [{}, {}]
    flying: list[tuple[int, int, int, float]] = []
    seen = 0.0
    with Simulator(config) as sim:
        sim.reset()
        for t in range(steps):
            command = rng.choice([-1.0, -0.5, 0.0, 0.3], 2)
            shares = rng.uniform(0, 1, (2, 2)) * rng.integers(0, 2, (2, 1))
            r = sim.step(Actions(load=command, transfer=shares))
            for site, queue in enumerate(queues):
                due = sum(tasks for born, tasks in queue.items() if born <= t - due_steps)
                assert r.due_tasks[site] == pytest.approx(due, abs=1e-9)
                landed = [(b, n) for to, at, b, n in flying if (to, at) == (site, t)]
                assert r.landed_tasks[site] == pytest.approx(sum(n for _, n in landed), abs=1e-9)
                left = r.due_tasks[site] - r.overdue_tasks[site] + r.drained_tasks[site]
                for born in sorted(queue):
                    out = min(left, queue[born])
                    queue[born] -= out
                    left -= out
                own = 0.4 * r.arrived_tasks[site] - r.sent_tasks[site]
                wait = r.deferred_tasks[site]
                fresh = min(wait, own)
                for born, tasks in landed:
                    aged = min(wait - fresh, tasks)
                    queue[born] = queue.get(born, 0.0) + aged
                    fresh += wait - fresh - aged
                    seen += aged
                queue[t] = queue.get(t, 0.0) + fresh
                assert r.queue_tasks[site] == pytest.approx(sum(queue.values()), abs=1e-9)
                oldest = min((b for b, tasks in queue.items() if tasks > 1e-9), default=t)
                assert r.oldest_age_h[site] == (t - oldest) / 4
                flying.append((1 - site, t + 3, t, float(r.sent_tasks[site])))
    assert seen > 100


def test_a_fleet_is_the_same_alone_in_a_batch_and_from_a_saved_state() -> None:
    configs = make_configs(fleet_of(delay_steps=2, link_share_per_hour=0.1), count=3)
    rng = np.random.default_rng(1)
    actions = [(rng.uniform(-1, 1, 12), rng.uniform(0, 1, (12, 4))) for _ in range(40)]
    with Simulator(configs) as batch, Simulator(configs[4:8]) as alone, Simulator(configs) as later:
        batch.reset(seed=list(range(12)))
        alone.reset(seed=[4, 5, 6, 7])
        assert np.array_equal(batch.drivers.start[:4], alone.drivers.start)
        for t, (load, shares) in enumerate(actions):
            if t == 25:
                assert batch.state.in_flight.shape == (12, 2)
                assert batch.state.in_flight.min() > 0
                later.load_state_dict(batch.state_dict())
            result = batch.step(Actions(load=load, transfer=shares)).per_dc()
            one = alone.step(Actions(load=load[4:8], transfer=shares[4:8])).per_dc()
            for name, value in result.items():
                assert np.array_equal(value[4:8], one[name]), name
            if t >= 25:
                again = later.step(Actions(load=load, transfer=shares)).per_dc()
                assert all(np.array_equal(value, again[name]) for name, value in result.items())


CUT: dict[str, Any] = {
    "scheduled": [
        {"kind": "link_down", "site": "wa", "start_h": 2, "duration_h": 1},
        {"kind": "link_down", "start_h": 5, "duration_h": 0.5},
    ]
}
TO_WA = np.array([[0, 0, 0.2, 0.8], [0, 0, 0.2, 0.8], [0.2, 0, 0, 0.8], [0.5, 0.5, 0, 0]])


def test_nothing_is_sent_from_or_to_a_site_whose_links_are_down() -> None:
    config = fleet_of(delay_steps=2, link_share_per_hour=0.3)
    whole = make_configs(config, count=2)
    cut = make_configs(with_values(config, {"events": CUT}))
    actions = Actions(load=0.5, transfer=np.tile(TO_WA, (2, 1)))
    balance = np.zeros(2)
    with Simulator(whole) as before, Simulator([*whole[:4], *cut]) as sim:
        before.reset(seed=3)
        sim.reset(seed=3)
        for t in range(28):
            usual, result = before.step(actions), sim.step(actions)
            for name, value in result.per_dc().items():
                same = slice(0, 8 if t < 8 else 4)
                assert np.array_equal(value[same], usual.per_dc()[name][same]), (name, t)
            down = [3] if 8 <= t < 12 else [0, 1, 2, 3] if 20 <= t < 22 else []
            assert np.flatnonzero(sim.link_up() == 0).tolist() == [4 + site for site in down]
            assert np.flatnonzero(result.active_events).tolist() == [4 + site for site in down]
            flow, landed = sim.flows_tasks()[1], result.landed_tasks[4:]
            assert not flow[down].any()
            assert not flow[:, down].any()
            assert np.all(result.refused_tasks[4:][down] > 0)
            # Work on its way arrives, two steps after it left.
            assert (landed[3] > 0) == (2 <= t < 10 or 14 <= t < 22 or t >= 24), t
            if len(down) < 4:
                assert flow[0, 2] > 0
            balance += (result.arrived_tasks - result.executed_tasks).reshape(2, 4).sum(axis=1)
            balance -= (result.dropped_tasks + result.lost_tasks).reshape(2, 4).sum(axis=1)
            waiting = (result.queue_tasks + result.in_flight_tasks).reshape(2, 4).sum(axis=1)
            np.testing.assert_allclose(balance, waiting, rtol=0, atol=1e-9)


def test_links_of_each_site_fail_on_their_own() -> None:
    rule = {"kind": "link_down", "per_year": 2000, "duration_h": [1, 2]}
    config = with_values(fleet_of(), {"events": {"sampled": [rule]}})
    with Simulator(config) as sim:
        sim.reset(seed=1)
        rows = []
        for _ in range(200):
            sim.step(Actions(transfer=TO_WA))
            rows.append(sim.link_up())
            senders, receivers = sim.flows_tasks()[0].nonzero()
            assert np.all(rows[-1][[*senders, *receivers]] > 0)
            assert len(senders) or rows[-1].sum() < 3
    up = np.array(rows)
    assert np.all(up.mean(axis=0) < 0.9)
    assert len(np.unique(up, axis=1).T) == 4


def test_a_fleet_that_sends_nothing_is_its_sites_alone() -> None:
    fleet = build_fleet(fleet_of())
    lone = [config.model_copy(update={"fleet": None}) for config in fleet.configs]
    with Simulator(fleet) as sim, Simulator(lone) as others:
        sim.reset()
        others.reset(start=sim.drivers.start)
        for _ in range(30):
            together, apart = sim.step(Actions(load=-0.5)), others.step(Actions(load=-0.5))
            for name, value in together.per_dc().items():
                assert np.array_equal(value, apart.per_dc()[name]), name


def test_sites_of_a_fleet_share_a_clock_in_utc() -> None:
    # Noon local standard time of day 0 at NY and CA.
    noon_utc = local_start(np.array([17, 20]), np.array([-5.0, -8.0]), 1)
    assert noon_utc.tolist() == [12, 12]
    assert local_start(np.array([0, 0]), np.array([-5.0, 5.5]), 2).tolist() == [17510, 11]
    config = with_values(fleet_of(["NY", "CA"]), {"site.start": "07-01"})
    with Simulator(config) as sim, Simulator(make_configs(load_config("tiny"), sites=["CA"])) as ca:
        times = sim.drivers.times(np.arange(1), 4)[0]
        assert times.astype(str).tolist() == ["2018-06-30T19:00:00.000", "2018-06-30T16:00:00.000"]
        sim.reset()
        local = sim.drivers.start[1:]
        assert sim.drivers.at(9).ci_g_per_kwh[1] == ca.drivers.ci_g_per_kwh.at(local + 9)[0]
        with pytest.raises(ConfigError, match="start 96 of ca: sites of a fleet begin at the same"):
            sim.reset(start=np.array([96, 96]))
        sim.reset(start=np.array([96, 84]))
    odd = with_values(config, {"simulation.steps_per_hour": 1})
    with pytest.raises(ConfigError, match=r"steps_per_hour 1: a site of the fleet is 5\.5 h from"):
        local_start(np.zeros(1, np.int64), np.array([5.5]), odd.simulation.steps_per_hour)


def test_energy_and_carbon_of_a_transfer_by_hand() -> None:
    config = fleet_of(["NY", "WA"], transfer_kwh_per_task=0.06)
    ones = np.ones((2, 4))
    drivers = drivers_from_arrays(
        20 * ones, 15 * ones, [[400.0] * 4, [200.0] * 4], [[1.0] * 4, [0.1] * 4]
    )
    with Simulator(config, drivers=drivers) as sim:
        sim.reset()
        result = sim.step(Actions(transfer=np.array([[0.0, 1.0], [0.0, 0.0]])))
        kwh = 40 * 0.06
        np.testing.assert_allclose(result.sent_tasks, [40, 0], rtol=1e-12)
        np.testing.assert_allclose(result.in_flight_tasks, [0, 40], rtol=1e-12)
        np.testing.assert_allclose(result.transfer_kwh, [kwh / 2, kwh / 2], rtol=1e-12)
        np.testing.assert_allclose(result.transfer_g, [200 * kwh, 100 * kwh], rtol=1e-12)
        np.testing.assert_allclose(result.carbon_g, result.grid_kwh * [400, 200], rtol=1e-12)
        result = sim.step()
        assert result.landed_tasks.tolist() == [0, 40]
        np.testing.assert_allclose(result.utilisation, [1.0, 0.5], rtol=1e-12)
        # A tenth of the facility energy of a task, from the power of the servers.
        ratio = build_fleet(fleet_of(["NY", "WA"], transfer_energy_ratio=0.1))
        kwh_per_task = Transfer(ratio, sim.sizing).kwh_per_task
        groups = [g for rack in config.rack_groups() for g in rack]
        servers_kw = sum(g.count * (g.full_w - g.idle_w) for g in groups) / 1e3
        pue = np.mean(sim.sizing.facility_w / sim.sizing.it_w)
        np.testing.assert_allclose(kwh_per_task, 0.1 * servers_kw / 4 / 100 * pue, rtol=1e-12)


def test_metrics_and_costs_of_a_fleet() -> None:
    budgets: dict[str, Any] = {"power_limit_ratio": 0.1, "carbon_limit_kg_per_day": 1.0}
    config = fleet_of(link_share_per_hour=0.1, **budgets)
    with Simulator(make_configs(config, count=2)) as sim:
        sim.reset()
        view = view_maker(sim)
        totals = empty_totals(sim.size, sim.step_h)
        shares = np.full((8, 4), 0.5)
        for _ in range(8):
            result = sim.step(Actions(transfer=shares))
            add_step(totals, result)
            found = Costs(["fleet_power", "fleet_carbon"], sim.fleet).of(result, view(result))
            for start in (0, 4):
                part = slice(start, start + 4)
                limit = 0.1 * sim.sizing.facility_w[part].sum() / 1e3 * sim.step_h
                excess = result.grid_kwh[part].sum() - limit
                assert excess > 0
                cost = found["cost_fleet_power"][part]
                np.testing.assert_allclose(cost.sum(), excess, rtol=1e-12)
                np.testing.assert_allclose(
                    cost / excess, result.grid_kwh[part] / result.grid_kwh[part].sum(), rtol=1e-12
                )
                emitted = (result.carbon_g + result.transfer_g)[part]
                np.testing.assert_allclose(
                    fleet_carbon(result, view(result))[part],
                    max(emitted.sum() - 1000 / 96, 0) * emitted / emitted.sum(),
                    rtol=1e-9,
                )
        first, total = metrics_per_dc(totals, sim.fleet)[0], metrics_of_fleet(totals, sim.fleet)
        assert first["moved_tasks"] == totals.sums["sent_tasks"][0]
        assert first["link_use"] == pytest.approx(totals.sums["sent_tasks"][0] / (10 * 8))
        assert total["link_use"] == pytest.approx(totals.sums["sent_tasks"].sum() / (80 * 8))
        assert total["transfer_g"] == totals.sums["transfer_g"].sum() > 0
        assert total["refused_tasks"] == totals.sums["refused_tasks"].sum() > 0
    lone = build_fleet(load_config("tiny"))
    for name in ("fleet_power", "fleet_carbon"):
        with pytest.raises(ConfigError, match=f"costs: {name} is always 0 without"):
            Costs([name], lone)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"sites": ["NY"]}, "fleet.sites: should be a list of at least 2 items, not 1"),
        ({"sites": ["NY", "ny"]}, "sites names NY twice"),
        ({"link_share_per_hour": {"NY-XX": 0.1}}, "link_share_per_hour names 'NY-XX'; valid is"),
        ({"link_share_per_hour": {"NY-NY": 0.1}}, "link_share_per_hour names 'NY-NY'"),
        ({"link_share_per_hour": -0.1}, "fleet.link_share_per_hour: should be greater than or"),
        ({"transfer_kwh_per_task": -1}, "fleet.transfer_kwh_per_task: should be greater than or"),
        ({"transfer_energy_ratio": -1}, "fleet.transfer_energy_ratio: should be greater than or"),
        ({"residency": [["AZ", "CA"], ["NY", "WA", "XX"]]}, "residency names 'XX'; valid is one"),
        ({"residency": [["AZ", "CA", "NY"]]}, "residency leaves WA alone"),
        ({"residency": [["AZ", "CA", "NY"], ["WA"]]}, "residency leaves WA alone"),
        ({"residency": [["AZ", "CA"], ["CA", "NY", "WA"]]}, "every site in exactly one group"),
        ({"delay_steps": 0}, "fleet.delay_steps: should be greater than or equal to 1"),
        ({"delay_steps": 97}, "fleet.delay_steps 97: work would arrive after its deadline"),
        ({"place": 4}, "place 4: valid is 0..3, or null"),
    ],
)
def test_bad_section(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        fleet_of(**fields)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"simulation.steps_per_hour": 1}, "simulation.steps_per_hour is 4 in az and 1 in ca"),
        ({"site.year": 2020}, "fleet: site.year of ca differs from that of az"),
        ({"site.start": "02-01"}, "fleet: site.start of ca differs"),
        ({"servers.fan_power_exponent": 2}, "fleet: hall and servers of ca differs"),
        ({"fleet.transfer_energy_ratio": 0.1}, "fleet: fleet of ca differs"),
        ({"fleet.delay_steps": 2}, "fleet: ca has 4 sites and delay_steps 2, az 4 and 1"),
        ({"fleet": None}, "fleet: ca has no section fleet"),
    ],
)
def test_sites_that_do_not_fit_together(values: dict[str, Any], message: str) -> None:
    configs = list(build_fleet(fleet_of()).configs)
    configs[1] = with_values(configs[1], values)
    with pytest.raises(ConfigError) as raised:
        build_fleet(configs)
    assert message in str(raised.value)


def test_other_bad_input() -> None:
    config = fleet_of()
    with pytest.raises(ConfigError, match=r"sites NY: tiny has fleet\.sites; valid is one of"):
        make_configs(config, sites=["NY"])
    unknown = {"scheduled": [CUT["scheduled"][0] | {"site": "XX"}]}
    with pytest.raises(ConfigError, match=r"0\.site 'XX': valid is one of AZ, CA, NY, WA$"):
        with_values(config, {"events": unknown})
    with pytest.raises(ConfigError, match=r"workload\.model tasks: a fleet needs fluid"):
        with_values(config, {"workload.model": "tasks"})
    with pytest.raises(ConfigError, match=r"site\.weather_file 'a\.epw' of tiny would be read"):
        build_fleet(with_values(config, {"site.weather_file": "a.epw"}))
    unlike = [config, with_values(config, {"fleet.sites": ["NY", "WA"]})]
    with pytest.raises(ConfigError, match="ny has 2 sites and delay_steps 1, az 4 and 1"):
        build_fleet([*build_fleet(unlike[0]).configs, *build_fleet(unlike[1]).configs])
    with Simulator(config) as sim, Simulator(load_config("tiny")) as lone:
        sim.reset()
        lone.reset()
        for wrong, message in (
            (np.zeros((4, 3)), r"action transfer: shape \(4, 3\), expected \(4, 4\)"),
            (np.full((4, 4), np.nan), "action transfer: nan; valid is a finite number"),
            ("all", "action transfer: 'all' are no numbers"),
        ):
            with pytest.raises(SdcError, match=message):
                sim.step(Actions(transfer=wrong))  # type: ignore[arg-type]
        with pytest.raises(SdcError, match="action transfer: given, but the data centers share no"):
            lone.step(Actions(transfer=np.zeros((1, 1))))
        # Part of a fleet runs alone, with the clock of the fleet.
        with Simulator(sim.fleet.configs[1:3]) as part:
            assert part.fleet.sites_per_fleet == 1
            assert np.array_equal(part.drivers.start, sim.drivers.start[1:3])
