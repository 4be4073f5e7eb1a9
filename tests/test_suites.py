"""Suites of the benchmark: what may stand in their files, and what their jobs do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from policies import interface, network
from sdc_taichi import ConfigError
from sdc_taichi.benchmark.cases import check_suite, data_centers, training_settings
from sdc_taichi.benchmark.executors import Executor, JobSummary, run_jobs
from sdc_taichi.benchmark.jobs import Inputs, Job
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.benchmark.suite import (
    Case,
    Suite,
    load_suite,
    make_suite,
    suite_names,
)
from sdc_taichi.benchmark.suite_run import (
    reference_jobs,
    row_jobs,
    run_suite,
    study_of,
    trial_jobs,
)
from sdc_taichi.cli.app import app
from sdc_taichi.control import ForecastError
from sdc_taichi.errors import SdcError
from sdc_taichi.learning.policy import About, Policy
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.optimum.uncoordinated import WAYS

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


def small(**changes: Any) -> Suite:
    return make_suite(SMALL | changes)


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
    assert set(load_suite(name).cases) >= set(suite.cases)


def test_another_policy_in_a_folder_makes_another_job(tmp_path: Path) -> None:
    of, keys = interface(), []
    for seed in (0, 0, 1):
        networks = tuple(network((a,), of.width(a), 3, seed=seed) for a in of.agents)
        Policy(networks, of, About(algorithm="ippo")).save(tmp_path)
        suite = small(rows={"mine": {"controller": f"battery=policy:{tmp_path}"}})
        keys.append(row_jobs(suite, ())[0].key)
    assert keys[0] == keys[1] != keys[2]


def test_another_input_file_in_a_place_makes_other_jobs(tmp_path: Path) -> None:
    path, keys = tmp_path / "load.csv", []
    for content in ("a", "a", "b"):
        path.write_text(content)
        suite = small(**case(overrides={"site": {"workload_file": str(path)}}))
        references = reference_jobs(suite)
        jobs = [*references, *row_jobs(suite, references)]
        keys.append([job.key for job in jobs])
    assert keys[0] == keys[1]
    assert not set(keys[1]) & set(keys[2])
    path.unlink()
    with pytest.raises(SdcError, match=r"load\.csv"):
        reference_jobs(suite)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": {"a": {}}}, "rows.a: nothing given; valid is one of controller, best_of, train"),
        (
            {"rows": {"a": {"controller": "idle", "optimum": "bound"}}},
            "controller and optimum given",
        ),
        ({"rows": {"a": {"controler": "idle"}}}, "did you mean 'controller'"),
        ({"rows": {"reference-a": {"controller": "idle"}}}, "does not begin with reference"),
        ({"rows": {"a": {"controller": "idle", "cases": ["no"]}}}, "no case 'no'; valid: tiny"),
        ({"rows": {"a": {"controller": "idle", "apart": True}}}, "apart: valid with train"),
        (
            {"rows": {"a": {"best_of": ["g36", "idle", "g36"]}}},
            "best_of: g36, idle, g36; valid is each once",
        ),
        ({"objective": "carbn"}, "did you mean 'carbon'"),
        (case(rows=["idel"]), "cases.tiny.rows: no row 'idel'"),
        (case(forecast_error="ci=x"), "forecast_error"),
        (case(weeks=[1]), "week 1 stands in weeks too, by which nothing may be chosen"),
        (case(test={"years": [6, 6]}), "test.years: [6, 6]; valid is each year once"),
        (case(config="tinny"), "no such file or preset; did you mean 'tiny'"),
        (case(optimum=False), "rows.optimum: case tiny has optimum false"),
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
        ({"rows": {"a": {"train": {"algorithm": "ppo", "seed": 3}}}}, "seed: is that of the case"),
        (case(sites=["Nowhere"]), "cases.tiny"),
        (
            {"objective": "cost"} | case(sites=[], overrides={"fleet": {"sites": ["AZ", "WA"]}}),
            "cases.tiny: objective cost; valid for fleets that share work is carbon",
        ),
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


def test_the_quick_form_takes_the_place_of_values_and_leaves_rows_out(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    quick = {"seeds": 1, "cases": {"tiny": {"sites": ["NY"]}}, "rows": {"ippo": None}}
    values = {k: v for k, v in SMALL.items() if k != "name"} | {"quick": quick}
    file.write_text(yaml.safe_dump(values))
    whole, quick_form = load_suite(str(file)), load_suite(str(file), quick=True)
    assert quick_form.name == "mine"
    assert (whole.seeds, quick_form.seeds) == (2, 1)
    assert quick_form.cases["tiny"].sites == ("NY",)
    assert quick_form.cases["tiny"].days == 2
    assert quick_form.cases["tiny"].training_weeks == (0, 9, 13, 22, 26, 35, 39, 48)
    assert quick_form.training["steps"] == 100_000
    assert set(whole.rows) - set(quick_form.rows) == {"ippo"}
    assert make_suite(yaml.safe_load(quick_form.to_yaml())) == quick_form


def test_a_suite_extends_one_of_the_package(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        "extends: carbon\ntitle: Mine\ncases: {noisy: null, eight-sites: {days: 3}}\n"
        "rows: {ippo: null, mine: {controller: coldest}}\n"
    )
    mine, base = load_suite(str(file)), load_suite("carbon")
    assert (mine.name, mine.title, list(mine.cases)) == ("mine", "Mine", ["eight-sites"])
    assert list(mine.rows) == [*(name for name in base.rows if name != "ippo"), "mine"]
    assert mine.cases["eight-sites"] == base.cases["eight-sites"].model_copy(update={"days": 3})
    file.write_text("extends: carbn\n")
    with pytest.raises(ConfigError, match=r"extends 'carbn'.*did you mean 'carbon'"):
        load_suite(str(file))


@pytest.mark.parametrize("name", suite_names())
@pytest.mark.parametrize("options", [(), ("--quick",), ("--rows", "idle", "--seeds", "3")])
def test_what_is_shown_is_a_whole_suite(
    tmp_path: Path, name: str, options: tuple[str, ...]
) -> None:
    shown = CliRunner().invoke(app, ["benchmark", name, "--show", *options])
    assert shown.exit_code == 0, shown.output
    file = tmp_path / "mine.yaml"
    file.write_text(shown.stdout)
    suite = load_suite(name, quick="--quick" in options)
    if "--rows" in options:
        suite = suite.chosen(rows=["idle"], seeds=3)
    assert load_suite(str(file)) == suite
    if "--quick" not in options:
        quick = load_suite(str(file), quick=True)
        whole = load_suite(name, quick=True)
        assert quick == (
            whole.chosen(rows=["idle"], seeds=quick.seeds) if "--rows" in options else whole
        )


def test_the_quick_form_of_chosen_cases_and_rows_is_whole(tmp_path: Path) -> None:
    cases = {"tiny": SMALL["cases"]["tiny"], "other": SMALL["cases"]["tiny"]}
    quick = {
        "cases": {"tiny": {"sites": ["NY"]}, "other": {"sites": ["CA"]}},
        "rows": {
            "ippo": None,
            "idle": {"cases": ["tiny", "other"]},
            "random": {"cases": ["other"]},
        },
    }
    suite = make_suite(SMALL | {"cases": cases, "quick": quick})
    file = tmp_path / "mine.yaml"
    file.write_text(suite.chosen(cases=["tiny"], rows=["idle", "random"]).to_yaml())
    quick_form = load_suite(str(file), quick=True)
    assert (list(quick_form.cases), list(quick_form.rows)) == (["tiny"], ["idle"])
    assert quick_form.cases["tiny"].sites == ("NY",)


def test_the_test_may_be_of_other_data_centers() -> None:
    other = {"sites": ["TX"], "overrides": {"site": {"seed": 3}}}
    suite = small(**case(test=other, years=[5, 6], validation_years=[7]))
    settings = training_settings(
        suite.cases["tiny"], suite.rows["ippo"], objective="carbon", seed=0, training={}
    )
    assert (settings.years, settings.validation.years) == ((5, 6), (7,))
    names = [job.partition["row"] for job in reference_jobs(suite)]
    assert names == [f"reference-held-out-tx-{year}" for year in (5, 6)] + [
        f"reference-validation-{site}-7" for site in ("ny", "ca")
    ]
    held_out, validation = (
        data_centers(suite.cases["tiny"], p) for p in ("held-out", "validation")
    )
    assert [dc.site.location for dc in held_out] == ["TX"]
    assert [dc.site.location for dc in validation] == ["NY", "CA"]
    assert (held_out[0].site.seed, validation[0].site.seed) == (3, 10)


def test_errors_of_forecasts_are_those_of_a_case_and_share_its_optima() -> None:
    tiny = SMALL["cases"]["tiny"]
    tiny = {**tiny, "weeks": [0], "training_weeks": [3]}
    noisy = {**tiny, "forecast_error": "ci=0.1,temperature=1", "rows": ["idle", "ippo", "bound"]}
    suite = small(cases={"tiny": tiny, "noisy": noisy})
    settings = training_settings(
        suite.cases["noisy"], suite.rows["ippo"], objective="carbon", seed=0, training={}
    )
    assert settings.environment.forecast_error == ForecastError(0.1, 1.0)
    references = reference_jobs(suite)
    assert {job.partition["case"] for job in references} == {"tiny"}
    jobs = row_jobs(suite, references)
    of_noisy = [job for job in jobs if job.partition["case"] == "noisy"]
    assert [job.partition["row"] for job in of_noisy] == ["idle"] * 2 + ["ippo"] * 2 + ["bound"]
    assert of_noisy[-1].inputs == next(x for x in jobs if x.name == "small/tiny/bound/0").inputs
    assert all(Case.model_validate(job.values["case"]) for job in references)
    alone = suite.chosen(cases=["noisy"], rows=["bound"])
    assert {job.partition["case"] for job in reference_jobs(alone)} == {"noisy"}


def elsewhere(**changes: Any) -> Suite:
    cases = {
        "away": {"trained_in": "tiny", "test": {"sites": ["TX"]}, **changes},
        "tiny": {**SMALL["cases"]["tiny"], "sites": ["NY"], "days": 3},
    }
    return small(cases=cases)


def test_cases_take_policies_and_choices_of_another_case() -> None:
    suite = elsewhere()
    away = suite.cases["away"]
    assert (away.sites, away.days, away.test.sites) == (("NY",), 3, ("TX",))
    assert make_suite(yaml.safe_load(suite.to_yaml())) == suite
    assert "days" not in yaml.safe_load(suite.to_yaml())["cases"]["away"]
    references = reference_jobs(suite)
    names = {job.name.removeprefix("small/") for job in references}
    assert names == {f"tiny/reference-{x}-ny/0" for x in ("held-out", "validation")} | {
        "away/reference-held-out-tx/0"
    }
    jobs = {job.name.removeprefix("small/"): job for job in row_jobs(suite, references)}
    for name in ("ippo/1", "best-constant/0"):
        maker, job = jobs[f"tiny/{name}"], jobs[f"away/{name}"]
        assert job.values["made_by"] == maker.name
        optimum = "small/away/reference-held-out-tx/0"
        assert set(job.inputs) == {maker.name, optimum}
        assert job.inputs[maker.name] == maker.key
    assert "made_by" not in jobs["away/idle/0"].values
    assert set(suite.chosen(cases=["away"]).cases) == {"away", "tiny"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trained_in": "here"}, "cases.away.trained_in 'here'; valid: tiny"),
        ({"days": 4}, "cases.away.days: is that of tiny; valid is without"),
    ],
)
def test_cases_change_only_results_of_another_case(
    changes: Mapping[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        elsewhere(**changes)
    assert message in str(caught.value)


def test_settings_are_tried_for_each_algorithm_and_case_of_trainings() -> None:
    tuning = {"trials": 3, "steps": 20000, "space": {"ippo": {"rate": [0.01, 0.02]}, "ppo": {}}}
    suite = make_suite(elsewhere().model_dump() | {"tuning": tuning})
    references = reference_jobs(suite)
    trials = trial_jobs(suite, references)
    assert [job.name for job in trials] == [f"small/tiny/trial-ippo/{x}" for x in range(3)]
    settings = [job.values["row"]["train"] for job in trials]
    assert [x["steps"] for x in settings] == [20000] * 3
    assert settings[0]["learning"] == {}
    assert {x["learning"]["rate"] for x in settings[1:]} <= {0.01, 0.02}
    rows = {job.name: job for job in row_jobs(suite, references, trials)}
    names = [job.name for job in trials]
    assert rows["small/tiny/ippo/1"].values["trials"] == names
    assert set(names) <= set(rows["small/tiny/ippo/1"].inputs)
    assert not set(names) & set(rows["small/away/ippo/1"].inputs)
    assert suite.short("suite").tuning is None
    wrong = tuning | {"space": {"ippo": {"rate": [0.01, -1.0]}}}
    with pytest.raises(ConfigError, match=r"tuning\.space\.ippo\.rate: .*got -1"):
        check_suite(small(tuning=wrong))


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


def run(suite: Suite, store: ResultStore, *, resume: bool = False) -> list[JobSummary]:
    """Run a suite in this process."""
    summaries = []

    def stage(_: str, jobs: Sequence[Job], __: int, inputs: Inputs | None = None) -> JobSummary:
        summaries.append(run_jobs(jobs, store, Executor(), inputs))
        return summaries[-1]

    with store.claimed(study_of(suite, suite, "command"), resume=resume):
        run_suite(suite, store, stage)
    return summaries


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    """Results of all rows but the training, of one site."""
    suite = small(
        **case(sites=["NY"]), rows={k: v for k, v in SMALL["rows"].items() if k != "ippo"}
    )
    results = ResultStore(tmp_path_factory.mktemp("suite") / "small")
    assert [(each.done, each.failed) for each in run(suite, results)] == [(2, ()), (6, ())]
    return results


def test_rows_stand_between_idle_commands_and_the_bound(store: ResultStore) -> None:
    rows = store.rows().set_index("row")
    scored = rows[(rows["moves"] == "all") & (rows["seed"] == 0)]
    assert set(scored.index) == {"idle", "random", "best-constant", "optimum", "bound"}
    assert (scored["controller"] == scored.index).all()
    assert scored["valued_figure"]["idle"] == scored["idle_figure"]["idle"]
    assert (scored["valued_figure"] >= scored["valued_figure"]["bound"] * (1 - 1e-9)).all()
    assert scored["share"]["idle"] == 0.0
    assert scored["share"]["optimum"] == pytest.approx(1.0)
    assert scored["share"]["bound"] >= 1.0 - 1e-9
    assert set(rows["moves"]["optimum"]) == {"all", *AGENTS, *WAYS}
    assert rows["seed"]["random"].tolist() == [0, 1]
    assert rows["figure"]["random"].nunique() == 2
    partition = {"suite": "small", "case": "tiny", "row": "best-constant", "seed": "0"}
    metrics = store.result(partition).metrics
    changes = metrics["validation_change_pct"]
    assert metrics["chosen"] == min(changes, key=changes.__getitem__)


def test_a_choice_of_another_case_is_taken(tmp_path: Path) -> None:
    results = ResultStore(tmp_path / "away")
    suite = elsewhere(weeks=[29]).chosen(cases=["away"], rows=["best-constant"])
    assert [(each.done, each.failed) for each in run(suite, results)] == [(3, ()), (1, ()), (1, ())]
    partition = {"suite": "small", "case": "tiny", "row": "best-constant", "seed": "0"}
    chosen = results.result(partition).metrics["chosen"]
    metrics = results.result(partition | {"case": "away"}).metrics
    assert (metrics["chosen"], metrics["sites"], metrics["weeks"]) == (chosen, ["tx"], [29])
    assert metrics["made_by"] == "small/tiny/best-constant/0"


def test_a_study_goes_on_with_more_rows_and_seeds_and_no_other_cases(store: ResultStore) -> None:
    more = {"idle": {"controller": "idle"}, "coldest": {"controller": "coldest"}}
    suite = small(**case(sites=["NY"]), rows=more, title="Another", seeds=3)
    (optima, rows) = run(suite, store, resume=True)
    assert (optima.done, optima.kept, rows.done, rows.kept) == (0, 1, 1, 1)
    with pytest.raises(ConfigError, match=r"holds a study with suite.cases.tiny.days 2, here 3"):
        run(small(**case(sites=["NY"], days=3)), store, resume=True)
