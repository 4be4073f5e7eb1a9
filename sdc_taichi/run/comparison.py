"""Comparison of the runs of one hall: what differs between them, and figures a year.

The first run is the reference: savings of the others are against it. R is the number of runs.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.config.electrical_schema import TariffConfig
from sdc_taichi.config.field_texts import docstrings
from sdc_taichi.errors import SdcError, suggestion
from sdc_taichi.exogenous.year_clock import HOURS_PER_YEAR
from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.run.failover import MINUTES, Failover, study_failover
from sdc_taichi.run.folder_reader import RunFolder, read_config_texts, read_configs, read_run

MAX_RUNS = 12
"""Largest number of runs of a comparison."""
MAX_COMPARED_CONFIGS = 6
"""Largest number of data centers whose configurations are compared field by field."""
MAX_STUDIED_DCS = 6
"""Largest number of data centers of a run whose failover is studied."""
_MOST_VALUE = 60
"""Largest number of characters of a differing value."""
_LEAST_WORK_SHARE = 1e-3
"""Smallest share of the executed work by which runs differ noticeably."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Field or input in which runs differ."""

    name: str
    """Name of the field or input."""
    meaning: str
    """Description of the field, from its documentation; empty for inputs."""
    values: tuple[str, ...]
    """Value in each run, as text, (R,)."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Figure of each run, of the whole year or of the run."""

    key: str
    """Name of the figure in JSON."""
    label: str
    """Name of the figure for readers, such as ``energy from the grid``."""
    unit: str
    """Unit of the values; empty for a number without unit."""
    values: tuple[float | None, ...]
    """Value of each run; None if it is unknown, (R,)."""
    has_savings: bool = False
    """True if smaller values are a saving, whose share of the first run is of interest."""

    def savings(self) -> tuple[float | None, ...]:
        """Return by how much each run is below the first; None if a value is unknown, (R,)."""
        first, *_ = self.values
        return tuple(
            None if first is None or value is None else first - value for value in self.values
        )


@dataclass(frozen=True, slots=True)
class Redundancy:
    """How many CRAC units of a hall can fail at full load before a rack throttles."""

    units: int
    """Largest number of units whose loss no rack throttles on, up to 2."""
    throttle_min: float | None
    """Minutes until a rack throttles if one more unit fails; None if no such loss was studied."""

    def text(self) -> str:
        """Return the number of units, and what happens if one more fails."""
        if self.throttle_min is None:
            return f"{self.units} or more"
        return f"{self.units} (throttles {self.throttle_min:.0f} min after one more)"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Runs of one hall beside each other; the first is the reference."""

    runs: Mapping[str, RunFolder]
    """The R runs, keyed by the user's name for each."""
    differences: tuple[Difference, ...]
    """Fields and inputs in which the runs differ."""
    figures: tuple[Figure, ...]
    """Figures of the runs, those that grow with time for a year."""
    costs: Mapping[str, float]
    """Cost of building a variant, in the currency of the tariff, keyed by name of the run."""
    redundancy: Mapping[str, Redundancy]
    """Result of failover studies, keyed by name of the run; empty if none were asked for."""
    notes: tuple[str, ...]
    """Sentences that a reader of the figures must know."""

    @property
    def names(self) -> list[str]:
        """Names of the runs, in order."""
        return list(self.runs)

    def payback_years(self) -> dict[str, float | None]:
        """Return the cost of each variant divided by the money that it saves a year.

        The value is None if the variant saves no money. Interest is not considered.
        """
        (money,) = [figure for figure in self.figures if figure.key == "cost"]
        saved = dict(zip(self.names, money.savings(), strict=True))
        return {
            name: cost / per_year if (per_year := saved[name] or 0.0) > 0 else None
            for name, cost in self.costs.items()
        }


