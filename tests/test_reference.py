"""Recorded numbers against this program: trajectories of the released SustainDC, stage checks.

Folders come from SDC_REFERENCE_DIR (separated as in PATH; default: tests/reference). A folder holds
``physics_checks.json`` and ``trajectories/*.csv`` with a ``.json`` of the same name beside each.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model_steps import battery_step, chiller_step
from reference_folders import reference_folders
from sdc_taichi import (
    Actions,
    BatteryAction,
    CoolAction,
    DataCenterConfig,
    Drivers,
    LoadAction,
    Simulator,
    StepResult,
    build_fleet,
    drivers_from_arrays,
    load_config,
    preset_names,
)
from sdc_taichi.control.rules import trim_and_respond
from sdc_taichi.envs.rewards import collaborative_rewards
from sdc_taichi.exogenous.psychrometrics import humidity_ratio, stull_wet_bulb_c, wet_bulb_c
from sdc_taichi.hall import air_metrics
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.hall.mix_weights import layout_weights
from sdc_taichi.hall.recirculation import calibrate
from sdc_taichi.plant import chiller, cooling, tower, water, workload
from sdc_taichi.sim.drivers import FleetSeries
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions, HallSums, Precision
from sdc_taichi.sim.sizing import released_ranges
from sdc_taichi.types import F64, WaterQuantities
from work_steps import work_step

Check = dict[str, Any]
Values = dict[str, Any]

REQUIRED_GROUPS = {
    "dc", "sizing", "chiller", "battery", "water", "tower", "psychro", "workload", "setpoint",
    "recirc", "reward",
}  # fmt: skip

RHO_CP = 1.225 * 1006.0

LOAD = (LoadAction.DEFER, LoadAction.NEUTRAL, LoadAction.DRAIN)
COOLING = (CoolAction.LOWER, CoolAction.HOLD, CoolAction.RAISE)
BATTERY = (BatteryAction.CHARGE, BatteryAction.DISCHARGE, BatteryAction.IDLE)


FOLDERS = reference_folders()


def _label(folder: Path, name: str) -> str:
    return name if len(FOLDERS) == 1 else f"{folder.name}/{name}"


def read_checks() -> Iterator[tuple[str, Check]]:
    for folder in FOLDERS:
        path = folder / "physics_checks.json"
        if path.is_file():
            content = json.loads(path.read_text("utf-8"))
            for check in content["checks"] if isinstance(content, dict) else content:
                yield _label(folder, str(check["id"])), check


TRAJECTORIES = [
    (_label(folder, path.stem), path)
    for folder in FOLDERS
    for path in sorted(folder.glob("trajectories/*.csv"))
]
CHECKS = list(read_checks())


def test_folders_hold_recorded_numbers() -> None:
    for folder in FOLDERS:
        assert folder.is_dir(), f"{folder}: no such folder (SDC_REFERENCE_DIR)"
        kinds = ("trajectories/*.csv", "physics_checks.json", "*_*.csv", "energyplus/*.csv")
        found = [path for kind in kinds for path in folder.glob(kind)]
        assert found, f"{folder}: none of {', '.join(kinds)}"
    for _, path in TRAJECTORIES:
        assert path.with_suffix(".json").is_file(), f"{path}: no .json beside it"


# --- trajectories -------------------------------------------------------------------------------


def rack_config(
    racks: list[dict[str, Any]], location: str, overrides: tuple[str, ...] = ()
) -> DataCenterConfig:
    """Preset ``sustaindc`` with the racks of a recorded run, in its order.

    Approach temperatures belong to the position in the hall. The preset lists them for 20 racks; a
    smaller hall takes the first of them and a larger one repeats them, unless the file gives its
    own per rack.
    """
    count = len(racks)
    hall = load_config("sustaindc").hall
    rows = hall.rows if count == hall.racks else 1
    lists: dict[str, list[Any]] = {}
    for name in ("supply_approach_k", "return_approach_k"):
        preset = np.resize(np.asarray(getattr(hall, name), dtype=np.float64), count).tolist()
        lists[name] = [rack.get(name, value) for rack, value in zip(racks, preset, strict=True)]
    return load_config(
        "sustaindc",
        [
            f"hall.rows={rows}",
            f"hall.racks_per_row={count // rows}",
            *(f"hall.{name}={json.dumps(values)}" for name, values in lists.items()),
            f"hall.servers_per_rack={json.dumps([rack['servers'] for rack in racks])}",
            f"servers.power_w={json.dumps([[rack['full_w'], rack['idle_w']] for rack in racks])}",
            f"site.location={location.upper()}",
            *overrides,
        ],
    )


def recorded_drivers(outdoor_c: Any, wet_bulb: Any, ci: Any, demand: Any) -> Drivers:
    """Drivers of one data center with a wet bulb as recorded, be it above the dry bulb."""
    outdoor = np.atleast_1d(np.asarray(outdoor_c, dtype=np.float64))
    wet = np.atleast_1d(np.asarray(wet_bulb, dtype=np.float64))
    drivers = drivers_from_arrays(outdoor, np.minimum(wet, outdoor), ci, demand)
    return replace(drivers, wet_bulb_c=FleetSeries(wet, np.array([0]), np.array([len(wet)])))


INPUT_COLUMNS = {
    "step", "day", "hour", "workload", "dry_bulb_c", "wet_bulb_c", "ci_g_per_kwh", "action_ls",
    "action_dc", "action_bat",
}  # fmt: skip

OUTPUT_COLUMNS: dict[str, Callable[[StepResult], Any]] = {
    "shifted_workload": lambda r: r.utilisation[0],
    "tasks_in_queue": lambda r: r.queue_tasks[0],
    "tasks_dropped": lambda r: r.dropped_tasks[0],
    "tasks_processed": lambda r: r.drained_tasks[0],
    "overdue": lambda r: r.due_tasks[0],
    "oldest_age_days": lambda r: r.oldest_age_h[0] / 24,
    "average_age_days": lambda r: r.mean_age_h[0] / 24,
    "setpoint_c": lambda r: r.setpoint_c[0],
    "it_kw": lambda r: r.it_w[0] / 1e3,
    "ct_kw": lambda r: r.tower_fan_w[0] / 1e3,
    "compressor_kw": lambda r: r.chiller_w[0] / 1e3,
    "crac_fan_w": lambda r: r.crac_fan_w[0],
    "crac_cooling_w": lambda r: r.cooling_load_w[0],
    "cw_pump_w": lambda r: r.chilled_pump_w[0],
    "ct_pump_w": lambda r: r.condenser_pump_w[0],
    "return_c": lambda r: r.return_c[0],
    "mean_outlet_c": lambda r: r.outlet_mean_c[0],
    "outlet_first_c": lambda r: r.rack_outlet_c[0],
    "outlet_mid_c": lambda r: r.rack_outlet_c[len(r.rack_outlet_c) // 2],
    "outlet_last_c": lambda r: r.rack_outlet_c[-1],
    "water_l": lambda r: r.water_l[0],
    "soc": lambda r: r.soc[0],
    "dc_kwh": lambda r: r.facility_kwh[0],
    "grid_kwh": lambda r: r.grid_kwh[0],
    "co2_g": lambda r: r.carbon_g[0],
}
COUNTS = {"tasks_in_queue", "tasks_dropped", "tasks_processed", "overdue"}

# The released battery keeps its store in MWh with 8 decimals. An f32 load can move it to the
# neighbouring one, which a nearly empty battery shows as more than 1e-4 of what is left.
STORE_UNIT_MWH = 1e-8


@dataclass(frozen=True)
class Recorded:
    """A recorded run."""

    columns: dict[str, F64]
    about: dict[str, Any]

    @property
    def steps_per_hour(self) -> int:
        return round(1.0 / float((self.columns["hour"][1] - self.columns["hour"][0]) % 24.0))


def read_trajectory(path: Path) -> Recorded:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    values = np.array(rows[1:], dtype=np.float64).T
    about = json.loads(path.with_suffix(".json").read_text("utf-8"))
    return Recorded(dict(zip(rows[0], values, strict=True)), about)


def trajectory_config(run: Recorded) -> DataCenterConfig:
    sizing, per_hour = run.about["sizing"], run.steps_per_hour
    oldest_h = 24.0 * float(run.columns["oldest_age_days"].max())
    return rack_config(
        run.about["racks"],
        run.about["config"]["location"],
        (
            f"simulation.steps_per_hour={per_hour}",
            f"workload.flexible_share={sizing['flexible_ratio']}",
            f"workload.queue_limit_h={sizing['queue_max'] / workload.TASKS_PER_STEP / per_hour}",
            # Ages are exact up to the horizon, so it has to reach the oldest task of the run.
            f"workload.age_horizon_h={max(24.0, float(np.ceil(oldest_h)) + 1.0)}",
        ),
    )


def trajectory_simulator(run: Recorded, precision: Precision) -> Simulator:
    c = run.columns
    return Simulator(
        trajectory_config(run),
        drivers=recorded_drivers(
            c["dry_bulb_c"], c["wet_bulb_c"], c["ci_g_per_kwh"], c["workload"]
        ),
        precision=precision,
    )


def replay(run: Recorded, precision: Precision) -> dict[str, F64]:
    """Every output column, computed from the recorded inputs."""
    actions = zip(
        *(run.columns[f"action_{a}"].astype(int) for a in ("ls", "dc", "bat")), strict=True
    )
    with trajectory_simulator(run, precision) as sim:
        sim.reset()
        results = [sim.step(Actions(LOAD[l], COOLING[c], BATTERY[b])) for l, c, b in actions]  # noqa: E741
    return {name: np.array([f(r) for r in results]) for name, f in OUTPUT_COLUMNS.items()}


def deviations(found: F64, recorded: F64, rel: float, absolute: float = 1e-9) -> list[str]:
    """Texts of the steps at which two columns differ."""
    wrong = ~(np.abs(found - recorded) <= absolute + rel * np.abs(recorded))
    return [f"step {i}: {found[i]!r} for {recorded[i]!r}" for i in np.flatnonzero(wrong)]


@pytest.mark.parametrize("precision", ["f64", "f32"])
@pytest.mark.parametrize(("name", "path"), TRAJECTORIES, ids=[name for name, _ in TRAJECTORIES])
def test_trajectory(name: str, path: Path, precision: Precision) -> None:
    run = read_trajectory(path)
    unknown = set(run.columns) - INPUT_COLUMNS - set(OUTPUT_COLUMNS)
    missing = (INPUT_COLUMNS | set(OUTPUT_COLUMNS)) - set(run.columns)
    assert not unknown, f"{path}: columns {sorted(unknown)} are compared with nothing"
    assert not missing, f"{path}: columns {sorted(missing)} are missing"
    assert np.array_equal(run.columns["step"], np.arange(len(run.columns["step"])))
    rel = {"f64": 1e-6, "f32": 1e-4}[precision]
    problems = []
    for column, found in replay(run, precision).items():
        recorded = run.columns[column]
        if column in COUNTS:
            wrong = deviations(found, recorded, 0.0, 0.0)
        elif column == "soc" and precision == "f32":
            unit = 1.01 * STORE_UNIT_MWH / run.about["sizing"]["battery_capacity_mwh"]
            wrong = deviations(found, recorded, rel, unit)
        else:
            wrong = deviations(found, recorded, rel)
        if wrong:
            problems.append(f"{column}: {len(wrong)} steps differ, first {wrong[0]}")
    assert not problems, f"{name} ({precision}):\n" + "\n".join(problems)


@pytest.mark.parametrize(("name", "path"), TRAJECTORIES, ids=[name for name, _ in TRAJECTORIES])
def test_sizing_of_trajectory(name: str, path: Path) -> None:
    run = read_trajectory(path)
    with trajectory_simulator(run, "f64") as sim:
        low_w = released_ranges(sim.fleet, Hall(sim.fleet, "f64"))["it_w"][0]
        sized = sim.sizing
        found = {
            "ct_reference_air_flow_m3_s": sized.water_side.tower_air_m3s[0],
            "ct_rated_load_w": sized.water_side.tower_fan_w[0],
            "battery_capacity_mwh": sized.battery_kwh[0] / 1e3,
            "power_lb_kw": 0.9 * low_w[0] / 1e3,
            "power_ub_kw": sized.facility_w[0] / 1e3,
            "flexible_ratio": sim.fleet.values("workload.flexible_share")[0],
            "queue_max": sim.fleet.values("workload.queue_limit_h")[0]
            * run.steps_per_hour
            * workload.TASKS_PER_STEP,
        }
    assert found == pytest.approx(run.about["sizing"], rel=1e-9)


# --- single-stage checks ------------------------------------------------------------------------

Handler = Callable[[Check], Values]


def preset_of(check: Check) -> str:
    """The preset that a check's name of it stands for here."""
    named = str(check["preset"]).split("(")[0].strip()
    if named in preset_names():
        return named
    # The code at the paper's time differs from the released one in the environments around it.
    return "sustaindc" if named == "sustaindc-paper" else "corrected"


