"""Training of policies by an algorithm in a stream of environments, and the files it writes.

Each file of the folder is replaced as a whole, and the checkpoint last, so that the last one stays
whatever ends a process.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import torch

from sdc_taichi.envs.vector import MultiAgentVectorEnv, vector_env
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.learning.algorithms import (
    OFF_POLICY,
    ON_POLICY,
    ActingSettings,
    CrossEntropySettings,
    LearningSettings,
    OffPolicySettings,
    OnPolicySettings,
    uses_state,
)
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.cross_entropy import CrossEntropySearch
from sdc_taichi.learning.evaluation import DataCenterWeeks, Validation, prepare, validate
from sdc_taichi.learning.interface import interface_of
from sdc_taichi.learning.off_policy import OffPolicy
from sdc_taichi.learning.on_policy import OnPolicy
from sdc_taichi.learning.policy import About, Policy, PolicyNetwork
from sdc_taichi.learning.split import VALIDATION
from sdc_taichi.learning.stream import EnvironmentStream
from sdc_taichi.learning.training_folder import (
    BEST_POLICY,
    CHECKPOINT_FILE,
    EVENTS,
    LAST_POLICY,
    TRAINING_FILE,
    VALIDATION_FILE,
    CsvLog,
    EventLog,
    claimed,
    read_state,
    write_settings,
    write_state,
)
from sdc_taichi.learning.training_settings import TrainingSettings
from sdc_taichi.optimum import StoppedError
from sdc_taichi.optimum.solve import Progress as StageProgress

LEAST_DATA_CENTERS = 256
"""Least number of data centers of a training that does not say how many."""
LARGEST_LOSS = 1e6
"""Loss beyond which a training has diverged; losses are of normalised values, and about 1."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a training after an update."""

    update: int
    """Number of updates done."""
    updates: int
    """Number of updates of the whole training."""
    steps: int
    """Steps of all data centers together that are done."""
    passed_s: float
    """Time of this process since its first update began, in s."""
    steps_per_s: float
    """Steps of all data centers together per second of this process, validations included, 1/s."""
    left_s: float
    """Expected time until the end, in s."""
    numbers: dict[str, float]
    """Numbers of the update by name, such as ``return/agent_ls`` and ``value_loss/agent_ls``."""
    validation: Validation | None
    """Result of the policy in the validation weeks after the update; None if it was not run
    there."""


@dataclass(frozen=True, slots=True)
class Training:
    """Result of a training: its folder, its length and its best policy."""

    folder: Path
    """Folder of the training."""
    updates: int
    """Number of updates done."""
    steps: int
    """Steps of all data centers together that are done."""
    seconds: float
    """Time that all processes of the training took, in s."""
    is_whole: bool
    """Whether all steps are done; false if it was stopped."""
    best: Validation | None
    """Result of the best policy in the validation weeks; None without validation."""


def train(
    settings: TrainingSettings,
    out: Path | str,
    *,
    resume: bool = False,
    cache: bool | str | os.PathLike[str] = True,
    on_update: Callable[[Progress], None] | None = None,
    on_stage: StageProgress | None = None,
    stop: Callable[[], bool] | None = None,
) -> Training:
    """Train policies, and keep them in a folder.

    Args:
        settings: settings of the training.
        out: folder, made if need be.
        resume: whether to go on with the training in the folder, to the same bits as if it had not
            been interrupted; its settings must be those given, but that ``steps`` may be more.
        cache: whether to read and keep optima of the validation weeks among the user's caches, or
            a folder for them.
        on_update: called after every update.
        on_stage: is told of the stages of solving for the optima of the validation weeks.
        stop: asked after every update; true ends the training, which can be resumed.

    Raises:
        SdcError: the folder is not free, holds a training with other settings or is written by
            another process; settings do not fit each other; a file cannot be written; or the
            training diverges. Checkpoint and policies are those of the last checkpoint then.
    """
    path = Path(out)
    with _one_thread(), claimed(path, settings, resume=resume):
        run = _Run(settings, path)
        try:
            if resume:
                run.resume()
            # Settings that do not fit leave the folder as it was.
            write_settings(path, settings)
            with run.validation(cache, on_stage, stop) as weeks:
                run.go_on(weeks, on_update or (lambda _: None), stop or (lambda: False))
        finally:
            run.close()
        return run.result()