def named_runs(words: Sequence[str]) -> dict[str, RunFolder]:
    """Read runs that are named on a command line as ``DIR`` or ``NAME=DIR``.

    The name of a run is NAME, or that of its folder, with as many parent folders as are necessary
    to distinguish it from the others.

    Raises:
        SdcError: a folder has no run or is given twice, or a name is given twice.
    """
    given: list[tuple[str, Path]] = []
    for word in words:
        name, equals, place = word.partition("=")
        is_named = bool(equals and name and place) and not os.path.exists(word)
        given.append((name if is_named else "", Path(place if is_named else word)))
    for index, (_, folder) in enumerate(given):
        if folder.resolve() in [other.resolve() for _, other in given[:index]]:
            raise SdcError(f"{folder}: is given twice; valid is each run once")
    paths = [folder.resolve() for name, folder in given if not name]
    tails = [path.name for path in paths]
    most_parts = max((len(path.parts) for path in paths), default=1)
    for parts in range(1, most_parts + 1):
        tails = ["/".join(path.parts[-parts:]) for path in paths]
        if len(set(tails)) == len(tails):
            break
    left = iter(tails)
    runs: dict[str, RunFolder] = {}
    for name, folder in given:
        label = name or next(left)
        if label in runs:
            raise SdcError(f"{label}={folder}: a second run {label!r}; valid is another NAME=DIR")
        runs[label] = read_run(folder)
    return runs


def parse_costs(words: Sequence[str], names: Sequence[str]) -> dict[str, float]:
    """Read the costs of variants from texts such as ``B=120000``.

    Args:
        words: the texts.
        names: names of the runs, the first of which is the reference.

    Returns:
        Cost of each named variant, in the currency of the tariff.

    Raises:
        SdcError: a text has no name of a variant or no number, or a name occurs twice.
    """
    costs: dict[str, float] = {}
    variants = list(names[1:])
    for word in words:
        name, _, number = word.rpartition("=")
        if name not in variants:
            what = (
                "is the run that the others are compared with" if name == names[0] else "is no run"
            )
            raise SdcError(
                f"--cost {word}: {name!r} {what}; valid are "
                f"{', '.join(map(repr, variants))}{suggestion(name, variants)}"
            )
        try:
            cost = float(number.replace("_", "").replace(",", ""))
        except ValueError:
            cost = math.nan
        if not 0.0 <= cost < math.inf:
            raise SdcError(f"--cost {word}: {number!r}; valid is an amount such as 120000")
        if name in costs:
            raise SdcError(f"--cost {word}: a second cost of {name!r}; valid is one")
        costs[name] = cost
    return costs


def compare_runs(
    runs: Mapping[str, RunFolder],
    costs: Mapping[str, float] | None = None,
    *,
    failover: bool = False,
    on_study: Callable[[str], None] | None = None,
) -> Comparison:
    """Compare runs of one hall with the first of them.

    Args:
        runs: two or more runs of equal length, keyed by name; the first is the reference.
        costs: what variants cost to make, in the currency of the tariff, keyed by name.
        failover: True to find out how many CRAC units of each run can fail.
        on_study: function that is called with the name of each run whose failover is studied.

    Raises:
        SdcError: there are fewer than two runs or too many, they are of different halls or
            lengths, a cost is given and there are no prices, or a run has no CRAC units to lose.
    """
    names, folders = list(runs), list(runs.values())
    if not 2 <= len(runs) <= MAX_RUNS:
        count = f"{len(runs)} run" + "s" * (len(runs) != 1)
        raise SdcError(f"{count} to compare; valid are 2 to {MAX_RUNS}")
    first = folders[0]
    for run in folders[1:]:
        if abs(run.hours - first.hours) > 1e-9:
            raise SdcError(
                f"{run.path}: {run.hours:g} h, {first.path}: {first.hours:g} h; runs to "
                "compare must be of equal length"
            )
        if len(run.names) != len(first.names):
            raise SdcError(
                f"{run.path}: {len(run.names)} data centers, {first.path}: {len(first.names)}; "
                "runs to compare must be of the same halls"
            )
    compared, left_out = _compared_dcs(folders)
    configs = [read_configs(run, compared) for run in folders]
    for run, of_run in zip(folders[1:], configs[1:], strict=True):
        for config, base in zip(of_run, configs[0], strict=True):
            size, base_size = (f"{c.hall.rows} x {c.hall.racks_per_row}" for c in (config, base))
            if size != base_size:
                raise SdcError(
                    f"{run.path}: {config.name} has {size} racks, {base.name} of {first.path} "
                    f"{base_size}; runs to compare must be of the same hall"
                )
    costs = dict(costs or {})
    for name in [names[0], *costs] if costs else []:
        if not runs[name].metrics["total"].get("cost"):
            raise SdcError(
                f"--cost: the run {name!r} has no prices (tariff.price_per_kwh and "
                "tariff.demand_charge_per_kw are 0); valid are runs with a tariff"
            )
    redundancy = {}
    for name, run in runs.items() if failover else ():
        if len(run.names) > MAX_STUDIED_DCS:
            raise SdcError(
                f"--failover: {run.path} has {len(run.names):,} data centers; valid are up to "
                f"{MAX_STUDIED_DCS}"
            )
        if on_study is not None:
            on_study(name)
        studies = map(study_failover, read_configs(run, range(len(run.names))))
        redundancy[name] = min(map(redundancy_of, studies), key=lambda r: r.units)
    of_configs = _config_differences(configs)
    notes = _notes(runs, configs, left_out, has_differences=bool(of_configs))
    return Comparison(
        dict(runs),
        (*of_configs, *_input_differences(folders)),
        tuple(_figures(folders)),
        costs,
        redundancy,
        notes,
    )