def preset_fleet_values(preset: str) -> Callable[[str], F64]:
    return build_fleet(load_config(preset)).values


def config_of_check(check: Check) -> DataCenterConfig:
    """The hall of a check: the paper's, with what the check says about racks and sizing."""
    given = check["inputs"]
    base = load_config("sustaindc")
    pairs = base.servers.power_pairs
    full = given.get("full_load_W_by_rack", [p[0] for p in pairs])
    idle = given.get("idle_W_by_rack", [p[1] for p in pairs])
    servers = base.hall.servers_per_rack
    assert isinstance(servers, int)
    overrides = []
    layout = re.search(r"(\d+)x(\d+)x(\d+)", str(given.get("config", "")))
    if layout:
        rows, per_row, servers = (int(n) for n in layout.groups())
        if rows * per_row != len(full):
            raise ValueError(f"{check['id']}: no server power for {rows} x {per_row} racks")
    for key, path in (
        ("min_sp", "hvac.setpoint.min_c"),
        ("max_sp", "hvac.setpoint.max_c"),
        ("max_ambient", "hvac.sizing.design_outdoor_c"),
        ("max_ambient_sizing", "hvac.sizing.design_outdoor_c"),
    ):
        if key in given:
            overrides.append(f"{path}={given[key]}")
    racks = [
        {"full_w": f, "idle_w": i, "servers": servers} for f, i in zip(full, idle, strict=True)
    ]
    return rack_config(racks, given.get("location", "NY"), tuple(overrides))