class _Run:
    """A training under way."""

    def __init__(self, settings: TrainingSettings, folder: Path) -> None:
        self._settings, self._folder = settings, folder
        self._env = env = make_env(settings)
        try:
            self._interface = interface_of(env.core.sim.fleet, env.core.options)
            self._stream = make_stream(settings, env)
            learning, episode_steps = settings.learning, self._stream.episode_steps
            self._steps_each = env.num_envs * learning.steps_per_update(episode_steps)
            self._updates = settings.steps // self._steps_each
            least = learning.least_updates
            if self._updates < least:
                raise ConfigError(
                    f"steps {settings.steps:,}: an update takes {self._steps_each:,}, of "
                    f"{env.num_envs:,} data centers, and {settings.algorithm} learns from update "
                    f"{least} on; valid is {least * self._steps_each:,} or more"
                )
            self._algorithm = make_algorithm(
                settings.algorithm,
                learning,
                self._stream,
                updates=self._updates,
                seed=settings.seed,
            )
        except BaseException:
            env.close()
            raise
        self._fingerprint = _fingerprint(settings, env)
        self._update = self._kept = 0
        self._begun = time.perf_counter()
        self._best: Validation | None = None

    def close(self) -> None:
        """Close the environments."""
        self._env.close()

    def resume(self) -> None:
        """Go on from the checkpoint; from the beginning if the training had not come to one."""
        path = self._folder / CHECKPOINT_FILE
        if not path.exists():
            return
        saved = read_state(path)
        try:
            if saved["fingerprint"] != self._fingerprint:
                raise SdcError("is of other data centers or inputs; valid is with those of then")
            self._stream.load_state_dict(saved["stream"])
            self._algorithm.load_state_dict(saved["algorithm"])
            self._update = self._kept = int(saved["update"])
            self._begun = time.perf_counter() - float(saved["seconds"])
            self._best = None if saved["best"] is None else Validation(*saved["best"])
        except SdcError as error:
            raise SdcError(f"{path}: {error}") from None
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise SdcError(f"{path}: is no checkpoint of this training ({error})") from None
        if self._update > self._updates:
            raise ConfigError(
                f"steps {self._settings.steps:,}: {self._folder} has done {self._steps:,}; valid "
                "is as many or more"
            )

    @contextlib.contextmanager
    def validation(
        self,
        cache: bool | str | os.PathLike[str],
        progress: StageProgress | None,
        stop: Callable[[], bool] | None,
    ) -> Iterator[DataCenterWeeks | None]:
        """Prepared validation weeks; None if there are none, or if preparing them was stopped.

        Raises:
            SdcError: there is no optimum of them.
        """
        settings, chosen = self._settings, self._settings.validation
        if not chosen.steps or self._update == self._updates:
            yield None
            return
        try:
            weeks = prepare(
                settings.data_centers_of_sites(),
                VALIDATION if chosen.weeks == "validation" else chosen.weeks,
                objective=chosen.objective,
                optimum=chosen.optimum,
                days=chosen.days,
                forecast_error=self._env.core.options.forecast_error,
                precision=settings.precision,
                cache=cache,
                progress=progress,
                stop=stop,
            )
        except StoppedError:
            yield None
            return
        except SdcError as error:
            raise SdcError(f"validation: {error}") from None
        with weeks:
            yield weeks

    def go_on(
        self,
        weeks: DataCenterWeeks | None,
        on_update: Callable[[Progress], None],
        stop: Callable[[], bool],
    ) -> None:
        """Update until all steps are done, or until told to stop.

        Raises:
            SdcError: the training diverges, or a file cannot be written.
        """
        try:
            self._go_on(weeks, on_update, stop)
        except SdcError as error:
            kept = f"the checkpoint of update {self._kept} is kept"
            raise SdcError(f"{error}; {kept if self._kept else 'no checkpoint yet'}") from None

    def _go_on(
        self,
        weeks: DataCenterWeeks | None,
        on_update: Callable[[Progress], None],
        stop: Callable[[], bool],
    ) -> None:
        settings = self._settings
        events = self._folder / EVENTS if settings.tensorboard else None
        table = CsvLog(self._folder / TRAINING_FILE, self._update)
        validations = CsvLog(self._folder / VALIDATION_FILE, self._update)
        meter = _Speed(self._steps_each)
        with EventLog(events, after=self._steps) as log:
            while self._update < self._updates and not stop():
                numbers = self._learn()
                table.add(self._row() | numbers)
                log.add(numbers, self._steps)
                tried = None
                if weeks is not None and self._is_due(settings.validation.steps):
                    tried = self._validate(weeks)
                    validations.add(self._row() | tried._asdict())
                    log.add({f"validation/{k}": x for k, x in tried._asdict().items()}, self._steps)
                if self._is_due(settings.checkpoint_steps):
                    self._keep()
                    log.flush()
                on_update(meter.progress(self._update, self._updates, numbers, tried))
        if self._kept != self._update:
            self._keep()

    def _row(self) -> dict[str, Any]:
        """First entries of the rows of an update."""
        seconds = round(self._seconds, 3)
        return {"update": self._update, "steps": self._steps, "seconds": seconds}

    def _validate(self, weeks: DataCenterWeeks) -> Validation:
        """Run the policy in the validation weeks, and save it if its figure is the least of all."""
        policy = self._policy()
        found = validate(PolicyController(policy, weeks.sim.fleet), weeks)
        if self._best is None or found.change_pct < self._best.change_pct:
            self._best = found
            policy.save(self._folder / BEST_POLICY)
        return found

    def result(self) -> Training:
        """Folder, length and best policy of the training."""
        return Training(
            folder=self._folder,
            updates=self._update,
            steps=self._steps,
            seconds=self._seconds,
            is_whole=self._update == self._updates,
            best=self._best,
        )

    @property
    def _steps(self) -> int:
        """Steps of all data centers together that are done."""
        return self._update * self._steps_each

    @property
    def _seconds(self) -> float:
        """Seconds that all processes of the training took."""
        return time.perf_counter() - self._begun

    def _is_due(self, interval: int) -> bool:
        """Whether the last update is the last of all, or passed a multiple of a number of steps."""
        if self._update == self._updates:
            return True
        return self._steps // interval > (self._steps - self._steps_each) // interval

    def _learn(self) -> dict[str, float]:
        """Make an update, and refuse numbers and networks that are not finite."""
        try:
            numbers = self._algorithm.update(self._stream)
            numbers |= {f"return/{name}": x for name, x in self._stream.returns.items()}
            check_numbers(numbers)
            for name, seen in self._stream.observations.items():
                if not torch.isfinite(seen).all():
                    raise SdcError(f"an observation of {name} is no finite number")
            self._algorithm.networks()
        except SdcError as error:
            raise SdcError(f"update {self._update + 1}: {error}") from None
        self._update += 1
        return numbers

    def _keep(self) -> None:
        """Write the policy and a checkpoint.

        Raises:
            SdcError: a file cannot be written.
        """
        self._policy().save(self._folder / LAST_POLICY)
        state = {
            "fingerprint": self._fingerprint,
            "update": self._update,
            "seconds": self._seconds,
            "best": None if self._best is None else tuple(self._best),
            "algorithm": self._algorithm.state_dict(),
            "stream": self._stream.state_dict(),
        }
        write_state(self._folder / CHECKPOINT_FILE, state)
        self._kept = self._update

    def _policy(self) -> Policy:
        """The policy as it is."""
        about = About(
            algorithm=self._settings.algorithm,
            seed=self._settings.seed,
            steps=self._steps,
            fingerprint=self._fingerprint,
            others=self._env.core.options.others,
            version=version("sdc-taichi"),
        )
        return Policy(
            self._algorithm.networks(),
            self._interface,
            about,
            self._settings.learning.decision_steps,
        )