def redundancy_of(study: Failover) -> Redundancy:
    """Return how many CRAC units can fail in a study before a rack throttles."""
    throttle_min: dict[int, float] = {}
    for loss, minutes in zip(study.losses, study.throttle_min, strict=True):
        count, soonest = len(loss.units), throttle_min.get(len(loss.units), math.inf)
        throttle_min[count] = min(soonest, math.inf if math.isnan(minutes) else float(minutes))
    units = -1
    for count in sorted(throttle_min):
        if throttle_min[count] <= MINUTES:
            return Redundancy(max(units, 0), throttle_min[count])
        units = count
    return Redundancy(units, None)


def _compared_dcs(runs: Sequence[RunFolder]) -> tuple[list[int], int]:
    """Return data centers to compare field by field, and how many that differ are left out.

    These are all of a few data centers; of more, those whose configurations differ.
    """
    count = len(runs[0].names)
    if count <= MAX_COMPARED_CONFIGS:
        return list(range(count)), 0
    texts = [read_config_texts(run) for run in runs]
    different = [dc for dc in range(count) if len({of_run[dc] for of_run in texts}) > 1]
    most = MAX_COMPARED_CONFIGS
    return different[:most], max(0, len(different) - most)


def _config_differences(configs: Sequence[Sequence[DataCenterConfig]]) -> list[Difference]:
    """Return the fields in which runs differ.

    Args:
        configs: configurations of the compared data centers of each run, (R, data centers).
    """
    rows: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for of_dc in zip(*configs, strict=True):
        flat = [_flat(config.model_dump(mode="json")) for config in of_dc]
        for name in {name: None for values in flat for name in values}:
            values = tuple(_value_text(of_run, name) for of_run in flat)
            texts = {json.dumps(of_run.get(name, "-")) for of_run in flat}
            if len(texts) > 1:
                rows.setdefault((name, values), []).append(of_dc[0].name)
    several = len(configs[0]) > 1
    out = []
    for (name, values), dcs in rows.items():
        everywhere = len(dcs) == len(configs[0])
        of = "" if everywhere or not several else f" ({', '.join(dcs)})"
        out.append(Difference(f"{name}{of}", _meaning(name), values))
    return out


def _flat(values: Any, path: str = "") -> dict[str, Any]:
    """Return the leaves of nested mappings, keyed by their path with dots."""
    if not isinstance(values, dict) or not values:
        return {path: values}
    return {
        name: leaf
        for key, value in values.items()
        for name, leaf in _flat(value, f"{path}.{key}".lstrip(".")).items()
    }


def _value_text(values: Mapping[str, Any], name: str) -> str:
    """Return the value of a field as text, cut to ``_MOST_VALUE`` characters."""
    value = values.get(name, None)
    if value is None:
        return "none"
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _MOST_VALUE else f"{text[: _MOST_VALUE - 1]}…"