def check_dc(check: Check) -> Values:
    """One step of the whole simulator at a given setpoint, load and weather."""
    given = check["inputs"]
    config = config_of_check(check)
    wet_bulb = given.get("wet_bulb_C", given["ambient_C"])
    held = float(given["setpoint_C"])
    # Whole tasks would round the load; the fluid queue executes it as given.
    config = config.model_copy(
        update={
            "workload": config.workload.model_copy(
                update={"model": "fluid", "max_utilisation": 1.0}
            ),
            "hvac": config.hvac.model_copy(
                update={"setpoint": config.hvac.setpoint.model_copy(update={"initial_c": held})}
            ),
        }
    )
    drivers = recorded_drivers(
        [given["ambient_C"]], [wet_bulb], [300.0], [given["util_pct"] / 100.0]
    )
    with Simulator(config, drivers=drivers, precision="f64") as sim:
        sim.reset()
        r = sim.step()
    assert r.setpoint_c[0] == held, f"setpoint {held} lies outside the range of the preset"
    found = {
        "P_cpu": r.cpu_w[0],
        "P_fan": r.it_fan_w[0],
        "P_it": r.it_w[0],
        "T_out_mean": r.outlet_mean_c[0],
        "T_ret": r.return_c[0],
        "Q_cool": r.cooling_load_w[0],
        "P_comp": r.chiller_w[0],
        "P_ct": r.tower_fan_w[0],
        "CRAC_fan": r.crac_fan_w[0],
        "P_cw": r.chilled_pump_w[0],
        "P_ctp": r.condenser_pump_w[0],
        "PUE": r.pue[0],
        "water_L_15min": r.water_l[0],
    }
    table = {**found, "T_ret_rounded": found["T_ret"]}
    return {**found, "published": table, "full_precision": found}


