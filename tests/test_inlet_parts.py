"""Why inlets are warm: the parts of an inlet temperature, and ``sdc-taichi hall why``."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from sdc_taichi import Simulator, load_config
from sdc_taichi.cli.hall import hall_app
from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.design_hall import solve_design_hall
from sdc_taichi.sim.inlet_parts import InletParts, Inlets, inlet_terms
from sdc_taichi.sim.intake_air import intake_air_of

FAILURES = (
    "hvac.crac.units=4",
    "events.scheduled=[{kind: crac_down, unit: 1, start_h: 0.5, duration_h: 2}, "
    "{kind: rack_fan_failure, rack: 7, share: 0.3, start_h: 0.5, duration_h: 2}]",
)
"""One of four units down and the fans of rack 7 failing, at the fourth step of a quarter hour."""
HALLS = {
    "open": ("corrected",),
    "contained": ("corrected", "hall.layout.containment=0.7", "hvac.crac.units=2"),
    "failures": ("corrected", *FAILURES),
    "transient": ("corrected", "simulation.thermal=transient", *FAILURES),
    "sparse": ("large",),
    "approach": ("sustaindc",),
}


def total_c(parts: InletParts) -> float:
    """The parts of an inlet, added up, in C."""
    others_k = parts.warming_k + parts.approach_k + parts.lag_k + parts.exhaust_k.sum()
    return float(parts.setpoint_c + others_k)


@pytest.mark.parametrize("name", HALLS)
def test_the_parts_add_up_to_the_inlets_of_the_kernels(name: str) -> None:
    preset, *overrides = HALLS[name]
    config = load_config(preset, overrides)
    twin = config.model_copy(update={"name": "twin"})
    with Simulator([config, twin], precision="f64") as sim:
        sim.reset()
        for _ in range(4):
            result = sim.step()
        groups_c = sim.server_groups().inlet_c[len(sim.fleet.server_offsets) // 2 :]
        ends = sim.fleet.group_offsets[: config.hall.racks + 1]
        hottest_c = np.maximum.reduceat(groups_c, ends[:-1])
        inlets = Inlets(sim.fleet, 1, intake_air_of(sim.fleet, sim.intake_air(), 1))
    for rack in {0, 7, config.hall.racks - 1, *inlets.hottest(3)}:
        parts = inlets.parts(rack)
        assert parts.inlet_c == pytest.approx(hottest_c[rack], abs=1e-9)
        assert total_c(parts) == pytest.approx(hottest_c[rack], abs=1e-9)
        why_k = parts.layout_k + parts.height_k + parts.shortfall_k + parts.approach_k
        assert why_k == pytest.approx(parts.rise_k, abs=1e-9)
        assert parts.unit_share.sum() == pytest.approx(1.0)
    if config.simulation.thermal == "quasi_steady":
        np.testing.assert_allclose(hottest_c, result.rack_inlet_max_c[-len(hottest_c) :])
        assert abs(parts.lag_k) < 1e-9
    first = inlets.hottest(1)[0]
    assert hottest_c[first] == pytest.approx(hottest_c.max())


def test_a_unit_that_is_down_shows_as_air_that_falls_short() -> None:
    parts = {}
    for name, overrides in (("well", FAILURES[:1]), ("down", FAILURES)):
        with Simulator(load_config("corrected", overrides), precision="f64") as sim:
            sim.reset()
            for _ in range(4):
                sim.step()
            parts[name] = Inlets(sim.fleet, 0, sim.intake_air()).parts(7)
    well, down = parts["well"], parts["down"]
    assert well.shortfall_k == pytest.approx(0.0, abs=1e-9)
    assert down.shortfall_k > 1.0
    assert down.unit_fresh_ratio[1] < 0.5 < well.unit_fresh_ratio[1]
    assert down.unit_share[1] < well.unit_share[1]
    assert (well.fan_airflow, down.fan_airflow) == (1.0, 0.3)


def test_containment_keeps_out_what_the_open_hall_lets_in() -> None:
    """At equal exhausts, r (1 - c) of the intake in place of r is exhaust."""
    inlets = solve_design_hall(load_config("corrected", ["hall.layout.containment=0.5"])).inlets
    parts = inlets.parts(3)
    assert parts.contained_k == pytest.approx(parts.layout_k + parts.height_k)
    closed = solve_design_hall(load_config("corrected", ["hall.layout.containment=1"])).inlets
    assert closed.parts(3).contained_k is None
    assert closed.parts(3).layout_k == 0.0


def test_the_nearest_racks_warm_an_inlet_most() -> None:
    hall = solve_design_hall(load_config("corrected"))
    parts = hall.inlets.parts(0)
    assert [rack for rack, _ in parts.sources(2)] == [1, 2]
    assert len(parts.sources()) == 5
    words = [text for text, _ in inlet_terms(parts, 5)]
    assert words[0] == "setpoint of its supply air"
    assert words[1] == "exhaust of rack 1 (row 0, place 1)"
    assert words[-2:] == ["exhaust of 14 other racks", "its own exhaust"]
    assert sum(k for _, k in inlet_terms(parts, 5)) == pytest.approx(parts.inlet_c, abs=0.02)


def test_command_names_a_rack_by_number_or_by_row_and_place() -> None:
    def call(*arguments: str) -> str:
        done = CliRunner().invoke(hall_app, ["why", *arguments])
        if done.exception is not None:
            raise done.exception
        return done.stdout

    text = call("--rack", "7")
    assert "rack 7 (row 1, place 2)" in text
    assert call("corrected", "--rack", "1:2") == text
    assert "exhaust of 14 other racks" in text
    values = json.loads(call("--rack", "7", "--json"))
    parts_k = values["warming_k"] + sum(values["exhaust_k"])
    assert values["setpoint_c"] + parts_k == pytest.approx(values["inlet_c"], abs=1e-9)
    hottest = json.loads(call("--json"))
    assert hottest["inlet_c"] >= values["inlet_c"]
    for bad in ("20", "4:0", "0:5", "-1", "x", "1:", "1:2:3"):
        with pytest.raises(ConfigError, match=r"valid is a rack 0\.\.19, or ROW:PLACE up to 3:4"):
            call("--rack", bad)