def _meaning(path: str) -> str:
    """Return the first sentence of the description of a field; empty for unknown fields."""
    model: Any = DataCenterConfig
    for name in path.split("."):
        field = model.model_fields.get(name)
        if field is None:
            return ""
        if not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            sentence = docstrings(model).get(name, "").partition(". ")[0]
            return sentence.rstrip(".").replace("``", "")
        model = field.annotation
    return ""


def _input_differences(runs: Sequence[RunFolder]) -> list[Difference]:
    """Return controller, seed, precision and inputs in which runs differ."""
    rows: dict[str, list[Any]] = {
        "controller": [run.metrics["controller"] for run in runs],
        "seed": [run.metrics["seed"] for run in runs],
        "precision": [run.metrics["precision"] for run in runs],
        "step (min)": [60 * run.metrics["step_h"] for run in runs],
        "errors of forecasts": [run.metrics.get("forecast_error") for run in runs],
        "first day": [run.metrics["data_centers"][0]["start"] for run in runs],
        "year": [run.metrics["data_centers"][0]["year"] for run in runs],
        "version of sdc-taichi": [run.metrics["versions"].get("sdc-taichi") for run in runs],
    }
    sources = [
        {
            kind: [
                [dc["provenance"].get(kind), dc["sha256"].get(kind)]
                for dc in run.metrics["data_centers"]
            ]
            for dc in run.metrics["data_centers"]
            for kind in {**dc["provenance"], **dc["sha256"]}
        }
        for run in runs
    ]
    for kind in {kind: None for of_run in sources for kind in of_run}:
        rows[kind] = [of_run.get(kind) for of_run in sources]
    out = []
    for name, values in rows.items():
        if len({json.dumps(value) for value in values}) > 1:
            texts = tuple(_source_text(value) for value in values)
            if len(set(texts)) == 1:
                texts = tuple(f"file {index + 1}" for index in range(len(texts)))
            out.append(Difference(name, "", texts))
    return out


def _source_text(value: Any) -> str:
    """Return a setting of a run, or the sources of an input of its data centers, as text."""
    if isinstance(value, list):
        sources = dict.fromkeys(source or digest or "none" for source, digest in value)
        value = ", ".join(map(str, sources))
    return _value_text({"": value}, "")


def _figures(runs: Sequence[RunFolder]) -> list[Figure]:
    """Return the figures of all data centers of each run, those that grow with time for a year."""
    totals = [run.metrics["total"] for run in runs]
    years = [run.hours / HOURS_PER_YEAR for run in runs]

    def a_year(key: str, factor: float = 1.0) -> tuple[float | None, ...]:
        return tuple(
            None if total.get(key) is None else factor * total[key] / length
            for total, length in zip(totals, years, strict=True)
        )

    def of_run(key: str) -> tuple[float | None, ...]:
        return tuple(total.get(key) for total in totals)

    recommended_c = RECOMMENDED_C[1]
    several_halls = any(len(run.metrics["data_centers"]) > 1 for run in runs)
    # A bill of 0 means that the tariff has no prices.
    bills = tuple(bill or None for bill in a_year("cost"))
    figures = [
        Figure("grid_kwh", "energy from the grid", "MWh a year", a_year("grid_kwh", 1e-3), True),
        Figure(
            "it_kwh", "part of it for servers and their fans", "MWh a year", a_year("it_kwh", 1e-3)
        ),
        Figure("hvac_kwh", "part of it for cooling", "MWh a year", a_year("hvac_kwh", 1e-3), True),
        Figure("pue", "PUE", "", of_run("pue")),
        Figure("cost", "electricity bill", "currency a year", bills, True),
        Figure("cfp_kg", "carbon", "t CO₂e a year", a_year("cfp_kg", 1e-3), True),
        Figure("water_l", "water", "m³ a year", a_year("water_l", 1e-3), True),
        Figure("peak_kw", "highest power from the grid", "kW", of_run("peak_kw"), True),
        Figure("hottest_inlet_c", "hottest inlet", "°C", of_run("hottest_inlet_c")),
        Figure(
            "inlet_above_27_h",
            f"time with an inlet above {recommended_c:g} °C",
            "hall h a year" if several_halls else "h a year",
            a_year("inlet_above_27_h"),
        ),
    ]
    losses = (
        ("throttled_rack_h", "racks throttled by hot air", "rack h a year", 1.0),
        ("tripped_rack_h", "racks switched off by hot air", "rack h a year", 1.0),
        ("unmet_cooling_kwh", "heat beyond the capacity of the plant", "MWh a year", 1e-3),
        ("unserved_kwh", "energy not served in outages", "MWh a year", 1e-3),
        ("dropped_tasks", "work dropped", "tasks a year", 1.0),
        ("lost_tasks", "work lost with its servers", "tasks a year", 1.0),
        ("overdue_task_h", "work past its deadline", "task h a year", 1.0),
    )
    figures += [
        Figure(key, label, unit, a_year(key, factor))
        for key, label, unit, factor in losses
        if any(total.get(key) for total in totals)
    ]
    return figures