def check_size(check: Check) -> Values:
    drivers = recorded_drivers(20, 15, 300, 0.5)
    with Simulator(config_of_check(check), drivers=drivers, precision="f64") as sim:
        sized, fleet = sim.sizing.water_side, sim.fleet
        count, full_w = fleet.group_rows[0][:2]
        return {
            "CT_REFERENCE_AIR_FLOW_RATE_m3s": sized.tower_air_m3s[0],
            "CT_FAN_REF_P_W": sized.tower_fan_w[0],
            "n_cpu": fleet.servers,
            "nameplate_W": float(np.sum(count * full_w)),
        }


def check_range(check: Check) -> Values:
    drivers = recorded_drivers(20, 15, 300, 0.5)
    with Simulator(config_of_check(check), drivers=drivers, precision="f64") as sim:
        ranges = released_ranges(sim.fleet, Hall(sim.fleet, "f64"))
        return {
            "max_battery_energy_Mwh": sim.sizing.battery_kwh[0] / 1e3,
            "power_lb_kW": 0.9 * ranges["it_w"][0][0] / 1e3,
            "power_ub_kW": sim.sizing.facility_w[0] / 1e3,
            "Zone Air Temperature(West Zone)": [
                0.9 * ranges["outlet_c"][0][0],
                1.1 * ranges["outlet_c"][1][0],
            ],
        }


def check_rack(check: Check) -> Values:
    given = check["inputs"]
    match = re.fullmatch(r"([\d.]+)/([\d.]+) W x(\d+)", given["rack"])
    assert match is not None, f"rack {given['rack']!r}"
    full_w, idle_w, servers = float(match[1]), float(match[2]), int(match[3])
    rack = {
        "full_w": full_w,
        "idle_w": idle_w,
        "servers": servers,
        "supply_approach_k": 0.0,
        "return_approach_k": 0.0,
    }
    config = rack_config([rack], "NY", ("hall.supply_approach_limits_k=null",))
    full_m3s = config.servers.fan_full_airflow_m3s
    assert full_m3s is not None
    sums = Hall(build_fleet(config), "f64").solve(
        Conditions(np.array([given["T_in"]]), np.array([given["util_pct"] / 100.0]))
    )
    return {
        "P_cpu": sums.cpu_w[0],
        "P_fan": sums.it_fan_w[0],
        "V_total": sums.it_airflow_m3s[0],
        "cpu_ratio": sums.cpu_w[0] / (servers * full_w),
        "fan_v_ratio": sums.it_airflow_m3s[0] / (servers * full_m3s),
    }


def check_released_chiller(check: Check) -> Values:
    given = check["inputs"]
    reference_cop = preset_fleet_values(preset_of(check))("hvac.chiller.reference_cop")
    machine = chiller_step(
        "released",
        given["load_W"],
        reference_w=given["max_cooling_cap"],
        chilled_water_c=0.0,
        condenser_c=0.0,
        outdoor_c=given["ambient_C"],
        reference_cop=reference_cop,
    )
    return {"P_W": machine.power_w[0]}


