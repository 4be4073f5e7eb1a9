"""Malformed configurations and arguments: exit code 2 and one line that names the place."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from copy import copy
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel
from typer.testing import CliRunner

from sdc_taichi import ConfigError, DataCenterConfig, EnvOptions, SdcError, load_config
from sdc_taichi.benchmark.suite import Suite, load_suite
from sdc_taichi.cli.app import app
from sdc_taichi.config import validated
from sdc_taichi.config.sustaindc import _File as SustainDC
from sdc_taichi.learning.algorithms import LEARNING_SETTINGS
from sdc_taichi.learning.training_settings import TrainingSettings
from test_config import HALL, HVAC, SERVERS, dc_config, sustaindc_values


def fails(arguments: list[str], parts: list[str]) -> None:
    """Run, and expect one line of error that holds every part."""
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 2, done.output
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    for part in parts:
        assert part in line


# Configuration files


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["the top level is a NoneType", "valid is a mapping"]),
        ("- 1", ["the top level is a list", "valid is a mapping"]),
        ("hall: [1", ["not valid YAML", "line 1"]),
        ("hall: {rows: 1}\nhall: {rows: 2}\n", ["'hall' is given twice", "line 2"]),
        ("a: 1\n---\nb: 2\n", ["not valid YAML", "single document"]),
        ("!!python/object:os.system {}", ["not valid YAML", "python/object"]),
        ("extends: corected", ["extends: 'corected'", "corrected, fleet_of_eight, frontier_like"]),
        ("extends: ./other.yaml", ["extends: './other.yaml'", "is no file"]),
        ("extends: .", ["extends: '.'", "is no file", "valid is a preset"]),
        ("extends: [tiny]", ["extends: ['tiny'] is no name", "valid is a preset"]),
        ("hall: {rows: 2}", ["hall.racks_per_row: missing", "hall.supply_approach_k: missing"]),
        ("extends: tiny\nhvca: {}", ["hvca: unknown key", "did you mean 'hvac'?"]),
        (
            "extends: tiny\nhvac: {chiller: {mdel: york}}",
            ["hvac.chiller.mdel: unknown key", "did you mean 'model'?"],
        ),
        ("extends: tiny\nhall: null", ["hall:", "None"]),
        (
            "extends: tiny\nservers: {groups: [[{count: 1, full_w: 10, idle_w: 20}]]}",
            ["servers.groups.0.0: idle_w 20 must not exceed full_w 10"],
        ),
        (
            "extends: tiny\nservers: {groups: [[{count: 1, full_w: .inf, idle_w: 2}]]}",
            ["servers.groups.0.0.full_w", "finite number"],
        ),
        ("extends: tiny\nname: ''", ["name: ", "at least 1 character"]),
        ("extends: tiny\nname: ' '", ["name: ", "(got ' ')"]),
        (f"extends: tiny\nname: {'x' * 10_001}", ["name: ", "at most 10000 characters"]),
    ],
)
def test_yaml(tmp_path: Path, text: str, parts: list[str]) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    fails(["config", "check", str(path)], [f"{path}: ", *parts])


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    fails(["config", "show", str(binary)], [f"{binary}: byte 0 is 0xff; valid is UTF-8 text"])
    fails(["config", "show", str(tmp_path)], [f"{tmp_path}: is a folder; valid is a file"])
    missing = str(tmp_path / "no.yaml")
    fails(["config", "show", missing], [f"{missing}: no such file or preset"])
    fails(["config", "show", "corected"], ["corected", "did you mean 'corrected'?"])


# Overrides


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("=3", ["override '=3'", "section.key=value"]),
        ("hall.rows=: :", ["override 'hall.rows=: :'", "YAML"]),
        ("hall.rows", ["override 'hall.rows'", "section.key=value"]),
        ("site.seed=[1", ["is no YAML value"]),
        ("hvac={setpoint: {initial_c: 20, initial_c: 21}}", ["'initial_c' is given twice"]),
        ("hvc.setpoint.max_c=22", ["hvc: unknown key; did you mean 'hvac'"]),
        ("hall.supply_approach_k.4=1", ["index '4' is not in 0..3"]),
        ("hvac.tower.economiser_approach_k=2", ["must not be below approach_min_k 4"]),
        ("hvac.setpoint.initial_c=1:30", ["initial_c", "valid number", "'1:30'"]),
        ("hall.rows=0", ["hall.rows", "greater than or equal to 1", "0"]),
        ("hall.rows=2.5", ["hall.rows", "integer", "2.5"]),
        ("hall.rows=3", ["supply_approach_k has 4 entries, expected 6"]),
        ("hall.rows.x=3", ["override 'hall.rows.x=3'", "rows is a value"]),
        ("hall.supply_aproach_k=3", ["hall.supply_aproach_k", "did you mean 'supply_approach_k'?"]),
        ("hall.supply_approach_k=[1, 2]", ["supply_approach_k has 2 entries, expected 4"]),
        ("hall.rows=true", ["hall.rows", "number", "True"]),
        ("hall.capacity_mw=1e9", ["hall.capacity_mw", "less than or equal to 100000"]),
        ("hvac.total_of=[chiller, chiller]", ["hvac.total_of", "each one once"]),
        ("hvac.total_of=[]", ["hvac.total_of", "at least one device"]),
        ("hvac.chiller.coil_approach_k=50", ["coil_approach_k 50", "within 4..20 C"]),
        ("servers.groups.9.0.count=1", ["index '9' is not in 0..3"]),
        ("servers.groups.0.0.count=-1", ["servers.groups.0.0.count", "-1"]),
        ("servers.groups.0.0.cnt=1", ["servers.groups.0.0.cnt", "did you mean 'count'?"]),
        ("servers.groups=[[]]", ["servers.groups rack 0 is empty"]),
        ("servers.groups.1.1.load_weight=20", ["servers.groups rack 1: load_weight 20"]),
        ("servers.inlet_range_c=[28, 16]", ["servers.inlet_range_c", "low < high"]),
        ("servers.inlet_range_c=[1, 2]", ["servers.inlet_range_c", "at least 5 K apart"]),
        ("hvac.chiller.model=york", ["hvac.chiller.model", "eir_york", "'york'"]),
        ("hvac.total_of=[chiler]", ["hvac.total_of.0", "'chiller'", "'chiler'"]),
        ("hvac.setpoint.min_c=30", ["hvac.setpoint", "initial_c 18", "min_c 30"]),
        ("hvac.setpoint.initial_c=.nan", ["hvac.setpoint.initial_c", "finite"]),
        ("hvac.water.cycles_of_concentration=1", ["cycles_of_concentration", "1.01"]),
        ("battery.capacity_kwh=-1", ["battery.capacity_kwh", "-1"]),
        ("battery.lower_v=1", ["battery: lower_v 1 must be below upper_v 1"]),
        ("workload.deadline_h=48", ["workload: deadline_h 48", "age_horizon_h 24"]),
        ("site.start=02-29", ["site.start", "02-29", "MM-DD"]),
        ("site.location=5", ["site.location", "5"]),
        ("simulation.steps_per_hour=7", ["simulation.steps_per_hour", "7", "1, 2, 3, 4, 5, 6"]),
    ],
)
def test_overrides(override: str, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("tiny", [override])
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("hall.rows=2.5", ["hall.rows", "integer", "2.5"]),
        ("hall.capacity_mw=1e-6", ["hall.capacity_mw 1e-06", "without servers", "at least"]),
        ("workload.trace=alibba", ["trace 'alibba'", "alibaba_1"]),
        ("site.weather_file=/no/such.epw", ["/no/such.epw: no such file"]),
    ],
)
def test_commands_name_the_override(override: str, parts: list[str]) -> None:
    fails(["config", "check", "tiny", override], parts)
    fails(["config", "check", "tiny", "--set", override], parts)


# The SustainDC format


def one_cop(values: dict[str, Any]) -> None:
    """One COP instead of three keys, as a released file has."""
    for name in ("CHILLER_COP_BASE", "CHILLER_COP_K", "CHILLER_COP_T_NOMINAL"):
        del values[HVAC][name]
    values[HVAC]["CHILLER_COP"] = 6.0


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (one_cop, [f"{HVAC}.CHILLER_COP: unknown key", f"{HVAC}.CHILLER_COP_BASE: missing"]),
        (
            lambda v: v[HALL].update(NUM_ROWS=5),
            ["RACK_SUPPLY_APPROACH_TEMP_LIST has 6 entries, expected 15 (rows x racks_per_row)"],
        ),
        (lambda v: v[HALL].update(CPUS_PER_RACK=[200] * 5), ["CPUS_PER_RACK has 5 entries", "6"]),
        (lambda v: v[HALL].update(CPUS_PER_RACK=0.5), [f"{HALL}.CPUS_PER_RACK", "integer", "0.5"]),
        (lambda v: v[HALL].update(NUM_ROWS=[4]), [f"{HALL}.NUM_ROWS", "valid integer"]),
        (lambda v: v.pop(SERVERS), [f"{SERVERS}: missing"]),
        (lambda v: v.update(extra=1), ["extra: unknown key", HALL, HVAC, SERVERS]),
        (lambda v: v[HVAC].update(C_AIRR=1), [f"{HVAC}.C_AIRR", "did you mean 'C_AIR'?"]),
        (lambda v: v[HVAC].update(CT_PUMP_EFFICIENCY=0), ["CT_PUMP_EFFICIENCY", "greater than 0"]),
        (lambda v: v[HVAC].update(C_AIR=True), [f"{HVAC}.C_AIR", "not true or false"]),
        (lambda v: v[SERVERS].update(INLET_TEMP_RANGE=[16]), ["INLET_TEMP_RANGE.1: missing"]),
        (lambda v: v[SERVERS].update(INLET_TEMP_RANGE=[28, 16]), ["(28, 16)", "low < high"]),
        (lambda v: v[SERVERS].update(ITFAN_REF_P="x"), ["ITFAN_REF_P", "valid number", "'x'"]),
    ],
)
def test_dc_config(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], parts: list[str]
) -> None:
    values = sustaindc_values()
    change(values)
    path = dc_config(tmp_path, values)
    fails(["config", "check", str(path)], [f"{path}: ", *parts])


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ('"C_AIR": 1005, "C_AIR": 1006', "'C_AIR' is given twice"),
        ('"C_AIR": NaN', "NaN is no finite number"),
        ('"C_AIR": 1e999', "'1e999' is no finite decimal number"),
    ],
)
def test_json_that_is_not_valid(text: str, part: str, tmp_path: Path) -> None:
    path = dc_config(tmp_path, sustaindc_values())
    path.write_text(path.read_text().replace('"C_AIR": 1005', text))
    fails(["config", "check", str(path)], [f"{path}: not valid JSON", part])


# Sampling


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("3", ["the top level is a int", "valid is a mapping of fields"]),
        ("1: {choice: [1]}", ["key 1", "valid is a mapping of fields"]),
        ("a: [", ["not valid YAML"]),
        ("hvac.chiller.reference_cop: 5", ["sample hvac.chiller.reference_cop", "uniform"]),
        (
            "hvac.chiller.reference_cop: {unifrom: [5, 6]}",
            ["sample hvac.chiller.reference_cop: unknown kind 'unifrom'", "mean 'uniform'?"],
        ),
        ("hvac.chiller.reference_cop: {uniform: [6, 5]}", ["low <= high", "[6, 5]"]),
        ("hvac.chiller.reference_cop: {uniform: [5]}", ["needs [low, high]", "[5]"]),
        ("hvac.chiller.reference_cop: {choice: []}", ["choice needs a list", "[]"]),
        ("hvac.chiller.reference_cop: {uniform: [-1, 6]}", ["reference_cop", "(got -1)"]),
        ("hvac.chiler.model: {choice: [carnot]}", ["hvac.chiler", "did you mean 'chiller'?"]),
        ("hall.rows: {choice: [3]}", ["supply_approach_k has 4 entries, expected 6"]),
    ],
)
def test_sample(tmp_path: Path, text: str, parts: list[str]) -> None:
    path = tmp_path / "sample.yaml"
    path.write_text(text)
    arguments = ["simulate", "tiny", "--dcs", "2", "--out", str(tmp_path / "run")]
    fails([*arguments, "--sample", str(path)], [f"{path}: ", *parts])
    assert not (tmp_path / "run").exists()


# Arguments


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--days", "x"], ["--days"]),
        (["--days", "nan"], ["--days nan", "positive number of days"]),
        (["--days", "-1"], ["--days -1", "positive number of days"]),
        (["--days", "0"], ["--days 0", "positive number of days"]),
        (["--days", "0.3"], ["--days 0.3", "whole steps of 15 min", "n/96"]),
        (["--days", "1.5", "simulation.steps_per_hour=1", "--days", "0.1"], ["60 min", "n/24"]),
        (["--start", "13-01"], ["--start", "13-01", "MM-DD"]),
        (["--start", "02-29"], ["--start", "02-29", "MM-DD"]),
        (["--dcs", "0"], ["--dcs", "1"]),
        (["--dcs", "99999999999"], ["--dcs", "100000"]),
        (["--seed", "-1"], ["--seed", "0"]),
        (["--precision", "f16"], ["--precision", "'f16'", "'f32', 'f64'"]),
        (["--controller", "g37"], ["'g37'", "did you mean 'g36'?"]),
        (["--controller", "cooling=lookahead-3h"], ["does not act on cooling", "g36"]),
        (["--controller", "constant:30"], ["constant:30", "16..23 C"]),
        (["--site", "nyy"], ["site 'NYY'", "nearest: NY"]),
        (["--site", "ny,NY"], ["--site 'ny,NY'", "given twice", "--dcs"]),
        (["--site", "ny,,ca"], ["--site 'ny,,ca'", "empty name"]),
        (["--weather", "a.epw", "--weather", "b.epw"], ["--weather: 2 given for 1"]),
        (["--site", "ny,ca", "--carbon", "a.csv"], ["--carbon: 1 given for 2"]),
        (["--workload", "/no/such.csv"], ["/no/such.csv: no such file"]),
        (["large"], ["'large'", "second preset or file", "'tiny'"]),
        (["--set", "x"], ["override 'x'", "section.key=value"]),
        (["--controler", "g36"], ["--controler", "--controller"]),
        (["--days"], ["--days", "requires an argument"]),
    ],
)
def test_arguments(tmp_path: Path, arguments: list[str], parts: list[str]) -> None:
    out = tmp_path / "run"
    fails(["simulate", "tiny", "--days", "1", "--out", str(out), *arguments], parts)
    assert not out.exists()


def test_commands() -> None:
    fails(["simlate"], ["'simlate'", "'simulate'"])
    fails(["config", "chek"], ["'chek'", "'check'"])
    fails(["data", "show", "nyy"], ["'nyy'", "nearest: NY"])


def test_errors_fit_on_a_line_of_any_width() -> None:
    done = CliRunner().invoke(app, ["config", "check", "hall.x=1"], env={"COLUMNS": "40"})
    assert re.fullmatch(r"error: preset corrected: hall\.x: unknown key.*\n", done.stderr)


# Every field of every kind of settings

TYPED_RACKS = load_config(
    "corrected",
    [
        "hall.rack_types={gpu: {servers: [{count: 4, full_w: 900, idle_w: 90, fan_w: 15}]}}",
        "hall.rack_plan=[{type: gpu, rows: 0-3, racks: 0-4}]",
        "events.sampled=[{kind: heat_wave, offset_k: 5, per_year: 2, duration_h: [1, 3]}]",
        "tariff.periods=[{from_h: 8, to_h: 20, price_per_kwh: 0.2}]",
        "hvac.crac.unit_shares=" + str([[1.0]] * 20),
    ],
)
WRONG: tuple[Any, ...] = (
    *("x", "", -1e9, None, True),
    *([], [[1]], [[["x"]]], [1, 2, 3, "x"]),
    *({}, {"a": {}}, {5: 1}),
)
PYDANTIC_WORDS = re.compile(
    r"Input|[A-Z][a-z]+ should|instance of|constrained|function-|\w\[|unable to|Value error|Extra"
)


def unset(model: type[BaseModel], **values: Any) -> dict[str, Any]:
    """None for every field of a model, except for some values."""
    return {**dict.fromkeys(model.model_fields), **values}


SETTINGS: list[tuple[type[BaseModel], dict[str, Any]]] = [
    (DataCenterConfig, load_config("tiny").model_dump(mode="json")),
    (DataCenterConfig, TYPED_RACKS.model_dump(mode="json")),
    (SustainDC, sustaindc_values()),
    (EnvOptions, unset(EnvOptions)),
    (Suite, load_suite("carbon").model_dump(mode="json")),
    (TrainingSettings, unset(TrainingSettings, algorithm="happo")),
    *((model, unset(model)) for model in dict.fromkeys(LEARNING_SETTINGS.values())),
]


def places(values: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Path of every value, with the first entry of each list."""
    yield path
    inside = values.items() if isinstance(values, dict) else enumerate(values[:1] or [])
    for key, value in inside:
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))
        else:
            yield (*path, key)


