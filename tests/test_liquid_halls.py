"""Liquid-cooled racks in a simulator: balances of every step, commands, failures and bad input."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ledgers import LEDGERS, OF_LIQUID, TRANSIENT_LEDGERS, Run, quantities, residual, stocks
from sdc_taichi import (
    Actions,
    ConfigError,
    DataCenterConfig,
    SdcError,
    Simulator,
    load_config,
    make_configs,
)
from sdc_taichi.config import apply_overrides
from sdc_taichi.config.loading import config_from_dict
from sdc_taichi.errors import OddInputWarning
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.sim.sizing import air_j_per_m3_k
from sdc_taichi.types import F64
from simulated import assert_same, part_of

HALL: dict[str, Any] = {
    "rows": 2,
    "supply_approach_k": 5,
    "return_approach_k": -4,
    "racks_per_row": 6,
    "rack_types": {
        "gpu": {"model": "gb200_nvl72"},
        "web": {"servers": {"count": 18, "full_w": 600, "idle_w": 170, "design_rise_k": 13}},
    },
    "rack_plan": [{"type": "gpu", "racks": "0-2"}, {"type": "web", "racks": "3-5"}],
}
FAILURES = [
    {"kind": kind, "per_year": 1200, "duration_h": [0.2, 3.0], **more}
    for kind, more in (
        ("cdu_down", {}),
        ("cdu_pump_down", {}),
        ("facility_pump_down", {"share": 0.4}),
        ("cooler_down", {"share": 0.3}),
        ("chiller_derate", {"share": 0.3}),
        ("pump_down", {"share": 0.3}),
        ("grid_outage", {}),
    )
]


def liquid_hall(name: str = "a", **sections: Any) -> DataCenterConfig:
    """A hall of six liquid-cooled and six air-cooled racks, with values of some sections."""
    values = load_config("corrected").model_dump(mode="json")
    values["name"] = name
    values["servers"] |= {"power_w": None}
    values["hall"] |= HALL | {"servers_per_rack": 200}
    values["liquid"] = {}
    values["hvac"]["crac"] |= {"units": 3, "spare_units": 1}
    for section, more in sections.items():
        values[section] = more if section in ("liquid", "events") else values[section] | more
    return config_from_dict(values, name)


def with_doors(effectiveness: float = 0.6) -> dict[str, Any]:
    """Values of section ``hall`` in which the air-cooled racks have rear doors."""
    types: dict[str, Any] = HALL["rack_types"]
    web = types["web"] | {"rear_door": {"effectiveness": effectiveness}}
    return {"rack_types": types | {"web": web}}


TRIMS: list[dict[str, Any]] = [
    {"trim_kw": 0.0},
    {"trim_kw": 300.0},
    {"trim_kw": 300.0, "trim_by": "plant"},
]


def random_hall(rng: np.random.Generator, name: str, thermal: str) -> DataCenterConfig:
    kind = str(rng.choice(["none", "direct", "heat_pump"]))
    return liquid_hall(
        name,
        hall=with_doors(float(rng.uniform(0.1, 1.0))) if rng.integers(2) else {},
        simulation={"thermal": thermal},
        site={"location": str(rng.choice(["AZ", "NY", "WA"])), "start": "07-01"},
        workload={"placement": "uniform", "max_utilisation": 1.0},
        liquid={
            "cdus": {"manifolds": int(rng.integers(1, 4)), "per_manifold": 2},
            "setpoint_c": float(rng.uniform(20, 45)),
            "dew_point_c": [None, 15.0][rng.integers(2)],
            "facility": {
                "rejection": str(rng.choice(["dry", "adiabatic", "tower"])),
                **TRIMS[rng.integers(3)],
            },
            "reuse": {
                "kind": kind,
                "share": float(rng.uniform(0, 1)) * (kind != "none"),
                "price_per_kwh_heat": float(rng.uniform(-0.1, 0.1)),
            },
        },
        # In transient halls lines lose heat to the room also while racks and fans have no power.
        events={"sampled": FAILURES if thermal == "quasi_steady" else FAILURES[:-1]},
    )


def wild_actions(rng: np.random.Generator, size: int, cdus: int) -> Actions:
    return Actions(
        load=rng.uniform(-1, 1, size),
        cooling=rng.integers(-1, 2, size).astype(float),
        battery=rng.uniform(-1, 1, size),
        cdu_setpoint_c=rng.uniform(20, 45, cdus),
        cdu_flow=rng.uniform(0.4, 1.1, size),
        facility_approach_k=rng.uniform(2, 15, size),
        reuse_share=rng.uniform(0, 1, size),
        power_cap=rng.uniform(0.5, 1, size),
    )


def recorded(
    configs: list[DataCenterConfig],
    steps: int,
    act: Callable[[np.random.Generator, int, int], Actions | None] = wild_actions,
) -> Run:
    rng, rows = np.random.default_rng(3), []
    with Simulator(configs, precision="f64", limits="flag") as sim:
        start, battery_kwh = stocks(sim.reset(seed=2)), sim.sizing.battery_kwh
        for _ in range(steps):
            result = sim.step(act(rng, sim.size, sim.fleet.cdus))
            assert np.all(result.within_limits == 1.0)
            rows.append(quantities(sim.fleet, result))
        air = air_j_per_m3_k(sim.fleet)
        values: dict[str, F64] = {name: np.stack([r[name] for r in rows]) for name in rows[0]}
        counted = configs[0].electrical.losses == "counted"
        no_flows = np.zeros((0, sim.size))
        return Run(values, start, sim.fleet.values, air, sim.step_h, counted, no_flows, battery_kwh)


@pytest.mark.filterwarnings("ignore::sdc_taichi.errors.OddInputWarning")
@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_every_balance_closes_in_every_step(thermal: str) -> None:
    rng = np.random.default_rng(11)
    run = recorded([random_hall(rng, f"h{i}", thermal) for i in range(6)], 160)
    for name in LEDGERS if thermal == "quasi_steady" else TRANSIENT_LEDGERS:
        worst = residual(LEDGERS[name](run), floor=1e-3).max()
        assert worst < 1e-9, (name, worst)
    for name, count in OF_LIQUID.items():
        terms = LEDGERS[name](run)
        for i in range(len(terms) - count, len(terms)):
            never = (name, i) == ("water", len(terms) - 1)  # No rack leaks here.
            never |= thermal == "quasi_steady" and (name, i) == ("liquid", len(terms) - 1)
            without = [term for k, term in enumerate(terms) if k != i]
            assert never or residual(without, floor=1e-3).max() > 1e-6, (name, i)
    # The run reaches what the balances are for.
    reached = "reuse_w", "heat_pump_w", "trim_chiller_w", "liquid_to_plant_w", "cooler_water_l"
    for name in (*reached, "throttled_tasks"):
        assert run[name].max() > 0.0, name
    assert run["tripped_racks"].max() > 0.0
    assert (run["liquid_stored_w"] != 0.0).any() == (thermal == "transient")


@pytest.mark.filterwarnings("ignore::sdc_taichi.errors.OddInputWarning")
@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_a_data_center_is_the_same_alone_in_a_batch_and_after_a_snapshot(thermal: str) -> None:
    rng = np.random.default_rng(5)
    liquid = [random_hall(rng, f"h{i}", thermal) for i in range(2)]
    air = load_config("corrected", ["name=air", f"simulation.thermal={thermal}"])
    units = ["hvac.crac.units=3", "hvac.crac.spare_units=1", "site.start=07-01"]
    configs = [liquid[0], apply_overrides(air, units), liquid[1]]
    steps, half, cooled_w = 24, 12, np.zeros(3)
    with Simulator(configs) as sim, Simulator(liquid[1]) as alone, Simulator(configs) as later:
        sim.reset(seed=4)
        alone.reset(seed=4)
        for t in range(steps):
            if t == half:
                later.load_state_dict(sim.state_dict())
            wanted_c, cap = 25.0 + t % 7, 0.5 + 0.1 * (t % 5)
            actions = Actions(cdu_setpoint_c=wanted_c, cdu_flow=0.7, power_cap=cap)
            result = sim.step(actions)
            assert_same([alone.step(actions)], [part_of(result, configs, 2)])
            cooled_w = np.maximum(cooled_w, result.liquid_heat_w)
            if t >= half:
                assert_same([later.step(actions)], [result])
        assert np.all(cooled_w[[0, 2]] > 0.0)
        assert result.liquid_heat_w[1] == result.cdu_pump_w[1] == 0.0


def test_a_rack_trips_without_coolant_and_restarts_once_it_flows_again() -> None:
    listed = [
        {"kind": "cdu_down", "start_h": 1, "duration_h": 1},
        {"kind": "leak", "start_h": 4, "duration_h": 1, "rack": 1, "litres": 30},
    ]
    config = liquid_hall(simulation={"steps_per_hour": 12}, events={"scheduled": listed})
    with Simulator(config) as sim:
        sim.reset()
        racks = sim.fleet.liquid_racks
        steps = [sim.step(Actions(cdu_flow=1.0)) for _ in range(80)]
    status = np.stack([step.rack_status for step in steps])
    liquid = status[:, racks] == 2
    air = np.delete(status, racks, axis=1)
    assert not liquid[:12].any()
    assert liquid[12:24].all()
    assert not air.any()
    assert steps[12].lost_tasks[0] > 0
    assert steps[12].trip_s[0] == 0.0
    assert steps[13].liquid_heat_w[0] == 0.0
    assert steps[13].cdu_pump_w[0] == 0.0
    assert not liquid[47].any(), "all racks run again within the next hours"
    assert liquid[48:60, 1].all()
    assert liquid[48:60].sum() == 12
    assert [step.leak_l[0] for step in steps[47:51]] == [0.0, 30.0, 0.0, 0.0]
    assert steps[48].water_l[0] > 30.0
    assert not liquid[-1].any()


def test_a_transient_hall_starts_from_the_steady_heat_of_its_liquid_racks() -> None:
    with Simulator(liquid_hall(simulation={"thermal": "transient"})) as sim:
        sim.reset()
        first = sim.step()
        assert first.liquid_air_w[0] > 1e4
        assert abs(first.thermal_storage_w[0]) < 1.0
        assert abs(first.liquid_stored_w[0]) < 1.0


def test_the_plant_of_the_crac_units_can_take_what_the_cooler_leaves() -> None:
    outage = {"kind": "chiller_derate", "start_h": 14, "duration_h": 1, "share": 0.0}

    def hall(trim_by: str, **more: Any) -> DataCenterConfig:
        return liquid_hall(
            trim_by,
            site={"location": "AZ", "start": "07-10"},
            liquid={"setpoint_c": 24, "facility": {"trim_kw": 1500, "trim_by": trim_by}},
            **more,
        )

    events = {"events": {"scheduled": [outage]}}
    configs = [hall("chiller", **events), hall("plant", **events), hall("plant")]
    with Simulator(configs, precision="f64") as sim:
        sim.reset()
        sized = sim.sizing.water_side
        assert sized.cooling_w[1] == pytest.approx(sized.cooling_w[0] + 1500e3)
        assert sized.coils_w[1] == pytest.approx(sized.coils_w[0])
        steps = [sim.step() for _ in range(64)]
        # Facility water stays warmer than the chilled water, whose temperature follows the air.
        sim.step(Actions(cdu_setpoint_c=20.0, facility_approach_k=15.0))
        for _ in range(8):
            coldest = sim.step(Actions(cooling=1.0, facility_approach_k=15.0))
    hot = steps[52]
    assert hot.outdoor_c[0] > 35.0
    assert not hot.cooler_fan_w.any(), "air that is warmer than the water would heat it"
    np.testing.assert_allclose(hot.facility_supply_c, 20.0)
    assert hot.liquid_to_plant_w[1] == pytest.approx(hot.trim_load_w[0])
    assert hot.trim_load_w[1] == hot.trim_chiller_w[1] == hot.liquid_to_plant_w[0] == 0.0
    taken_w = hot.economiser_w + hot.chiller_load_w
    assert taken_w[1] - taken_w[0] > 0.99 * hot.trim_load_w[0]
    assert hot.evaporation_l[1] > 1.5 * hot.evaporation_l[0]
    # Without chillers the water warms up, unless the loop has one of its own.
    failed = steps[57]
    assert failed.liquid_to_plant_w[1] == 0.0 < failed.liquid_to_plant_w[2]
    assert failed.facility_supply_c[1] > failed.facility_supply_c[0] + 10.0
    np.testing.assert_allclose(coldest.facility_supply_c[2], coldest.chilled_water_c[2] + 2.0)
    assert coldest.facility_supply_c[0] < coldest.facility_supply_c[2]


def test_a_transient_hall_keeps_its_air_while_the_plant_cools_facility_water() -> None:
    of_air = []
    for trim_by in ("chiller", "plant"):
        config = liquid_hall(
            simulation={"thermal": "transient"},
            site={"location": "AZ", "start": "07-10"},
            liquid={"setpoint_c": 24, "facility": {"trim_kw": 1500, "trim_by": trim_by}},
        )
        with Simulator(config) as sim:
            sim.reset()
            steps = [sim.step() for _ in range(60)]
        of_air.append([step.inlet_max_c[0] for step in steps])
    assert max(step.liquid_to_plant_w[0] for step in steps) > 1e5
    np.testing.assert_allclose(of_air[0], of_air[1], atol=0.05)


def test_steady_air_is_guessed_with_the_heat_that_coolant_leaves_to_it() -> None:
    configs = make_configs(load_config("ai_hall_2026"), count=2, sites=["NY", "AZ"])
    rng, sweeps = np.random.default_rng(0), []
    with Simulator(configs) as sim:
        sim.reset()
        for _ in range(24):
            setpoint_c, flow = rng.uniform(25.0, 45.0), rng.uniform(0.5, 1.1)
            cooling = rng.uniform(-1.0, 1.0, sim.size)
            sim.step(Actions(cooling=cooling, cdu_setpoint_c=setpoint_c, cdu_flow=flow))
            sweeps.append(sim.sweeps)
    assert np.mean(sweeps) < 1.5
    assert np.max(sweeps) <= 2


def test_steady_air_is_guessed_with_a_setpoint_for_each_unit() -> None:
    config, rng, sweeps = load_config("ai_hall_2026"), np.random.default_rng(0), []
    with Simulator(config) as sim:
        sim.reset()
        for _ in range(24):
            sim.step(Actions(cooling=rng.integers(-1, 2, sim.fleet.units).astype(float)))
            sweeps.append(sim.sweeps)
    assert np.mean(sweeps) < 2.3


def test_rear_doors_take_more_heat_from_the_air_the_colder_their_coolant() -> None:
    plain = liquid_hall("plain", liquid={"setpoint_c": 22})
    doors = [
        liquid_hall(f"at {setpoint_c}", hall=with_doors(), liquid={"setpoint_c": setpoint_c})
        for setpoint_c in (22, 30)
    ]
    sim = Simulator([plain, *doors])
    sim.reset()
    step = sim.step()
    web = np.array([rack % 6 > 2 for rack in range(12)] * 3).reshape(3, -1)
    taken_w = step.rack_liquid_w.reshape(3, -1)
    power_w = step.rack_cpu_w.reshape(3, -1)
    assert not taken_w[0][web[0]].any()
    for dc, coolant_c in ((1, 22.0), (2, 30.0)):
        # Effectiveness (1 + (room - coolant) / design rise), the room at 27 C.
        share = 0.6 * (1.0 + (27.0 - coolant_c) / 13.0)
        np.testing.assert_allclose(taken_w[dc][web[dc]], share * power_w[dc][web[dc]], rtol=1e-6)
    assert step.cooling_load_w[1] < step.cooling_load_w[2] < step.cooling_load_w[0]


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_racks_with_a_rear_door_run_on_in_air_without_coolant(thermal: str) -> None:
    listed = [
        {"kind": "facility_pump_down", "start_h": 2, "duration_h": 0.5, "share": 0.0},
        {"kind": "cdu_down", "start_h": 6, "duration_h": 0.5},
        {"kind": "leak", "start_h": 10, "duration_h": 0.5, "rack": 4, "litres": 30},
    ]
    types = {"web": with_doors()["rack_types"]["web"]}
    config = liquid_hall(
        hall={"rack_types": types, "rack_plan": [{"type": "web"}]},
        simulation={"thermal": thermal, "steps_per_hour": 12},
        events={"scheduled": listed},
        liquid={"setpoint_c": 25},
    )
    run = recorded([config], 132, lambda *_: None)
    for name in ("heat", "liquid", "cooling load", "coils", "server power"):
        worst = residual(LEDGERS[name](run), floor=1e-3).max()
        assert worst < 1e-12, (name, worst)
    assert not run["tripped_racks"].any()
    assert not run["junction_max_c"].any()
    for start in (24, 72):
        rise_k = run["inlet_max_c"][start + 5] - run["inlet_max_c"][start - 1]
        assert rise_k > 2.0
        # The racks warm the coolant until their doors take no more than the pipes lose.
        taken = run["liquid_heat_w"][start - 1 : start + 6, 0]
        assert taken[-1] < 0.05 * taken[0]
        np.testing.assert_allclose(run["liquid_air_w"][start + 5], run["cpu_w"][start + 5], 0.01)
    assert run["leak_l"].sum() == 30.0
    # The other eleven doors take heat while one is isolated.
    assert run["liquid_heat_w"][125] == pytest.approx(run["liquid_heat_w"][126] * 11 / 12, rel=0.02)


def test_work_of_limited_gpus_waits_in_the_queue() -> None:
    config = liquid_hall(workload={"flexible_share": 0.0, "queue_limit_h": 0.2})
    powers = ["gpu_idle_w=450", "gpu_max_w=1000"]
    config = apply_overrides(config, [f"hall.rack_types.gpu.liquid.{power}" for power in powers])
    with Simulator(config) as sim:
        sim.reset()
        free = sim.step()
        held = sim.step(Actions(power_cap=0.5))
        assert free.throttled_tasks[0] == free.queue_tasks[0] == 0.0
        assert 0.0 < held.queue_tasks[0] == held.throttled_tasks[0]
        assert held.executed_tasks[0] == pytest.approx(
            100 * held.utilisation[0] - held.throttled_tasks[0]
        )
        assert held.it_w[0] < free.it_w[0]
        for _ in range(30):
            held = sim.step(Actions(power_cap=0.5))
        # A full queue takes no more.
        assert held.queue_tasks[0] == pytest.approx(80.0)
        assert held.lost_tasks[0] > 0.0


def test_commands_move_setpoints_slowly_and_are_checked() -> None:
    with Simulator(liquid_hall(liquid={"dew_point_c": 24})) as sim:
        sim.reset()
        supplies = [sim.step(Actions(cdu_setpoint_c=20.0)).cdu_supply_c[0] for _ in range(12)]
        assert sim.state.cdu_setpoint_c.tolist() == [20.0, 20.0]
        np.testing.assert_allclose(supplies[:3], [38.0, 36.0, 34.0])
        assert supplies[-1] == pytest.approx(26.0), "two kelvins above the dew point"
        faults: list[tuple[str, Any, str]] = [
            ("cdu_setpoint_c", 46.0, r"46.0; valid is 20..45"),
            ("cdu_flow", [1.0, 0.3], r"0.3; valid is 0.4..1.1"),
            ("cdu_flow", 0.0, r"0.0; valid is 0.4..1.1"),
            ("power_cap", 0.4, r"0.4; valid is 0.5..1"),
            ("facility_approach_k", np.nan, r"nan; valid is 2..15"),
            ("reuse_share", [0.1, 0.2], r"shape \(2,\), expected \(\) or \(1,\)"),
        ]
        for name, value, message in faults:
            with pytest.raises(SdcError, match=rf"action {name}: {message}"):
                sim.step(Actions(**{name: value}))
    with Simulator(load_config("tiny")) as sim:
        sim.reset()
        with pytest.raises(SdcError, match="action cdu_flow: given, but no rack is liquid-cooled"):
            sim.step(Actions(cdu_flow=1.0))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["liquid=null"], "rack_types.gpu is liquid-cooled, but section liquid is missing"),
        (["hall.rack_types.gpu.model=gb"], "model 'gb' is no rack of the library; valid: gb200"),
        (["hall.rack_types.gpu.liquid.gpu_idle_w=1300"], "gpu_idle_w 1300 must not exceed gpu_max"),
        (["hall.rack_types.gpu.liquid.leak_per_k=0.02"], "leak_per_k 0.02 .* at most 0.5 K"),
        (["hall.rack_types.web.liquid={}"], "servers and liquid: both are given; valid is one"),
        (["liquid.cdus.manifolds=7"], "liquid.cdus.manifolds 7: valid is 1..6"),
        (["liquid.cdus.spare=2"], "spare 2 with per_manifold 2: valid is at most 1"),
        (["liquid.flow=0"], "liquid.flow: should be greater than or equal to 0.4"),
        (["liquid.setpoint_c=10"], "liquid.setpoint_c: should be greater than or equal to 20"),
        (["liquid.reuse.share=0.5"], "share 0.5 needs kind direct or heat_pump, not none"),
        (["liquid.reuse.network_return_c=80"], "network_supply_c 70 must be above network_return"),
        (["liquid.facility.trim_by=plant"], "trim_by plant needs trim_kw above 0"),
        (
            ["liquid.facility={trim_by: plant, trim_kw: 9}", "hvac.plant=air_side"],
            "hvac.plant air_side: its outdoor air cools no water; valid is plant water_cooled or",
        ),
        (["workload.model=tasks"], "liquid-cooled racks need workload.model fluid"),
        (
            ["events.scheduled=[{kind: leak, start_h: 1, duration_h: 1, rack: 4, litres: 3}]"],
            "events.scheduled.0.rack 4: is no liquid-cooled rack",
        ),
        (
            ["events.scheduled=[{kind: cdu_down, start_h: 1, duration_h: 1, unit: 2}]"],
            "events.scheduled.0.unit 2: valid is 0..1",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        apply_overrides(liquid_hall(), overrides)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["liquid.cdus.capacity_kw=500"], "1 CDUs for 689.9 kW .* they need 689.9 kW each"),
        (["liquid.dew_point_c=24", "liquid.setpoint_c=22"], "keeps the coolant at 26 C or above"),
        (["liquid.reuse.kind=heat_pump", "liquid.reuse.network_supply_c=110"], "74 K above the"),
        (["liquid.reuse.kind=direct", "liquid.reuse.network_return_c=60"], "so it gives no heat"),
        (["liquid.reuse={kind: direct, price_per_kwh_heat: -0.1}"], "pays for the heat"),
        (["hall.rack_types.gpu.liquid.gpu_idle_w=900"], "power caps below 0.75 have no effect"),
        (["liquid.facility.w_class=W17"], "W17: the dry cooler gives water of .* design day"),
    ],
)
def test_what_is_probably_a_mistake_warns(overrides: list[str], message: str) -> None:
    runtime.ensure_started()
    config = apply_overrides(liquid_hall(), overrides)
    with pytest.warns(OddInputWarning, match=message), Simulator(config) as sim:
        sim.reset()


def test_a_rear_door_stands_behind_servers_in_air() -> None:
    gpu = HALL["rack_types"]["gpu"] | {"rear_door": {}}
    with pytest.raises(ConfigError, match="rear_door with liquid: valid is a rear_door behind"):
        liquid_hall(hall={"rack_types": HALL["rack_types"] | {"gpu": gpu}})


def test_a_section_without_liquid_racks_is_refused() -> None:
    with pytest.raises(ConfigError, match="liquid is given, but no rack is liquid-cooled"):
        load_config("tiny", ["liquid={}"])


def test_an_assigned_model_brings_its_own_values() -> None:
    config = apply_overrides(liquid_hall(), ["hall.rack_types.gpu.model=frontier_cabinet"])
    rack = config.liquid_racks()[0]
    assert rack.design_it_w == pytest.approx(376e3, rel=1e-3)
    assert rack.design_liquid_w / rack.design_it_w == pytest.approx(0.945, abs=1e-3)
    gpu = liquid_hall().liquid_racks()[0]
    assert (gpu.design_it_w, gpu.design_liquid_w) == pytest.approx((132e3, 115e3), rel=1e-3)