def _curve_chiller(
    model: str, check: Check, reference_cop: float
) -> tuple[chiller.ChillerResult, dict[str, Any]]:
    """A chiller's step, and the curve values it used on the way."""
    given = check["inputs"]
    used: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        for name in ("_electric", "_from_curves"):
            inner = getattr(chiller, name)

            def noted(*args: Any, _inner: Any = inner, **kwargs: Any) -> Any:
                used.update(kwargs)
                return _inner(*args, **kwargs)

            patch.setattr(chiller, name, noted)
        machine = chiller_step(
            model,
            given["load_W"],
            reference_w=given["Q_nom_W"],
            chilled_water_c=given.get("T_evap_out", given.get("T_evap_lvg")),
            condenser_c=given.get("T_cond_in", given.get("T_cond_ent", 0.0)),
            outdoor_c=given.get("T_amb", 0.0),
            reference_cop=reference_cop,
        )
    return machine, used


def check_electric_chiller(check: Check) -> Values:
    # Nominal COPs of the two EnergyPlus machines.
    model, reference_cop = {
        "WC": ("electric_water_cooled", 4.75),
        "AC": ("electric_air_cooled", 3.0),
    }[check["id"].split("-")[2]]
    machine, used = _curve_chiller(model, check, reference_cop)
    return {
        "DeltaTemp": used["delta_k"],
        "AvailNomCapRat": machine.available_w / check["inputs"]["Q_nom_W"],
        "FullLoadPowerRat": used["eir"] * reference_cop,
        "PLR": machine.plr,
        "P_W": machine.power_w,
        "Q_evap_W": machine.evaporator_w,
        "COP": machine.cop,
        "unmet_W": machine.unmet_w,
    }


def check_york_chiller(check: Check) -> Values:
    given = check["inputs"]
    machine, used = _curve_chiller("eir_york", check, given["COP_nom"])
    cycling = np.minimum(machine.plr / used.get("min_plr", 0.1), 1.0)
    full_load_w = machine.available_w * used["eir"] * cycling
    return {
        "capFunT": machine.available_w / given["Q_nom_W"],
        "EIRFunT": used["eir"] * given["COP_nom"],
        "EIRFunPLR": machine.power_w / full_load_w,
        "PLR": machine.plr,
        "P_W": machine.power_w,
        "COP": machine.cop,
    }


def check_yorkcalc(check: Check) -> Values:
    given = check["inputs"]
    approach = tower.yorkcalc_approach_k(
        given["Twb_C"], given["range_K"], given["FR_water"] / given["FR_air"]
    )
    return {"approach_K": approach}


def check_tower_fan(check: Check) -> Values:
    given = check["inputs"]
    flow = tower.design_water_kg_s(given["Q_rej_W"], range_k=given["range_K"])
    fan_w = given["fan_W_per_kgps"] * flow
    return {
        "m_water": flow,
        "P_fan_design_W": fan_w,
        "ratio_to_Qrej": fan_w / given["Q_rej_W"],
    }


def check_fan_cube(check: Check) -> Values:
    given = check["inputs"]
    ratio = np.array(given["FR_air"], dtype=np.float64)
    return {"P": tower.fan_power_w(ratio, design_fan_w=given["P_ref"])}


def _water_l(model: str, **given: Any) -> WaterQuantities:
    needed = {
        "rejected_w": 0.0,
        "range_k": 0.0,
        "water_kg_s": 0.0,
        "tower_airflow_m3s": 0.0,
        "outdoor_c": 0.0,
        "wet_bulb_c": 0.0,
        "pressure_pa": 0.0,
        "return_c": 0.0,
        "supply_setpoint_c": 0.0,
        "cycles_of_concentration": 5.0,
        "drift_share": 0.0,
        "dt_s": 900.0,
    }
    return water.WATER[model](water.WaterPoint(**{**needed, **given}))


def check_air_side_water(check: Check) -> Values:
    given = check["inputs"]
    weather = {
        "wet_bulb_c": given["Twb"],
        "return_c": given["T_ret"],
        "supply_setpoint_c": given["setpoint"],
    }
    return {
        "code_L_15min": _water_l("released", **weather).water_l,
        "paper_eq_L_15min": _water_l("paper", **weather).water_l,
    }


def check_water_balance(check: Check) -> Values:
    given = check["inputs"]
    assert given["h_fg"] == water.EVAPORATION_HEAT_J_PER_KG
    rejected_w = given["Q_cool_W"] * (1.0 + 1.0 / given["COP"])
    lost = _water_l(
        "mass_balance",
        rejected_w=rejected_w,
        range_k=given["range_K"],
        water_kg_s=tower.design_water_kg_s(rejected_w, range_k=given["range_K"]),
        cycles_of_concentration=given["COC"],
        drift_share=given["drift_frac_circ"],
        dt_s=given["dt_s"],
    )
    return {
        "evap_L": lost.evaporation_l,
        "blowdown_L": lost.blowdown_l,
        "drift_L": lost.drift_l,
        "makeup_L": lost.water_l,
        "L_per_kWh_heat": lost.water_l / (rejected_w * given["dt_s"] / 3.6e6),
    }