def _notes(
    runs: Mapping[str, RunFolder],
    configs: Sequence[Sequence[DataCenterConfig]],
    left_out: int,
    *,
    has_differences: bool,
) -> tuple[str, ...]:
    """Return what a reader of the figures must know."""
    first_name, *names = runs
    first = runs[first_name]
    notes = []
    years = first.hours / HOURS_PER_YEAR
    if abs(years - 1.0) > 1e-3:
        days = first.hours / 24
        season = "other seasons differ" if years < 1.0 else "they are means over the years"
        notes.append(
            f"The runs cover {days:,.4g} day{'s' * (days != 1)}. Figures a year are those of the "
            f"runs times {1 / years:,.4g}; {season}."
        )
    done = {name: run.metrics["total"]["executed_tasks"] for name, run in runs.items()}
    for name in names:
        share = done[name] / done[first_name] - 1.0 if done[first_name] else 0.0
        if abs(share) > _LEAST_WORK_SHARE:
            than = "more" if share > 0 else "less"
            notes.append(
                f"{name} did {100 * abs(share):.2g} % {than} work than {first_name}; its "
                "savings are partly due to that."
            )
    cut = [name for name, run in runs.items() if _is_cut(run)]
    if cut:
        notes.append(f"Interrupted before the end that was asked for: {', '.join(cut)}.")
    if left_out:
        notes.append(f"{left_out:,} more data centers differ in their configuration.")
    if not has_differences and len({r.metrics["fingerprint"] for r in runs.values()}) == 1:
        notes.append("Configuration and inputs are equal in all runs.")
    default = TariffConfig()
    unpriced = [name for name, run in runs.items() if not run.metrics["total"].get("cost")]
    if unpriced:
        notes.append(f"The tariff has no prices, so there is no bill: {', '.join(unpriced)}.")
    if any(config.tariff == default for of_run in configs for config in of_run):
        notes.append(
            "Money is at the example prices of the package, not those of a contract; section "
            "tariff of the configuration sets them."
        )
    if any(run.metrics["synthetic"] for run in runs.values()):
        notes.append("Inputs are synthetic, at least in part.")
    return tuple(notes)


def _is_cut(run: RunFolder) -> bool:
    """Return True if a run was interrupted."""
    return bool(run.metrics["steps_done"] < run.metrics["steps_asked"])


def comparison_values(comparison: Comparison) -> dict[str, Any]:
    """Convert a comparison to plain values for JSON; None means unknown, or never."""
    names = comparison.names

    def by_name(values: Sequence[Any]) -> dict[str, Any]:
        return dict(zip(names, values, strict=True))

    return {
        "runs": {name: str(run.path) for name, run in comparison.runs.items()},
        "reference": names[0],
        "differences": [
            {"name": each.name, "meaning": each.meaning, "values": by_name(each.values)}
            for each in comparison.differences
        ],
        "figures": [
            {
                "key": figure.key,
                "label": figure.label,
                "unit": figure.unit,
                "values": by_name(figure.values),
                **({"savings": by_name(figure.savings())} if figure.has_savings else {}),
            }
            for figure in comparison.figures
        ],
        "redundancy": {
            name: {"units": each.units, "throttle_min": each.throttle_min}
            for name, each in comparison.redundancy.items()
        },
        "costs": dict(comparison.costs),
        "payback_years": comparison.payback_years(),
        "notes": list(comparison.notes),
    }