class Algorithm(Protocol):
    """A learner in a stream of environments that makes networks of policies."""

    def update(self, stream: EnvironmentStream) -> dict[str, float]:
        """Act for some steps, learn, and return numbers to log by name."""

    def networks(self) -> tuple[PolicyNetwork, ...]:
        """Networks of the policies as they are now."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides how the training goes on."""

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` of an algorithm of equal settings returned."""


def make_algorithm(
    name: str, settings: LearningSettings, stream: EnvironmentStream, *, updates: int, seed: int
) -> Algorithm:
    """Make an algorithm, before its first update.

    Args:
        name: name of the algorithm.
        settings: settings of the algorithm.
        stream: the environments to learn in.
        updates: number of updates of the whole training.
        seed: seed of all random numbers of the algorithm.

    Raises:
        ConfigError: actions that the algorithm cannot decide, or fewer data centers than it needs.
    """
    match settings:
        case OnPolicySettings():
            return OnPolicy(ON_POLICY[name], settings, stream, updates=updates, seed=seed)
        case OffPolicySettings():
            return OffPolicy(OFF_POLICY[name], settings, stream, updates=updates, seed=seed)
        case CrossEntropySettings():
            return CrossEntropySearch(settings, stream, updates=updates, seed=seed)
    raise TypeError(f"no algorithm has {type(settings).__name__}")


class _Speed:
    """Steps per second since the process began."""

    def __init__(self, steps_each: int) -> None:
        self._steps_each, self._begun, self._done = steps_each, time.perf_counter(), 0

    def progress(
        self,
        update: int,
        updates: int,
        numbers: dict[str, float],
        validation: Validation | None,
    ) -> Progress:
        """Progress of the training after one more update."""
        self._done += 1
        seconds = time.perf_counter() - self._begun
        return Progress(
            update=update,
            updates=updates,
            steps=update * self._steps_each,
            passed_s=seconds,
            steps_per_s=self._done * self._steps_each / seconds,
            left_s=seconds / self._done * (updates - update),
            numbers=numbers,
            validation=validation,
        )


def make_env(settings: TrainingSettings) -> MultiAgentVectorEnv:
    """The data centers of a training.

    Raises:
        SdcError: a configuration or option that is not valid, or fewer data centers than sites and
            weeks.
    """
    configs = settings.data_centers_of_weeks()
    count = settings.data_centers
    if count is None:
        count = len(configs) * math.ceil(LEAST_DATA_CENTERS / len(configs))
    if count < len(configs):
        raise ConfigError(
            f"data_centers {count}: {len(configs)} of sites and weeks; valid is as many or more"
        )
    return vector_env(
        count, configs, options=settings.options(), precision=settings.precision,
        autoreset_mode="SameStep",
    )  # fmt: skip


def make_stream(settings: TrainingSettings, env: MultiAgentVectorEnv) -> EnvironmentStream:
    """The stream that the algorithm of a training learns from."""
    learning = settings.learning
    return EnvironmentStream(
        env,
        joint=settings.algorithm == "ppo" and len(env.possible_agents) > 1,
        decision_steps=learning.decision_steps,
        levels=learning.levels,
        shares_state=uses_state(settings.algorithm, settings.learning),
        against_idle=isinstance(learning, ActingSettings) and learning.against_idle,
        # No two trainings share the seed of a data center.
        seed=settings.seed * env.num_envs,
    )


def check_numbers(numbers: Mapping[str, float]) -> None:
    """Refuse numbers of an update that has diverged.

    Args:
        numbers: numbers of the update by name.

    Raises:
        SdcError: a number that is not finite, or a loss that is beyond all measure.
    """
    for name, value in numbers.items():
        kind, _, whose = name.partition("/")
        what = f"{kind.replace('_', ' ')} of {whose}" if whose else kind
        if not math.isfinite(value):
            raise SdcError(f"the {what} is {value}; a lower learning rate may help")
        if "loss" in kind and abs(value) > LARGEST_LOSS:
            raise SdcError(
                f"the {what} is {value:.3g}, which has diverged; a lower learning rate may help"
            )


def _fingerprint(settings: TrainingSettings, env: MultiAgentVectorEnv) -> str:
    """Fingerprint of what a training learns from."""
    digest = hashlib.sha256(env.core.sim.fingerprint().encode())
    digest.update(settings.model_copy(update={"steps": 1}).to_yaml().encode())
    return digest.hexdigest()


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let PyTorch use one thread: faster than several for networks of this size, and repeatable."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