def check_released_battery(check: Check) -> Values:
    given = check["inputs"]
    capacity_kwh = given["cap_MWh"] * 1e3
    after = battery_step(
        "released",
        given["SoC"] * capacity_kwh,
        float(BATTERY[given["action"]].value),
        capacity_kwh=capacity_kwh,
        load_kw=given["dcload_MW"] * 1e3,
        dt_h=given["dt_h"],
    )
    return {
        "SoC_after": after.stored_kwh / capacity_kwh,
        "E_grid_kWh": after.grid_kwh,
        "CO2_g": after.grid_kwh * given["CI_g_kWh"],
    }


def check_clc_battery(check: Check) -> Values:
    given = check["inputs"]
    capacity_kwh = given["cap_MWh"] * 1e3
    charged, discharged = (
        battery_step(
            "clc",
            given["SoC"] * capacity_kwh,
            command,
            capacity_kwh=capacity_kwh,
            load_kw=1e6,
            dt_h=given["T_h"],
            charge_efficiency=given["eff_c"],
            discharge_factor=given["eff_d"],
            charge_limit_c_rate=given["c_lim"],
            discharge_limit_c_rate=given["d_lim"],
            upper_u_h=given["upper_u"],
            upper_v=given["upper_v"],
            lower_u_h=given["lower_u"],
            lower_v=given["lower_v"],
        )
        for command in (1.0, -1.0)
    )
    return {
        "P_charge_max_MW": charged.charge_kwh / given["T_h"] / 1e3,
        "SoC_after_max_charge": charged.stored_kwh / capacity_kwh,
        "P_discharge_max_MW": discharged.discharge_kwh / given["T_h"] / 1e3,
        "SoC_after_max_discharge": discharged.stored_kwh / capacity_kwh,
    }


def check_moist_air(check: Check) -> Values:
    given = check["inputs"]
    outdoor, humidity_pct, pressure = given["T_C"], 100.0 * given["RH"], given["p_Pa"]
    ratio = humidity_ratio(outdoor, humidity_pct, pressure)
    return {
        "psychrolib_Twb": wet_bulb_c(outdoor, humidity_pct, pressure),
        "stull_Twb": stull_wet_bulb_c(outdoor, humidity_pct),
        "W": ratio,
        # ASHRAE Fundamentals (2017), chapter 1, eq. 30.
        "h_J_kg": 1e3 * (1.006 * outdoor + ratio * (2501.0 + 1.86 * outdoor)),
    }


def check_load_shifting(check: Check) -> Values:
    given = check["inputs"]
    v = preset_fleet_values(preset_of(check))
    config = load_config(preset_of(check)).workload
    per_hour = load_config(preset_of(check)).simulation.steps_per_hour
    queue = np.zeros((1, round(config.age_horizon_h * per_hour) + 2))
    queue[:, -1] = given["queue0"]
    found = []
    for action in given["actions"]:
        work = work_step(
            config.model,
            np.array([float(given["w"])]),
            np.array([float(LOAD[action].value)]),
            queue,
            flexible_share=np.array([float(given["flex"])]),
            max_utilisation=v("workload.max_utilisation"),
            queue_limit=v("workload.queue_limit_h") * per_hour * workload.TASKS_PER_STEP,
            deadline_steps=v("workload.deadline_h") * per_hour,
        )
        queue = work.queue
        found.append([float(work.utilisation[0]), float(queue[0, -1])])
    return {"util_queue": found}


def check_setpoint(check: Check) -> Values:
    given = check["inputs"]
    v = preset_fleet_values(preset_of(check))
    move = cooling.SETPOINTS[load_config(preset_of(check)).hvac.setpoint.model]
    setpoint, found = np.array([float(given["start"])]), []
    run, last = np.zeros(1, dtype=np.int64), np.array([np.nan])
    for action in given["actions"]:
        setpoint, run, last = move(
            setpoint,
            np.array([float(COOLING[action].value)]),
            run,
            last,
            step_k=v("hvac.setpoint.step_k"),
            low_c=v("hvac.setpoint.min_c"),
            high_c=v("hvac.setpoint.max_c"),
        )
        found.append(float(setpoint[0]))
    return {"sp": found}


def check_collaboration(check: Check) -> Values:
    given = check["inputs"]
    return {
        "R": [r[0] for r in collaborative_rewards([np.array([r]) for r in given["r"]], given["a"])]
    }


