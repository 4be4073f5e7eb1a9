"""Training of policies by an algorithm in a stream of environments, with the files of a training.

Each file of the folder is replaced atomically, and the checkpoint is replaced last. A complete
checkpoint therefore exists even if the process is killed.
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
from sdc_taichi.kernels.compiler.runtime import ensure_started
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
from sdc_taichi.learning.training_settings import LEAST_DATA_CENTERS, TrainingSettings
from sdc_taichi.optimum import StoppedError
from sdc_taichi.optimum.solve import Progress as StageProgress

LARGEST_LOSS = 1e6
"""Loss above which a training counts as diverged; values are normalised, so losses are about 1."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a training after an update."""

    update: int
    """Number of updates done so far."""
    updates: int
    """Total number of updates of the training."""
    steps: int
    """Number of steps done so far, summed over all data centers."""
    passed_s: float
    """Time since the first update of this process began, in s."""
    steps_per_s: float
    """Speed of this process in steps of all data centers per second, including validations."""
    left_s: float
    """Expected time until the end of the training, in s."""
    numbers: dict[str, float]
    """Logged values of the update by name, such as ``return/agent_ls``."""
    validation: Validation | None
    """Result of the policy in the validation weeks; None if this update had no validation."""


@dataclass(frozen=True, slots=True)
class Training:
    """Result of a training: its folder, its length and its best policy."""

    folder: Path
    """Folder of the training."""
    updates: int
    """Number of updates done."""
    steps: int
    """Number of steps done, summed over all data centers."""
    seconds: float
    """Total time of all processes of the training, in s."""
    is_whole: bool
    """True if all steps are done; False if the training was stopped early."""
    best: Validation | None
    """Result of the best policy in the validation weeks; None without validation."""


def train(
    settings: TrainingSettings,
    out: Path | str,
    *,
    resume: bool = False,
    others: str | None = None,
    cache: bool | str | os.PathLike[str] = True,
    on_update: Callable[[Progress], None] | None = None,
    on_stage: StageProgress | None = None,
    stop: Callable[[], bool] | None = None,
) -> Training:
    """Train policies, and write them to a folder.

    Args:
        settings: settings of the training.
        out: folder of the training; created if it does not exist.
        resume: True to continue the training in the folder. The result is bit-identical to that of
            an uninterrupted training. The saved settings must equal ``settings``, except that
            ``steps`` may be larger.
        others: name of the controller of the agents that do not learn, in place of that of the
            settings, of which the policy keeps that of the settings.
        cache: whether to read and write optima of the validation weeks in the user's cache, or the
            folder to use instead.
        on_update: called after every update.
        on_stage: progress callback ``(stage, done, total)`` of solving for the optima of the
            validation weeks.
        stop: called before every update; if it returns true, the training ends and can be resumed.

    Raises:
        SdcError: the folder contains other files or a training with different settings, or another
            process writes to it; settings contradict each other; a file cannot be written; or the
            training diverges. The last checkpoint and its policies are preserved.
    """
    path = Path(out)
    with _one_thread(), claimed(path, settings, resume=resume):
        run = _Run(settings, path, others)
        try:
            if resume:
                run.resume()
            # Write the settings after they were checked: invalid ones leave the folder unchanged.
            write_settings(path, settings)
            with run.validation(cache, on_stage, stop) as weeks:
                run.update_all(weeks, on_update or (lambda _: None), stop or (lambda: False))
        finally:
            run.close()
        return run.result()


