"""Suites of the benchmark: what may stand in their files, and what their jobs do."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from sdc_taichi import ConfigError
from sdc_taichi.benchmark.cases import check_suite, data_centers, number_of_seeds
from sdc_taichi.benchmark.jobs import DoneJob, run_job
from sdc_taichi.benchmark.suite import Suite, load_suite, make_suite, suite_names
from sdc_taichi.benchmark.suite_jobs import packed, reference_jobs, row_jobs
from sdc_taichi.learning.split import HELD_OUT

SMALL: dict[str, Any] = {
    "name": "small",
    "title": "Two weeks of two small data centers",
    "seeds": 2,
    "cases": {
        "tiny": {
            "config": "tiny",
            "sites": ["NY", "CA"],
            "weeks": [27],
            "validation_weeks": [1],
            "days": 2,
        }
    },
    "rows": {
        "idle": {"controller": "idle"},
        "random": {"controller": "random"},
        "best-constant": {"best_of": ["constant:16", "constant:21"]},
        "ippo": {"train": {"algorithm": "ippo", "steps": 40000}},
        "optimum": {"optimum": "achieved"},
        "bound": {"optimum": "bound"},
    },
}


REFERENCE_NAME = "reference-held-out-ny"


def small(**changes: Any) -> Suite:
    return make_suite(SMALL | changes)


def rows_of(done: DoneJob) -> pd.DataFrame:
    assert not done.error
    return pd.read_parquet(io.BytesIO(done.rows))


def case(**changes: Any) -> dict[str, Any]:
    return {"cases": {"tiny": {**SMALL["cases"]["tiny"], **changes}}}


@pytest.mark.parametrize("name", suite_names())
@pytest.mark.parametrize("quick", [False, True])
def test_suites_of_the_package_are_valid(name: str, quick: bool) -> None:
    suite = load_suite(name, quick=quick)
    check_suite(suite)
    assert suite.name == name
    assert suite.about
    assert not suite.quick or not quick


def test_weeks_are_those_of_the_split_unless_given() -> None:
    suite = make_suite(
        SMALL | {"cases": {"a": {"config": "tiny"}, "b": {"config": "tiny", "weeks": [7]}}}
    )
    assert suite.cases["a"].weeks == HELD_OUT
    assert suite.cases["b"].weeks == (7,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": {"a": {}}}, "rows.a: nothing given; valid is one of controller, best_of, train"),
        (
            {"rows": {"a": {"controller": "idle", "optimum": "bound"}}},
            "controller and optimum given",
        ),
        ({"rows": {"A b": {"controller": "idle"}}}, "rows.A b"),
        ({"rows": {"a": {"controler": "idle"}}}, "did you mean 'controller'"),
        ({"rows": {"reference-a": {"controller": "idle"}}}, "does not begin with reference"),
        (
            {"rows": {"a": {"controller": "idle", "forecast_error": "rain=1"}}},
            "forecast error 'rain=1'",
        ),
        ({"rows": {"a": {"controller": "idle", "cases": ["no"]}}}, "no case 'no'; valid: tiny"),
        ({"rows": {"a": {"controller": "idle", "apart": True}}}, "apart: valid with train"),
        ({"objective": "carbn"}, "did you mean 'carbon'"),
        (case(weeks=[1]), "week 1 stands in weeks too, by which nothing may be chosen"),
        (case(weeks=[52]), "cases.tiny.weeks"),
        (case(config="tinny"), "no such file or preset; did you mean 'tiny'"),
        (case(optimum=False), "rows.optimum: case tiny has optimum false"),
        ({"cases": {}}, "cases"),
    ],
)
def test_what_is_not_valid_is_named(changes: Mapping[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        small(**changes)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": {"a": {"controller": "constant:99"}}}, "rows.a: controller 'constant:99'"),
        ({"rows": {"a": {"best_of": ["g36", "g63"]}}}, "rows.a: controller 'g63': unknown"),
        ({"rows": {"a": {"train": {"algorithm": "pppo"}}}}, "did you mean 'ppo'"),
        ({"rows": {"a": {"train": {"algorithm": "ppo", "seed": 3}}}}, "seed: is that of the case"),
        (case(sites=["Nowhere"]), "cases.tiny"),
        (
            case(overrides={"events": {"sampled": [{"kind": "grid_outage", "per_year": 9,
                                                    "duration_h": [1, 2]}]}}),
            "optimum true with sampled events",
        ),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_found_before_any_work(
    changes: Mapping[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        check_suite(small(**changes))
    assert message in str(caught.value)


def test_the_quick_form_takes_the_place_of_values_and_leaves_rows_out(tmp_path: Any) -> None:
    file = tmp_path / "mine.yaml"
    quick = {"seeds": 1, "cases": {"tiny": {"sites": ["NY"]}}, "rows": {"ippo": None}}
    values = {k: v for k, v in SMALL.items() if k != "name"} | {"quick": quick}
    file.write_text(yaml.safe_dump(values))
    whole, found = load_suite(str(file)), load_suite(str(file), quick=True)
    assert found.name == "mine"
    assert (whole.seeds, found.seeds) == (2, 1)
    assert found.cases["tiny"].sites == ("NY",)
    assert found.cases["tiny"].days == 2
    assert set(whole.rows) - set(found.rows) == {"ippo"}
    assert make_suite(yaml.safe_load(found.to_yaml())) == found


def test_some_rows_and_cases_can_be_chosen() -> None:
    suite = small().chosen(rows=["idle", "optimum"])
    assert list(suite.rows) == ["idle", "optimum"]
    with pytest.raises(ConfigError, match="no row 'idel'; did you mean 'idle'"):
        small().chosen(rows=["idel"])


def test_the_test_may_be_of_other_data_centers() -> None:
    other = {"sites": ["TX"], "overrides": {"site": {"seed": 3}}}
    suite = small(**case(test=other))
    held_out, own = (data_centers(suite.cases["tiny"], p) for p in ("held-out", "validation"))
    assert [dc.site.location for dc in held_out] == ["TX"]
    assert [dc.site.location for dc in own] == ["NY", "CA"]
    assert (held_out[0].site.seed, own[0].site.seed) == (3, 10)


def test_seeds_are_for_what_is_random() -> None:
    suite = small()
    numbers = {row: number_of_seeds(suite, "tiny", row) for row in suite.rows}
    assert numbers == {"idle": 1, "random": 2, "best-constant": 1, "ippo": 2, "optimum": 1,
                       "bound": 1}  # fmt: skip


def test_a_job_depends_on_what_it_is_of_and_not_on_titles_or_other_rows() -> None:
    def keys(**changes: Any) -> dict[str, str]:
        suite = small(**changes)
        references = reference_jobs(suite)
        return {job.name: job.key for job in [*references, *row_jobs(suite, references)]}

    rows: dict[str, Any] = {name: SMALL["rows"][name] for name in ("idle", "optimum")}
    before, after = keys(), keys(title="Another", seeds=1, rows=rows)
    assert set(after) < set(before)
    assert all(before[name] == key for name, key in after.items())
    other = keys(**case(days=3))
    assert not set(other.values()) & set(before.values())


@pytest.fixture(scope="module")
def done() -> dict[str, DoneJob]:
    """Jobs of all rows but the training, by row."""
    suite = small(
        **case(sites=["NY"]), rows={k: v for k, v in SMALL["rows"].items() if k != "ippo"}
    )
    references = reference_jobs(suite)
    inputs = {}
    for job in references:
        found = run_job(job, {})
        assert not found.error
        inputs[job.name] = packed(found.files)
    jobs = [job for job in row_jobs(suite, references) if job.partition["seed"] == "0"]
    jobs += [references[0]]
    return {job.partition["row"]: run_job(job, inputs) for job in jobs}


def test_rows_stand_between_idle_commands_and_the_bound(done: Mapping[str, DoneJob]) -> None:
    rows = {name: rows_of(each) for name, each in done.items() if name != REFERENCE_NAME}
    valued = {name: own[own["moves"] == "all"]["valued_figure"] for name, own in rows.items()}
    assert [len(x) for x in valued.values()] == [1] * 5
    idle = rows["idle"]
    assert idle["valued_figure"].tolist() == idle["idle_figure"].tolist()
    for name, figures in valued.items():
        assert np.all(valued["bound"].to_numpy() <= figures.to_numpy() * (1 + 1e-9)), name
    assert idle["share"].tolist() == [0.0]
    np.testing.assert_allclose(rows["optimum"]["share"][0], 1.0)
    assert (rows["bound"]["share"] >= 1.0 - 1e-9).all()
    assert set(rows["optimum"]["moves"]) == {"all", "load", "cooling", "battery"}
    columns = {tuple(own.columns) for own in rows.values()}
    assert len(columns) == 1


def test_the_best_of_several_is_chosen_in_the_validation_weeks(
    done: Mapping[str, DoneJob],
) -> None:
    metrics = done["best-constant"].metrics
    changes = metrics["validation_change_pct"]
    assert metrics["chosen"] == min(changes, key=changes.__getitem__)
    assert set(changes) == {"constant:16", "constant:21"}


def test_a_job_has_the_same_bits_again(done: Mapping[str, DoneJob]) -> None:
    first = done[REFERENCE_NAME]
    again = run_job(first.job, {})
    assert again.rows == b""
    assert packed(first.files) == packed(again.files)
    assert first.metrics == again.metrics