def check_trim_and_respond(check: Check) -> Values:
    given = check["inputs"]
    setpoint, found = np.array([float(given["SP0"])]), []
    for requests in given["requests"]:
        setpoint = trim_and_respond(
            setpoint,
            np.array([float(requests)]),
            low_c=np.array([float(given["SPmin"])]),
            high_c=np.array([float(given["SPmax"])]),
            trim_k=given["trim"],
            respond_k=given["res"],
            max_respond_k=given["maxres"],
            ignored=given["I"],
        )
        found.append(float(setpoint[0]))
    return {"sp": found}


def even_hall(given: dict[str, Any]) -> DataCenterConfig:
    """A hall whose racks all draw the same power and air, at any inlet and load.

    Its approach temperatures are those of the check, so the airflow of the servers that closes on
    them is P/(rho cp dT_IT).
    """
    rows, per_row = 4, 5
    layout = re.match(r"(\d+)x(\d+)", str(given.get("layout", "")))
    if layout:
        rows, per_row = (int(n) for n in layout.groups())
    numbers = {
        "hall.supply_approach_k": given.get("a", [5.3] * 5 + [5.0] * 10 + [5.3] * 5),
        "hall.return_approach_k": given.get("d", [-3.7] * 5 + [-2.5] * 10 + [-3.7] * 5),
        "hall.recirculation.decay_m": given.get("lambda_m", 3.0),
        "hall.layout.rack_height_m": given.get("H_rack", 2.1),
        "hall.air_density_kg_m3": 1.225,
        "hall.recirculation.calibrate": "rack",
        "hvac.crac.supply_m3s_per_w": given.get("V_crac_per_W", 5.663e-5),
    }
    return load_config(
        "corrected",
        [
            f"hall.rows={rows}",
            f"hall.racks_per_row={per_row}",
            *(f"{path}={json.dumps(value)}" for path, value in numbers.items()),
            # 50 kW from 200 servers, whose fans draw nothing.
            "servers.power_w=[250, 10]",
            "servers.cpu_power_ratio_lb=[0, 1]",
            "servers.cpu_power_ratio_ub=[0, 1]",
            "servers.fan_airflow_ratio_lb=[1, 1]",
            "servers.fan_airflow_ratio_ub=[1, 1]",
            "servers.fan_reference_w=0",
        ],
    )


def solve_even(config: DataCenterConfig, crac_flow_ratio: float) -> tuple[HallSums, float]:
    """The even hall at full load and a share of its CRAC airflow, and its supply temperature."""
    speed, supply_c = np.array([crac_flow_ratio]), config.hvac.setpoint.max_c
    met = Conditions(np.array([supply_c]), np.ones(1), unit_low=speed, unit_high=speed)
    return Hall(build_fleet(config), "f64").solve(met), supply_c


def rti_of(sums: HallSums) -> float:
    """Return temperature index as a ratio."""
    it_rise_k = air_metrics.it_rise_k(sums.inlet_m3k_s, sums.outlet_m3k_s, sums.it_airflow_m3s)
    return float(air_metrics.rti(sums.units_return_c, sums.supply_c, it_rise_k)[0]) / 100.0


def check_recirculation_of_a_row(check: Check) -> Values:
    """A hall of one row whose supply air warms by what its racks leave of their own warming."""
    given = check["inputs"]
    per_w = 1.0 / (RHO_CP * (given["a"] + given["dT_IT"] + given["d"]))
    config = even_hall({"layout": "1x5", "a": given["a"], "d": given["d"], "V_crac_per_W": per_w})
    flows = calibrate(config)
    sums, _ = solve_even(config, 1.0)
    it_rise_k = (sums.cpu_w + sums.it_fan_w) / (RHO_CP * sums.it_airflow_m3s)
    assert it_rise_k == pytest.approx(given["dT_IT"], rel=1e-12)
    return {
        "r": float(np.mean(flows.exhaust_share)),
        "b": 1.0 - flows.fresh_share,
        "RTI_local": rti_of(sums),
    }


def check_recirculation_of_a_hall(check: Check) -> Values:
    given = check["inputs"]
    config = even_hall(given)
    places = floor_plan(config.hall).centre_m
    np.testing.assert_allclose(places - places[0], given["rack_centres"], atol=1e-12)
    flows, weights = calibrate(config), layout_weights(config.hall).dense()
    sums, supply_c = solve_even(config, 1.0)
    airflow = np.asarray(sums.rack_airflow_m3s)
    left = airflow - flows.mix_weights.apply_transposed(flows.exhaust_share * airflow)
    return {
        "r": flows.exhaust_share,
        "W_row0": weights[0],
        "mean_approach": sums.inlet_mean_c[0] - supply_c,
        "T_ret_minus_T_sup": sums.units_return_c[0] - supply_c,
        "T_ret_minus_mean_T_out": sums.units_return_c[0] - np.mean(sums.rack_outlet_c),
        "min_s_over_V": np.min(left / airflow),
        "bypass_frac": 1.0 - flows.fresh_share,
    }


