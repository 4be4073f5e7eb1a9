"""Rules that send work between the sites of a fleet, on cases by hand."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from sdc_taichi import (
    Actions,
    Simulator,
    drivers_from_arrays,
    load_config,
    make_controller,
    simulate,
    with_values,
)
from sdc_taichi.control import commands_of
from sdc_taichi.control.geo import all_cleaner, all_to_cleanest, central_flows, three_cleanest
from sdc_taichi.control.view import view_maker
from sdc_taichi.optimum.fleet import emissions_g

CI = np.array([[500.0, 100.0, 300.0, 200.0], [10.0, 10.0, 10.0, 10.0]])
NO_LINK = np.full((2, 4, 4), np.inf)


def test_sites_that_decide_alone() -> None:
    first = all_to_cleanest(CI)
    assert first[0].tolist() == [[0, 1, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0]]
    three = three_cleanest(CI)[0] * 6
    assert three.tolist() == [[0, 2, 2, 2], [0, 0, 0, 0], [0, 3, 0, 3], [0, 6, 0, 0]]
    assert np.array_equal(all_cleaner(CI)[0] * 6, three)
    assert not first[1].any()


def test_the_central_rule_fills_the_cleanest_sites_first() -> None:
    flexible, free = np.array([[9.0, 9, 9, 9]] * 2), np.array([[5.0, 7, 1, 4]] * 2)
    flow = central_flows(CI, flexible, free, NO_LINK, np.zeros(2))
    # Site 0 sends 7 to 1 and 2 to 3; then 2 sends the last 2 places of 3.
    assert flow[0].tolist() == [[0, 7, 0, 2], [0, 0, 0, 0], [0, 0, 0, 2], [0, 0, 0, 0]]
    assert not flow[1].any()
    # 500 to 300 pays up to a ratio of 0.5, 300 to 200 up to 0.4.
    flow = central_flows(CI, flexible, free, NO_LINK, np.array([0.45, 0.0]))
    assert flow[0].tolist() == [[0, 7, 0, 2], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    link = NO_LINK.copy()
    link[0, 0, 1] = 0.0
    flow = central_flows(CI, flexible, free, link, np.zeros(2))
    assert flow[0].tolist() == [[0, 0, 1, 4], [0, 0, 0, 0], [0, 7, 0, 0], [0, 0, 0, 0]]


def test_the_central_rule_in_the_simulator() -> None:
    config = with_values(
        load_config("tiny", ["workload.flexible_share=0.5"]),
        {"fleet": {"sites": ["AZ", "NY", "WA"], "link_share_per_hour": {"AZ-WA": 0.1, "NY-WA": 1}}},
    )
    demand = [[0.8] * 4, [0.6] * 4, [0.5] * 4]
    ci = [[500.0] * 4, [400.0] * 4, [50.0] * 4]
    drivers = drivers_from_arrays([20.0] * 4, [15.0] * 4, ci, demand)
    with Simulator(config, drivers=drivers) as sim:
        sim.reset()
        view = view_maker(sim)
        spec = "geo=geo-central,load=greedy-ci"
        controller = make_controller(spec, sim.fleet)
        assert set(commands_of(controller)) == {"load", "transfer"}
        actions = controller.act(view(None))
        assert isinstance(actions, Actions)
        result = sim.step(actions)
        assert result.sent_tasks.tolist() == pytest.approx([10, 30, 0])
        assert result.in_flight_tasks.tolist() == pytest.approx([0, 0, 40])
        assert not result.refused_tasks.any()
        result = sim.step(controller.act(view(result)))
        assert result.utilisation.tolist() == pytest.approx([0.7, 0.3, 0.9])


def test_plans_of_a_fleet_save_as_much_as_rules_and_can_be_followed() -> None:
    config = with_values(
        load_config("tiny", ["workload.flexible_share=0.5", "site.start=07-09"]),
        {"fleet": {"sites": ["AZ", "IL", "WA"], "link_share_per_hour": 0.3}},
    )
    emitted = {}
    with Simulator(config) as sim:
        for name in ("idle", "geo-central", "geo-mpc"):
            totals = simulate(sim, make_controller(name, sim.fleet), 96)
            emitted[name] = emissions_g(
                sim, totals.sums["carbon_g"], totals.sums["transfer_g"], 96
            ).sum()
            assert not totals.sums["dropped_tasks"].any()
        assert totals.sums["sent_tasks"].sum() > 500
        assert totals.sums["refused_tasks"].sum() < 0.02 * totals.sums["sent_tasks"].sum()
        saved = {name: 1.0 - g / emitted["idle"] for name, g in emitted.items()}
        assert saved["geo-central"] > 0.05
        assert saved["geo-mpc"] > 0.95 * saved["geo-central"]
        # Two calls with one view return equal commands, and a reset discards the plan.
        first, second = (make_controller("geo-mpc", sim.fleet) for _ in range(2))
        sim.reset()
        view = view_maker(sim)(None)
        wanted = first.act(view)
        assert first.act(view) is wanted
        again = second.act(view)
        assert wanted.transfer is not None
        assert again.transfer is not None
        assert np.array_equal(wanted.transfer, again.transfer)


def test_the_study_of_fleets() -> None:
    path = Path(__file__).parents[1] / "examples" / "fleet_study.py"
    rows = runpy.run_path(str(path))["study"](0.4, [27], 32, ("AZ", "GA", "WA"))
    assert rows["both"][0] > rows["both"][1] > 10
    assert rows["time"][0] < rows["space"][0] < rows["both"][0]
    bounds = [rows[f"link {x}"][0] for x in (0.02, 0.05, 0.1, 0.2)]
    assert bounds == sorted(bounds)
    assert rows["ratio 1"][0] < rows["ratio 0.3"][0] < rows["ratio 0.06"][0] < rows["both"][0]
    assert rows["geo-all-cleaner"][1] < rows["geo-central"][1] < rows["both"][0]
    assert 0.9 * rows["both"][0] < rows["geo-mpc"][1] < rows["both"][0]
