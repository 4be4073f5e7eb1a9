"""Training: what it keeps, how it is resumed, and how it ends when something goes wrong."""

from __future__ import annotations

import csv
import errno
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: make test-train")

from sdc_taichi.errors import SdcError  # noqa: E402
from sdc_taichi.learning import trainer  # noqa: E402
from sdc_taichi.learning.evaluation import Validation  # noqa: E402
from sdc_taichi.learning.policy import Policy  # noqa: E402
from sdc_taichi.learning.trainer import (  # noqa: E402
    Progress,
    Training,
    make_algorithm,
    train,
)
from sdc_taichi.learning.training_folder import read_state, settings_of  # noqa: E402
from sdc_taichi.learning.training_settings import (  # noqa: E402
    TrainingSettings,
    make_settings,
    merged,
)

UPDATES, ROLLOUT, DATA_CENTERS = 6, 40, 3
"""Three updates go beyond the end of an episode of 96 steps."""
SMALL: dict[str, Any] = {
    "config": "tiny",
    "weeks": [3],
    "data_centers": DATA_CENTERS,
    "environment": {"days": 1},
    "steps": UPDATES * ROLLOUT * DATA_CENTERS,
    "checkpoint_steps": ROLLOUT * DATA_CENTERS,
    "validation": {"steps": 0},
    "tensorboard": False,
}
LEARNING: dict[str, dict[str, Any]] = {
    "happo": {"rollout_decisions": ROLLOUT // 4, "hidden": [8], "epochs": 1},
    "hasac": {
        "rollout_decisions": ROLLOUT // 4,
        "gradient_steps": 2,
        "batch_size": 16,
        "replay_size": 512,
        "hidden": [8],
    },
}


def settings(algorithm: str = "happo", **changes: Any) -> TrainingSettings:
    values = SMALL | {"algorithm": algorithm, "learning": LEARNING[algorithm]}
    return make_settings(merged(values, changes))


def stop_after(updates: int) -> Callable[[], bool]:
    """Asked before every update and after the last one."""
    left = [updates]

    def stop() -> bool:
        left[0] -= 1
        return left[0] < 0

    return stop


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Rows of the curve, but for the time that they took."""
    with (folder / "training.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def assert_equal_trainings(one: Path, other: Path) -> None:
    for name in ("policy.safetensors", "policy.json"):
        assert (one / "policy" / name).read_bytes() == (other / "policy" / name).read_bytes()
    assert rows_of(one) == rows_of(other)
    states = [read_state(folder / "checkpoint.safetensors") for folder in (one, other)]
    for state in states:
        del state["seconds"]
    assert_equal(*states)


def assert_equal(one: Any, other: Any, place: str = "") -> None:
    """Equal to the bit, of equal types throughout."""
    assert type(one) is type(other), place
    if isinstance(one, dict):
        assert one.keys() == other.keys(), place
        for key in one:
            assert_equal(one[key], other[key], f"{place}.{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), place
        for i, pair in enumerate(zip(one, other, strict=True)):
            assert_equal(*pair, f"{place}.{i}")
    elif isinstance(one, np.ndarray | np.generic | torch.Tensor):
        a, b = np.asarray(one), np.asarray(other)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), place
    else:
        assert one == other, place


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Training:
    """A training without interruption."""
    return train(settings(), tmp_path_factory.mktemp("trainings") / "whole")


def test_a_training_leaves_settings_a_curve_a_policy_and_a_checkpoint(whole: Training) -> None:
    assert whole.is_whole
    assert (whole.updates, whole.steps) == (UPDATES, 720)
    names = {path.name for path in whole.folder.iterdir()}
    assert names == {"settings.yaml", "training.csv", "policy", "checkpoint.safetensors"}
    rows = rows_of(whole.folder)
    assert [int(row["steps"]) for row in rows] == [120 * n for n in range(1, 7)]
    # The first episode of 96 steps ends in the third update.
    assert [bool(row["return/agent_ls"]) for row in rows] == [False, False, *[True] * 4]
    policy = Policy.load(whole.folder)
    assert (policy.about.algorithm, policy.about.steps) == ("happo", 720)
    width = policy.interface.width
    seen = {str(a): np.zeros((2, width(a)), np.float32) for a in policy.interface.agents}
    assert policy.actions(seen)["agent_dc"].shape == (2, 1)


@pytest.mark.parametrize("algorithm", LEARNING)
def test_an_interrupted_training_goes_on_to_the_same_bits(
    whole: Training, tmp_path: Path, algorithm: str
) -> None:
    at_once = whole.folder
    if algorithm != "happo":
        at_once = train(settings(algorithm), tmp_path / "whole").folder
    done = train(settings(algorithm), tmp_path / "parts", stop=stop_after(3))
    assert not done.is_whole
    assert done.updates == 3
    done = train(settings(algorithm), tmp_path / "parts", resume=True)
    assert done.is_whole
    assert_equal_trainings(at_once, done.folder)


def test_a_killed_training_goes_on_from_its_last_checkpoint(
    whole: Training, tmp_path: Path
) -> None:
    (tmp_path / "settings.yaml").write_text(settings().to_yaml())
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from sdc_taichi.learning.trainer import train\n"
        "from sdc_taichi.learning.training_settings import load_settings\n"
        "folder = Path(sys.argv[1])\n"
        "kill = lambda now: now.update == 4 and os.kill(os.getpid(), signal.SIGKILL)\n"
        "train(load_settings(folder / 'settings.yaml'), folder, resume=True, on_update=kill)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert ended.returncode == -signal.SIGKILL
    # A row that was being written, and one that the checkpoint does not have.
    with (tmp_path / "training.csv").open("a") as file:
        file.write("5,600,1.0,-9\n6,7")
    assert train(settings(), tmp_path, resume=True).is_whole
    assert_equal_trainings(whole.folder, tmp_path)


def test_a_training_resumes_with_its_settings_alone_but_for_more_steps(
    whole: Training, tmp_path: Path
) -> None:
    train(settings(steps=360), tmp_path)
    with pytest.raises(SdcError, match=r"was trained with learning.epochs: 1, not 2; valid is to"):
        train(settings(learning={"epochs": 2}), tmp_path, resume=True)
    with pytest.raises(SdcError, match=r"steps 240: .* has done 360; valid is as many or more"):
        train(settings(steps=240), tmp_path, resume=True)
    assert settings_of(tmp_path) == settings(steps=360)
    assert train(settings(), tmp_path, resume=True).updates == UPDATES
    assert [row["update"] for row in rows_of(tmp_path)] == [str(n) for n in range(1, 7)]


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("value_loss/team", float("nan"), r"update 3: the value loss of team is nan"),
        ("policy_loss/agent_ls", float("inf"), r"the policy loss of agent_ls is inf"),
        ("value_loss/team", 1e9, r"value loss of team is 1e\+09, which has diverged"),
    ],
)
def test_a_diverging_training_says_which_loss_and_keeps_the_last_policy(
    whole: Training, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: float,
    said: str,
) -> None:  # fmt: skip
    train(settings(), tmp_path, stop=stop_after(2))
    kept = (tmp_path / "policy/policy.safetensors").read_bytes()

    def broken(*given: Any, **named: Any) -> Any:
        made = make_algorithm(*given, **named)
        update = made.update
        monkeypatch.setattr(made, "update", lambda stream: update(stream) | {name: value})
        return made

    monkeypatch.setattr(trainer, "make_algorithm", broken)
    with pytest.raises(SdcError, match=f"{said}.*the checkpoint of update 2 is kept"):
        train(settings(), tmp_path, resume=True)
    assert (tmp_path / "policy/policy.safetensors").read_bytes() == kept
    monkeypatch.undo()
    assert train(settings(), tmp_path, resume=True).is_whole
    assert_equal_trainings(whole.folder, tmp_path)


def test_a_full_disk_ends_a_training_with_the_checkpoint_before(
    whole: Training, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def fill(now: Progress) -> None:
        if now.update == 2:
            monkeypatch.setattr("sdc_taichi.atomic_file.os.fsync", full)

    with pytest.raises(SdcError, match=r"No space left on device; the checkpoint of update 2 is"):
        train(settings(), tmp_path, on_update=fill)
    monkeypatch.undo()
    assert train(settings(), tmp_path, resume=True).is_whole
    assert_equal_trainings(whole.folder, tmp_path)


def test_folders_that_are_not_free_are_refused(whole: Training, tmp_path: Path) -> None:
    with pytest.raises(SdcError, match="holds a training; go on with it with --resume"):
        train(settings(), whole.folder)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SdcError, match=r"holds other files \(notes.txt\); choose an empty folder"):
        train(settings(), tmp_path)
    with pytest.raises(SdcError, match="is a file; valid is a folder"):
        train(settings(), tmp_path / "notes.txt")
    with pytest.raises(SdcError, match="none: holds no training; valid is a folder that train has"):
        train(settings(), tmp_path / "none", resume=True)

    def train_there_too(_: Progress) -> None:
        with pytest.raises(SdcError, match="another run is writing it"):
            train(settings(), tmp_path / "both", resume=True)

    train(settings(), tmp_path / "both", on_update=train_there_too, stop=stop_after(1))


def test_damaged_checkpoints_are_refused(whole: Training, tmp_path: Path) -> None:
    train(settings(), tmp_path, stop=stop_after(1))
    path = tmp_path / "checkpoint.safetensors"
    content = path.read_bytes()
    for damaged in (b"", content[:-9], content[:-1] + bytes([content[-1] ^ 1])):
        path.write_bytes(damaged)
        with pytest.raises(SdcError, match=r"checkpoint.safetensors: (cannot be read|is damaged)"):
            train(settings(), tmp_path, resume=True)
    path.write_bytes((whole.folder / "policy/policy.safetensors").read_bytes())
    with pytest.raises(SdcError, match=r"checkpoint.safetensors: is no saved state"):
        train(settings(), tmp_path, resume=True)


def test_fewer_steps_than_an_update_and_fewer_data_centers_than_weeks_are_refused(
    tmp_path: Path,
) -> None:
    with pytest.raises(SdcError, match=r"steps 239: an update takes 120, .* valid is 240 or more"):
        train(settings(steps=239), tmp_path / "a")
    with pytest.raises(SdcError, match=r"data_centers 3: 4 of sites and weeks; valid is as many"):
        train(settings(weeks=[0, 1, 2, 4]), tmp_path / "b")
    with pytest.raises(SdcError, match="site"):
        train(settings(sites=["XX"]), tmp_path / "c")
    assert not [*tmp_path.glob("*/*")], "the folders are free for better settings"


def test_tensorboard_gets_the_numbers_of_the_curve(tmp_path: Path) -> None:
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    train(settings(tensorboard=True, steps=360), tmp_path, stop=stop_after(2))
    train(settings(tensorboard=True, steps=360), tmp_path, resume=True)
    events = accumulator.EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    found = [(e.step, e.value) for e in events.Scalars("reward/agent_dc")]
    rows = [(int(row["steps"]), float(row["reward/agent_dc"])) for row in rows_of(tmp_path)]
    np.testing.assert_allclose(found, rows, rtol=1e-6)


def test_the_best_policy_in_the_validation_weeks_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three validations the second reaches the most."""
    reached = iter([Validation(-1.0, 0.2, 0), Validation(-2.0, 0.4, 1), Validation(-1.5, 0.3, 0)])
    monkeypatch.setattr(trainer, "validate", lambda controller, weeks: next(reached))
    monkeypatch.setattr(trainer, "VALIDATION", (1,))
    given: dict[str, Any] = {"validation": {"steps": 240, "optimum": False}}
    train(settings(**given), tmp_path, stop=stop_after(4))
    done = train(settings(**given), tmp_path, resume=True)
    assert done.best == Validation(-2.0, 0.4, 1)
    with (tmp_path / "validation.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["update"], row["share"]) for row in rows] == [
        ("2", "0.2"),
        ("4", "0.4"),
        ("6", "0.3"),
    ]
    assert Policy.load(tmp_path / "best").about.steps == 480
    assert Policy.load(tmp_path).about.steps == 480
    assert Policy.load(tmp_path / "policy").about.steps == 720


def test_validation_runs_the_policy_in_its_weeks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer, "VALIDATION", (1,))
    given: dict[str, Any] = {"validation": {"steps": 720, "optimum": False}}
    seen: list[Progress] = []
    done = train(settings(**given), tmp_path, on_update=seen.append)
    assert [now.validation is not None for now in seen] == [False] * 5 + [True]
    assert done.best == seen[-1].validation
    assert done.best is not None
    assert -50.0 < done.best.change_pct < 50.0