def check_crac_flow(check: Check) -> Values:
    found: dict[str, list[float]] = {"mean_approach": [], "T_ret_minus_T_sup": [], "RTI": []}
    config = even_hall(check["inputs"])
    for ratio in check["inputs"]["f"]:
        sums, supply_c = solve_even(config, ratio)
        found["mean_approach"].append(sums.inlet_mean_c[0] - supply_c)
        found["T_ret_minus_T_sup"].append(sums.units_return_c[0] - supply_c)
        found["RTI"].append(rti_of(sums))
    return dict(found)


HANDLERS: dict[str, dict[str, Handler]] = {
    "dc": {"SDC-DC-": check_dc, "SDC-TAB-": check_dc},
    "sizing": {"SDC-SIZE-": check_size, "SDC-RANGE-": check_range},
    "server": {"SDC-RACK": check_rack},
    "chiller": {
        "SDC-CH-": check_released_chiller,
        "EP-CHE-WC-": check_electric_chiller,
        "EP-CHE-AC-": check_electric_chiller,
        "EIR-YT-": check_york_chiller,
    },
    "tower": {
        "CT-YORK-": check_yorkcalc,
        "CT-FAN-": check_tower_fan,
        "CT-CUBE": check_fan_cube,
    },
    "water": {"W-SDC-": check_air_side_water, "W-PHYS-": check_water_balance},
    "battery": {"B-SDC-": check_released_battery, "B-CLC-": check_clc_battery},
    "psychro": {"PSY-": check_moist_air},
    "workload": {"LS-": check_load_shifting},
    "setpoint": {"SP-": check_setpoint},
    "controller": {"G36-TR": check_trim_and_respond},
    "reward": {"RW-COLLAB": check_collaboration},
    "recirc": {
        "RC-ROW-": check_recirculation_of_a_row,
        "RC-CAL-": check_recirculation_of_a_hall,
        "RC-FLOW-": check_crac_flow,
    },
}
"""Built groups: how an id starts, and what computes its expected values."""


def handler_of(check: Check) -> Handler:
    """What computes a check.

    Raises:
        LookupError: a built group with an id that nothing computes.
    """
    for prefix, handler in HANDLERS[check["group"]].items():
        if str(check["id"]).startswith(prefix):
            return handler
    valid = ", ".join(HANDLERS[check["group"]])
    raise LookupError(f"{check['id']}: nothing computes this check of a built group ({valid})")


def tolerance_of(check: Check, path: tuple[str, ...]) -> tuple[float, float]:
    """Relative and absolute tolerance of an expected value."""
    name, given = path[-1], check["tolerance"]
    if path[0] == "published":
        kind = {"P": "abs_W", "T": "abs_T", "PUE": "abs_PUE"}[name.split("_")[0]]
        return 0.0, given[kind]
    named = {"psychrolib_Twb": "abs_psychrolib", "stull_Twb": "stull_abs"}.get(name)
    if named in given:
        return 0.0, given[named]
    if "rel" in given:
        return given["rel"], 1e-9 if given["rel"] >= 1e-9 else 1e-12
    if "abs" in given:
        return 0.0, given["abs"]
    return 1e-6, 0.0  # full precision beside a coarse tolerance for published figures


def differences(check: Check, found: Any, expected: Any, path: tuple[str, ...] = ()) -> list[str]:
    """Expected values that are not met, or that nothing was computed for."""
    if isinstance(expected, dict):
        out = []
        for name, value in expected.items():
            if name not in found:
                out.append(f"{'.'.join((*path, name))}: expected, but not computed")
            else:
                out += differences(check, found[name], value, (*path, name))
        return out
    rel, absolute = tolerance_of(check, path)
    have, want = np.asarray(found, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    if have.size != want.size:
        return [f"{'.'.join(path)}: {have.size} values for {want.size}"]
    have = have.reshape(want.shape)
    if np.all(np.abs(have - want) <= rel * np.abs(want) + absolute):
        return []
    return [
        f"{'.'.join(path)}: {have.tolist()} for {want.tolist()} (rel {rel:g}, abs {absolute:g})"
    ]


@pytest.mark.parametrize(("name", "check"), CHECKS, ids=[name for name, _ in CHECKS])
def test_check(name: str, check: Check) -> None:
    group = check["group"]
    if group not in HANDLERS:
        pytest.skip(f"{name}: group {group}: no handler computes it")
    problems = differences(check, handler_of(check)(check), check["expected"])
    assert not problems, f"{name}:\n" + "\n".join(problems)


def test_no_required_group_is_skipped() -> None:
    assert set(HANDLERS) >= REQUIRED_GROUPS
    for _, check in CHECKS:
        if check["group"] in HANDLERS:
            assert callable(handler_of(check))


def test_shipped_numbers_cover_every_required_group() -> None:
    content = json.loads((Path(__file__).parent / "reference/physics_checks.json").read_text())
    assert {check["group"] for check in content["checks"]} >= REQUIRED_GROUPS