class _Run:
    """State of a running training: environments, algorithm, progress and best result."""

    def __init__(self, settings: TrainingSettings, folder: Path, others: str | None = None) -> None:
        self._settings, self._folder, self._others = settings, folder, others
        self._env = env = make_env(settings, others)
        try:
            self._stream = make_stream(settings, env)
            own_policies = self._stream.own_policies
            self._interface = interface_of(env.core.sim.fleet, env.core.options, own_policies)
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
                threads=ensure_started(),
            )
        except BaseException:
            env.close()
            raise
        self._fingerprint = _fingerprint(settings, env)
        self._update = self._checkpoint_update = 0
        self._begun = time.perf_counter()
        self._best: Validation | None = None

    def close(self) -> None:
        """Close the environments."""
        self._env.close()

    def resume(self) -> None:
        """Load the checkpoint; without a checkpoint, the training starts from the beginning."""
        path = self._folder / CHECKPOINT_FILE
        if not path.exists():
            return
        saved = read_state(path)
        try:
            if saved["fingerprint"] != self._fingerprint:
                raise SdcError("is of other data centers or inputs; valid is with those of then")
            self._stream.load_state_dict(saved["stream"])
            self._algorithm.load_state_dict(saved["algorithm"])
            self._update = self._checkpoint_update = int(saved["update"])
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
        """Yield the validation weeks; None without validation, or if ``stop`` returned true.

        Raises:
            SdcError: the optimum of the validation weeks cannot be computed.
        """
        settings, validation = self._settings, self._settings.validation
        if not validation.steps or self._update == self._updates:
            yield None
            return
        try:
            weeks = prepare(
                settings.data_centers_of_sites(),
                VALIDATION if validation.weeks == "validation" else validation.weeks,
                years=validation.years,
                objective=validation.objective,
                optimum=validation.optimum,
                days=validation.days,
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

    def update_all(
        self,
        weeks: DataCenterWeeks | None,
        on_update: Callable[[Progress], None],
        stop: Callable[[], bool],
    ) -> None:
        """Make the remaining updates; end early if ``stop`` returns true.

        Raises:
            SdcError: the training diverges, or a file cannot be written.
        """
        settings, folder = self._settings, self._folder
        events = folder / EVENTS if settings.tensorboard else None
        first_update, begun = self._update, time.perf_counter()
        try:
            curves = CsvLog(folder / TRAINING_FILE, self._update)
            validations = CsvLog(folder / VALIDATION_FILE, self._update)
            with EventLog(events, after=self._steps) as log:
                while self._update < self._updates and not stop():
                    numbers = self._learn()
                    curves.add(self._row() | numbers)
                    log.add(numbers, self._steps)
                    validation = None
                    if weeks is not None and self._is_due(settings.validation.steps):
                        validation = self._validate(weeks)
                        results = validation._asdict()
                        validations.add(self._row() | results)
                        log.add({f"validation/{k}": x for k, x in results.items()}, self._steps)
                    if self._is_due(settings.checkpoint_steps):
                        self._write_checkpoint()
                        log.flush()
                    passed_s = time.perf_counter() - begun
                    done = self._update - first_update
                    on_update(
                        Progress(
                            update=self._update,
                            updates=self._updates,
                            steps=self._steps,
                            passed_s=passed_s,
                            steps_per_s=done * self._steps_each / passed_s,
                            left_s=passed_s / done * (self._updates - self._update),
                            numbers=numbers,
                            validation=validation,
                        )
                    )
            if self._checkpoint_update != self._update:
                self._write_checkpoint()
        except SdcError as error:
            checkpoint = "no checkpoint yet"
            if self._checkpoint_update:
                checkpoint = f"the checkpoint of update {self._checkpoint_update} is kept"
            raise SdcError(f"{error}; {checkpoint}") from None

    def _row(self) -> dict[str, Any]:
        """Return the first columns of a row, which are the same in both learning curves."""
        return {
            "update": self._update,
            "steps": self._steps,
            "seconds": round(self._seconds, 3),
        }

    def _validate(self, weeks: DataCenterWeeks) -> Validation:
        """Run the policy in the validation weeks, and save it if its objective is a new minimum."""
        policy = self._policy()
        controller = PolicyController(policy, weeks.sim.fleet, others=self._others)
        validation = validate(controller, weeks)
        if self._best is None or validation.change_pct < self._best.change_pct:
            self._best = validation
            policy.save(self._folder / BEST_POLICY)
        return validation

    def result(self) -> Training:
        """Return folder, length and best policy of the training."""
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
        """Number of steps done, summed over all data centers."""
        return self._update * self._steps_each

    @property
    def _seconds(self) -> float:
        """Total time of all processes of the training, in s."""
        return time.perf_counter() - self._begun

    def _is_due(self, interval: int) -> bool:
        """Return True if the last update reached a multiple of ``interval`` steps, or the end."""
        if self._update == self._updates:
            return True
        return self._steps // interval > (self._steps - self._steps_each) // interval

    def _learn(self) -> dict[str, float]:
        """Make an update and return the values to log; raise an error if the training diverged."""
        try:
            numbers = self._algorithm.update(self._stream)
            numbers |= {f"return/{name}": x for name, x in self._stream.returns.items()}
            check_numbers(numbers)
            for name, observations in self._stream.observations.items():
                if not torch.isfinite(observations).all():
                    raise SdcError(f"an observation of {name} is no finite number")
            self._algorithm.networks()
        except SdcError as error:
            raise SdcError(f"update {self._update + 1}: {error}") from None
        self._update += 1
        return numbers

    def _write_checkpoint(self) -> None:
        """Write the current policy, and then the checkpoint.

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
        self._checkpoint_update = self._update

    def _policy(self) -> Policy:
        """Return the current policy."""
        about = About(
            algorithm=self._settings.algorithm,
            seed=self._settings.seed,
            steps=self._steps,
            fingerprint=self._fingerprint,
            others=self._settings.environment.others,
            version=version("sdc-taichi"),
        )
        return Policy(
            self._algorithm.networks(),
            self._interface,
            about,
            self._settings.learning.decision_steps,
        )


class Algorithm(Protocol):
    """Learning algorithm, which acts in a stream of environments and updates its networks."""

    def update(self, stream: EnvironmentStream) -> dict[str, float]:
        """Act for some steps, learn from them, and return values to log by name."""

    def networks(self) -> tuple[PolicyNetwork, ...]:
        """Return the networks of the current policies."""

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state, from which a training continues with identical results."""

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore a state from ``state_dict`` of an algorithm with the same settings."""


def make_algorithm(
    name: str,
    settings: LearningSettings,
    stream: EnvironmentStream,
    *,
    updates: int,
    seed: int,
    threads: int = 1,
) -> Algorithm:
    """Create an algorithm in its state before the first update.

    Args:
        name: name of the algorithm.
        settings: settings of the algorithm.
        stream: the environments to learn in.
        updates: total number of updates of the training.
        seed: seed of all random numbers of the algorithm.
        threads: maximum number of networks that are updated at the same time.

    Raises:
        ConfigError: the algorithm does not support the type of actions, or needs more data centers.
    """
    match settings:
        case OnPolicySettings():
            return OnPolicy(
                ON_POLICY[name], settings, stream, updates=updates, seed=seed, threads=threads
            )
        case OffPolicySettings():
            return OffPolicy(OFF_POLICY[name], settings, stream, updates=updates, seed=seed)
        case CrossEntropySettings():
            return CrossEntropySearch(settings, stream, updates=updates, seed=seed)
    raise TypeError(f"no algorithm has {type(settings).__name__}")


def make_env(settings: TrainingSettings, others: str | None = None) -> MultiAgentVectorEnv:
    """Create the batch of environments of a training.

    Args:
        settings: settings of the training.
        others: controller of the agents that do not learn; None selects that of the settings.

    Raises:
        SdcError: a configuration or option is not valid, or the number of data centers is smaller
            than the number of pairs of site and week.
    """
    configs = settings.data_centers_of_weeks()
    count = settings.data_centers
    if count is None:
        count = len(configs) * math.ceil(LEAST_DATA_CENTERS / len(configs))
    if count < len(configs):
        raise ConfigError(
            f"data_centers {count}: {len(configs)} of sites and weeks; valid is as many or more"
        )
    options = settings.options()
    if others is not None:
        options = options.model_copy(update={"others": others})
    return vector_env(
        count, configs, options=options, precision=settings.precision,
        autoreset_mode="SameStep",
    )  # fmt: skip


def make_stream(settings: TrainingSettings, env: MultiAgentVectorEnv) -> EnvironmentStream:
    """Create the stream of environments from which the algorithm of a training learns."""
    learning = settings.learning
    return EnvironmentStream(
        env,
        joint=settings.algorithm == "ppo" and len(env.possible_agents) > 1,
        own_policies=settings.own_policies,
        decision_steps=learning.decision_steps,
        levels=learning.levels,
        shares_state=uses_state(settings.algorithm, settings.learning),
        against_idle=isinstance(learning, ActingSettings) and learning.against_idle,
        # Trainings with different seeds must have no data-center seed in common.
        seed=settings.seed * env.num_envs,
    )


def check_numbers(numbers: Mapping[str, float]) -> None:
    """Check the logged values of an update for divergence.

    Raises:
        SdcError: a value is not finite, or a loss is above ``LARGEST_LOSS``.
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
    """Return a fingerprint of the simulator and of all settings except ``steps``."""
    digest = hashlib.sha256(env.core.sim.fingerprint().encode())
    digest.update(settings.model_copy(update={"steps": 1}).to_yaml().encode())
    return digest.hexdigest()


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Limit PyTorch to one thread, which is reproducible and faster for small networks."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