def with_value(values: Any, path: tuple[Any, ...], value: Any) -> Any:
    if not path:
        return value
    changed = copy(values)
    changed[path[0]] = with_value(changed[path[0]], path[1:], value)
    return changed


@pytest.mark.parametrize(
    ("model", "values"), SETTINGS, ids=lambda each: getattr(each, "__name__", "")
)
def test_errors_of_every_field_are_in_words_of_the_file(
    model: type[BaseModel], values: dict[str, Any]
) -> None:
    told = 0
    for path in places(values):
        for wrong in WRONG:
            try:
                validated(model, with_value(values, path, wrong), "file")
            except SdcError as error:
                line = re.sub(r"\(got .*?\)|'.*?'", "", str(error))
                assert PYDANTIC_WORDS.search(line) is None, (path, wrong, line)
                assert "\n" not in line
                told += 1
    assert told > 5


@pytest.mark.parametrize(
    ("override", "said"),
    [
        (
            "hvac.crac.airflow_m3s=[a]",
            "hvac.crac.airflow_m3s.0: should be a valid number (got 'a')",
        ),
        (
            "hvac.crac.airflow_m3s=x",
            "hvac.crac.airflow_m3s: should be a valid number or a list (got 'x')",
        ),
        ("hvac.crac.airflow_m3s=-1", "hvac.crac.airflow_m3s: should be greater than or equal to"),
        ("hall.rack_types={int: {servers: []}}", "hall.rack_types.int.servers: should be a list"),
        (
            "hall.rack_types={int: {servers: [{count: 1, full_w: 500}]}}",
            "preset tiny: hall.rack_types.int.servers.0.idle_w: missing",
        ),
        ("hall.layout=5", "hall.layout: should be a mapping of fields (got 5)"),
        ("battery.capacity_kwh=[5]", "battery.capacity_kwh: should be a valid number (got [5])"),
        ("servers.power_w=[0.25, 0.1]", "(got 0.25); power is in W, not kW"),
        ("servers.groups.0.0.full_w=0.5", "(got 0.5); power is in W, not kW"),
        ("workload.workload_file=x.csv", "unknown key; did you mean 'site.workload_file'?"),
        ("site.trace=google_1", "unknown key; did you mean 'workload.trace'?"),
    ],
)
def test_errors_say_what_the_field_takes(override: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("tiny", [override])
    assert said in str(caught.value)
    assert ";" not in str(caught.value).replace(said, "")
    assert said.endswith("not kW") or "W, not kW" not in str(caught.value)


@pytest.mark.parametrize(
    ("override", "field"),
    [
        ("workload.trace=/data/file.csv", "site.workload_file"),
        ("workload.trace=file.csv", "site.workload_file"),
        ("site.location=./NY.epw", "site.weather_file"),
    ],
)
def test_files_in_place_of_names_are_told_their_field(override: str, field: str) -> None:
    fails(["simulate", "tiny", "--days", "1", override], [override.partition("=")[2], field])
