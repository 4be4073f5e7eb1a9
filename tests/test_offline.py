"""Data sets in Minari's format: what is written loads, and its environment gives it again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

minari = pytest.importorskip("minari", reason="Minari is not installed: make test-train")
h5py = pytest.importorskip("h5py", reason="h5py is not installed: make test-train")

from sdc_taichi import load_config  # noqa: E402
from sdc_taichi.benchmark.episodes import Collection  # noqa: E402
from sdc_taichi.benchmark.offline import write_data_set  # noqa: E402
from sdc_taichi.cli.app import app  # noqa: E402
from sdc_taichi.errors import SdcError  # noqa: E402
from sdc_taichi.optimum import StoppedError  # noqa: E402
from small_halls import hall  # noqa: E402

DOCS = Path(__file__).parent.parent / "docs"
ID = "sdc_taichi/tiny-ca-v0"
COMMAND = "collect tiny --site CA --weeks 0,26 --days 1 --controller g36 --controller optimum"


def collect(out: Path, *more: str) -> Result:
    return CliRunner().invoke(app, [*COMMAND.split(), f"--out={out}", *more])


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Folder of a data set of a rule and the optimum, and of the cache of optima."""
    root = tmp_path_factory.mktemp("datasets")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(root / "cache"))
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        done = collect(root)
        assert done.exit_code == 0, done.output
        assert "optimum: 2 episodes, 192 steps" in done.output
        yield root


def test_minari_loads_it_and_its_environment_gives_it_again(root: Path) -> None:
    data = minari.load_dataset(ID)
    assert (data.total_episodes, data.total_steps) == (4, 384)
    with pytest.MonkeyPatch.context() as patch:
        # Minari makes its root where it is not told of one.
        patch.setenv("HOME", str(root / "home"))
        assert list(minari.list_local_datasets()) == [ID]
        assert not (root / "home").exists()
    env = data.recover_environment()
    abouts = list(data.storage.get_episode_metadata(range(4)))
    assert [about["controller"] for about in abouts] == ["g36", "g36", "optimum", "optimum"]
    for about, episode in zip(abouts[1:3], list(data)[1:3], strict=True):
        observation, _ = env.reset(seed=about["seed"], options=about["options"])
        observations, rewards = [observation], []
        for action in episode.actions:
            observation, reward, _, _, info = env.step(action)
            observations.append(observation)
            rewards.append(reward)
        np.testing.assert_array_equal(np.stack(observations), episode.observations)
        np.testing.assert_array_equal(rewards, episode.rewards)
        assert episode.infos["carbon_g"][0] == 0.0
        assert episode.infos["carbon_g"][-1] == info["carbon_g"]
        assert not episode.terminations.any()
        assert np.flatnonzero(episode.truncations).tolist() == [95]
        assert about["return"] == episode.rewards.sum()
    env.close()


def test_scores_are_0_for_idle_commands_and_1_for_the_optimum(root: Path) -> None:
    data = minari.load_dataset(ID)
    best = np.mean([episode.rewards.sum() for episode in list(data)[2:]])
    assert minari.get_normalized_score(data, best) == pytest.approx(1.0)
    assert data.storage.metadata["ref_min_score"] < best
    card = (root / ID / "README.md").read_text(encoding="utf-8")
    assert "| optimum | 2 | 192 |" in card
    assert "| 57 | dc\\_load |" in card  # the last of 58 entries
    assert "| 2 | agent\\_bat | battery |" in card


def test_the_same_command_gives_the_same_bytes(root: Path, tmp_path: Path) -> None:
    assert collect(tmp_path, "--quiet").exit_code == 0
    for name in ("main_data.hdf5", "metadata.json"):
        again = (tmp_path / ID / "data" / name).read_bytes()
        assert again == (root / ID / "data" / name).read_bytes()


def test_a_data_set_is_replaced_only_if_asked(root: Path) -> None:
    before = json.loads((root / ID / "data" / "metadata.json").read_text())
    done = collect(root)
    assert done.exit_code == 2
    assert "exists; choose another name or replace it with --force" in done.output
    assert json.loads((root / ID / "data" / "metadata.json").read_text()) == before


def test_what_is_not_whole_leaves_nothing(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    chosen = Collection(load_config("tiny"), ("random",), (0,), days=1)
    left = tmp_path / ".tiny-v0.unfinished"
    left.mkdir()
    asked = iter([False] * 100 + [True])  # within the second of two episodes
    with pytest.raises(StoppedError):
        write_data_set(chosen, tmp_path, "tiny-v0", stop=lambda: next(asked))
    assert list(tmp_path.iterdir()) == []
    write_data_set(chosen, Path(), "tiny-v0")  # below a relative path
    metadata = minari.MinariDataset(tmp_path / "tiny-v0" / "data").storage.metadata
    assert metadata["total_episodes"] == 1
    assert "ref_max_score" not in metadata


def test_agents_of_crac_units_act_side_by_side(tmp_path: Path) -> None:
    options = {"agents": ["crac", "plant"]}
    made = Collection(hall(2), ("random",), (0,), days=1, environment=options)
    card = (write_data_set(made, tmp_path, "hall-v0").folder / "README.md").read_text()
    for row in (r"| 0 | crac\_0 | fan |", r"| 1 | crac\_1 | fan |", "| 2 | plant | cooling |"):
        assert row in card


def test_what_cannot_be_written_is_one_error(tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / "file").write_text("")
    chosen = Collection(load_config("tiny"), ("random",), (0,), days=1)
    with pytest.raises(SdcError, match=r"file/tiny-v0: cannot be written"):
        write_data_set(chosen, tmp_path / "file", "tiny-v0")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    with pytest.raises(SdcError, match="0 MB are free"):
        write_data_set(chosen, tmp_path, "tiny-v0")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
