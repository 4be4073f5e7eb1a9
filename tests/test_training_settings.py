"""Settings of trainings: what is valid, scenarios, and how they are shown and changed."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import sdc_taichi.learning
from sdc_taichi import EnvOptions
from sdc_taichi.cli import train as train_command
from sdc_taichi.cli.app import app
from sdc_taichi.cli.terminal import duration
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.learning.algorithms import OffPolicySettings
from sdc_taichi.learning.split import TRAINING
from sdc_taichi.learning.training_settings import (
    SCENARIOS,
    TrainingSettings,
    load_settings,
    make_settings,
)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_settings_of_every_scenario_are_read_back_equal(scenario: str, tmp_path: Path) -> None:
    made = make_settings({"algorithm": "hasac", "scenario": scenario, "steps": "3e6"})
    assert isinstance(made.learning, OffPolicySettings)
    assert made.steps == 3_000_000
    path = tmp_path / "settings.yaml"
    path.write_text(made.to_yaml())
    assert load_settings(path) == made
    assert made.difference(load_settings(path)) is None
    configs = made.data_centers_of_weeks()
    if scenario == "hall":
        assert [config.name for config in configs] == ["ny"]
        return
    assert len(configs) == 8 * len(TRAINING)
    assert {config.site.start for config in configs} >= {"01-01", "12-17"}


def test_agents_observe_prices_where_rewards_depend_on_them() -> None:
    by_term = {"agent_bat": {"battery_carbon": 5.0, "battery_cost": 10.0}}
    for rewards, observes in (("default", False), ("bill", True), (by_term, True)):
        made = make_settings({"algorithm": "ippo", "environment": {"rewards": rewards}})
        assert ("price_forecast" in dict(made.environment.features or {})["agent_bat"]) == observes


def test_halls_are_drawn_for_the_sites_in_turn(tmp_path: Path) -> None:
    hall: dict[str, Any] = {"algorithm": "ippo", "scenario": "hall", "sites": ["NY", "AZ"]}
    settings = make_settings({**hall, "halls": {"count": 3, "seed": 1}})
    drawn = settings.data_centers_of_sites()
    assert [config.name for config in drawn] == ["hall0-ny", "hall1-az", "hall2-ny"]
    assert [config.site.location for config in drawn] == ["NY", "AZ", "NY"]
    assert len({config.hall.model_dump_json() for config in drawn}) == 3
    assert settings.validation_weeks() == 3 * len(settings.validation.weeks)
    path = tmp_path / "settings.yaml"
    path.write_text(settings.to_yaml())
    assert load_settings(path).data_centers_of_sites() == drawn
    others = make_settings({**hall, "halls": {"count": 3, "seed": 2}}).data_centers_of_sites()
    assert all(one.hall != other.hall for one, other in zip(drawn, others, strict=True))
    with pytest.raises(ConfigError, match="hall family: corrected has no rack type"):
        make_settings({"algorithm": "ippo", "halls": {"count": 1}}).data_centers_of_sites()


def test_agents_of_halls_share_a_policy_unless_set() -> None:
    hall = {"algorithm": "ippo", "scenario": "hall"}
    shared = make_settings(hall)
    assert shared.environment.agents == ("crac", "plant")
    assert (shared.environment.fan_change, shared.environment.setpoint_change_k) == (0.1, 0.5)
    assert "own_policies" not in shared.to_yaml()
    apart = make_settings({**hall, "own_policies": ["crac"]})
    assert make_settings(apart.model_dump(mode="json")) == apart
    assert shared.difference(apart) is not None
    for wrong, message in (
        ({"own_policies": ["plant"]}, r"\['plant'\]; valid are groups .*: \['crac'\]"),
        ({"own_policies": ["crac"], "algorithm": "ppo"}, "without effect with ppo"),
        ({"own_policies": ["crac"], "scenario": None}, r"that learn: \[\]"),
    ):
        with pytest.raises(ConfigError, match=message):
            make_settings({**hall, **wrong})


def test_values_lie_on_top_of_those_of_their_scenario() -> None:
    made = TrainingSettings(
        algorithm="ippo",
        scenario="bill-rich",
        sites=("ny",),
        overrides={"workload": {"flexible_share": 0.3}},
        environment=EnvOptions(days=3),
    )
    assert made.sites == ("NY",)
    assert (made.environment.days, made.environment.rewards) == (3, "bill")
    (config,) = made.data_centers_of_sites()
    assert config.workload.flexible_share == 0.3
    assert config.battery.hours_of_design_load == 4.0
    assert made.options().start == "fixed"


@pytest.mark.parametrize(("rewards", "share"), [("default", 1.0), ("bill", 1.0), ("paper", 0.8)])
def test_rewards_of_an_own_part_are_not_shared(rewards: str, share: float) -> None:
    made = make_settings({"algorithm": "ippo", "environment": {"rewards": rewards}})
    assert made.environment.collaboration == share
    again = make_settings(made.model_dump(mode="json"))
    assert again.environment == made.environment


def test_difference_names_the_setting_and_both_values() -> None:
    one = make_settings({"algorithm": "ippo", "steps": 10})
    assert one.difference(make_settings({"algorithm": "ippo", "steps": 20})) is None
    other = make_settings({"algorithm": "ippo", "environment": {"days": 3}})
    assert one.difference(other) == "environment.days: None, not 3"


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"algorithm": "hapo"}, "algorithm: no algorithm; did you mean 'happo'"),
        ({"scenario": ["carbon"]}, "scenario: should be a text"),
        ({"algoritm": "happo"}, "algoritm: unknown key; did you mean 'algorithm'"),
        ({"learning": {"epoch": 1}}, "settings of happo: epoch: unknown key; did you mean 'epochs"),
        ({"learning": {"reward": "onw"}}, "reward: should be 'own' or 'team' or .* number"),
        ({"algorithm": "ppo", "learning": {"reward": 0.5}}, "ppo has one learner .* valid is team"),
        ({"learning": {"discount": 2}}, "discount: should be less than or equal to 1"),
        ({"steps": 1.5}, "steps: .* valid integer"),
        ({"sites": ["NY", "ny"]}, r"sites: .* valid is each site once"),
        ({"weeks": [52]}, "weeks.*less than 52"),
        ({"scenario": "carbn"}, "scenario 'carbn'; did you mean 'carbon'"),
        ({"environment": {"day": 3}}, "environment.day: unknown key; did you mean 'days'"),
        ({"environment": {"days": 8}}, "environment.days 8: .* at most 7, or weeks null"),
        ({"environment": {"start": "fixed"}}, "environment.start: without effect with weeks"),
        ({"environment": {"rewards": print}}, "rewards: .* valid in settings is its name"),
    ],
)
def test_settings_that_are_not_valid_are_refused(values: dict[str, Any], said: str) -> None:
    with pytest.raises(SdcError, match=said):
        make_settings({"algorithm": "happo"} | values)


def shown(*arguments: str) -> str:
    found = CliRunner().invoke(app, ["train", *arguments, "--show"])
    assert found.exit_code == 0, found.output
    return found.stdout


def test_the_command_shows_the_settings_that_it_would_train_with(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(shown("happo", "tiny", "hall.rows=2", "--site", "ny,ca", "--steps", "2e6"))
    made = load_settings(path)
    assert (made.config, made.overrides) == ("tiny", {"hall": {"rows": 2}})
    assert (made.sites, made.steps) == (("NY", "CA"), 2_000_000)
    changed = shown("--settings", str(path), "--seed", "3", "--agents", "battery,load", "--set",
                    "learning.rate=3e-4")  # fmt: skip
    path.write_text(changed)
    made = load_settings(path)
    assert (made.algorithm, made.seed) == ("happo", 3)
    assert made.environment.agents == ("agent_ls", "agent_bat")
    assert made.model_dump()["learning"]["rate"] == 3e-4


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "ALGORITHM: missing; valid: ppo, ippo"),
        (["happo", "--agents", "bat"], "--agents 'bat': 'bat'; did you mean 'battery'"),
        (["happo", "tiny", "large"], "'large': a second preset or file after 'tiny'"),
        (["happo", "--set", "learning"], "override 'learning': valid is section.key=value"),
        (["happo", "--resume"], "--resume: without --out"),
        (["--resume", "--out", "none"], "none: holds no training"),
        (["--settings", "none.yaml"], "none.yaml: no such file"),
        (["ippo", "environment.rewards=energy", "--show"], "environment: unknown key"),
    ],
)
def test_errors_of_the_command_are_one_line(arguments: list[str], said: str) -> None:
    found = CliRunner().invoke(app, ["train", *arguments])
    assert found.exit_code == 2
    assert said in found.output
    assert found.output.count("\n") == 1


@pytest.fixture
def without_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    # Other tests of this process may have imported it already.
    monkeypatch.delitem(vars(sdc_taichi.learning), "train", raising=False)


@pytest.mark.usefixtures("without_torch")
def test_a_missing_torch_is_one_line_and_settings_need_none(tmp_path: Path) -> None:
    assert "algorithm: happo" in shown("happo")
    found = CliRunner().invoke(app, ["train", "happo", "--out", str(tmp_path / "run")])
    assert found.exit_code == 2
    assert found.output.count("\n") == 1
    assert 'pip install "sdc-taichi[train]"' in found.output
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("solved", [True, False], ids=["solved", "in the cache"])
def test_a_training_says_how_long_it_solves_optima(
    solved: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 0.0
    monkeypatch.setattr("sdc_taichi.cli.train.time.monotonic", lambda: now_s)
    weeks = make_settings({"algorithm": "ppo", "sites": ["ny", "ca"]}, "train").validation_weeks()
    assert weeks == 8
    with train_command._progress_of_training(weeks, shown=True) as reports:
        on_stage = reports["on_stage"]
        for stage, second_each in (("tables", 0.1), ("programmes", 3.0)) if solved else ():
            for done in range(4):
                on_stage(stage, done, 8)
                now_s += second_each
        for done in range(8):
            on_stage("values of ends", done, 8)
            now_s += 4.0 if solved else 0.01
    lines = capsys.readouterr().err.splitlines()
    if not solved:
        assert lines == []
        return
    assert lines[0].startswith("First the optima of 8 validation weeks are solved, once")
    of_programmes = 3.0 * (7 + train_command.ENDS_PER_PROGRAMME * 8)
    left = duration(of_programmes)
    assert lines[1] == f"programmes of 1/8 weeks; training begins in about {left}"
    assert "values of ends of 1/8 weeks; training begins in about 0:28" in lines
