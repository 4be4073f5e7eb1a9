"""Computation of optima: tables, bounds and plans of data centers, and simulation of the plans."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from threading import Event
from typing import Any, TypeVar

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, whole_number
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.optimum.cache import Cache, Entry, cache_in
from sdc_taichi.optimum.linear_programme import bound
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.paths import (
    IDLE,
    JOINT,
    agents_of,
    best_response,
    path_of,
    targets_of,
    with_battery_for,
)
from sdc_taichi.optimum.problem import (
    Agent,
    Ends,
    Problem,
    StoppedError,
    forced_discharge_reason,
    loops_reason,
    no_table_reasons,
    require_traces,
    uncooled_reason,
)
from sdc_taichi.optimum.result import BoundOfEnds, Optimum
from sdc_taichi.optimum.rollout import (
    LARGEST_TABLE_ERROR,
    LEAST_K,
    Certificate,
    RollOut,
    Targets,
    certificate,
    roll_out,
)
from sdc_taichi.optimum.task import (
    INLET_LIMITS_C,
    MOST_STEPS,
    Task,
    checked_agents,
    checked_start,
    seeds_of_sampled_events,
)
from sdc_taichi.optimum.uncoordinated import response_count, title_of, uncoordinated
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim import snapshot
from sdc_taichi.sim.bills import with_prices
from sdc_taichi.sim.drivers import Drivers, load_drivers
from sdc_taichi.sim.events import seeds_of_fleet
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.types import F64, I64

_LEAST_ENERGY_ERROR = 1e-6
"""Relative difference between simulated and planned energy that causes a new battery plan."""
_BOUND = "bound"
"""Key of the bound in a dict that otherwise contains paths by name."""
_SOLVER_ERROR = 1e-6
"""Margin of the bound for the errors of solvers and for tolerances of the end state, relative."""
_AGAIN = "all agents with the battery planned again"
"""Name of the path whose battery is planned for the simulated energy of the facility."""
_MARGIN_FACTOR = 2.0
"""Margin of a battery plan at its end, relative to the energy that the plan before lacked."""
_POLL_S = 0.2
"""Time between two calls of ``stop``, in s."""

_X = TypeVar("_X")
_Plans = list[F64 | None]
"""Plans of one agent in B data centers; None where no plan satisfies the limits."""
Progress = Callable[[str, int, int], None]
"""Progress callback ``(stage, done, total)``."""


def solve(
    configs: Fleet | DataCenterConfig | Iterable[DataCenterConfig],
    *,
    steps: int,
    start: I64 | Sequence[int] | None = None,
    seed: int = 0,
    drivers: Drivers | None = None,
    objective: Objective | str = "carbon",
    agents: Sequence[Agent] | None = None,
    scored_from: int = 0,
    inlet_limit_c: float | None = None,
    precision: Precision = "f32",
    uncoordinated: bool = False,
    cache: bool | str | os.PathLike[str] = True,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> Optimum:
    """Compute how well the best controllers of data centers can do if all inputs are known.

    The bound comes from ``linear_programme.bound``. The achieved figure is that of the best plan
    among several that were simulated and satisfy the constraints.

    Args:
        configs: A fleet, one config or several configs of B data centers.
        steps: Number of steps, T.
        start: First step of each data center, counted from the beginning of the year, (B,). None
            means the first step of the drivers.
        seed: Seed of the sampled events.
        drivers: Inputs of the data centers; None reads the inputs that the configs name.
        objective: Objective to minimise, as object or text.
        agents: Agents that plans may control; None means all: load, cooling and battery, and
            liquid where there are coolant loops.
        scored_from: Number of the first scored step. If it is not 0, plans must end in the state of
            this step.
        inlet_limit_c: Highest inlet temperature that plans may cause if another setpoint avoids it,
            in C. None means the limit of ``protection.ashrae_class``, or no limit without it.
        precision: Floating-point precision of the hall kernels.
        uncoordinated: True to compute also the figures of plans that two or more agents make
            without coordination (``Optimum.uncoordinated``), which takes several times as long.
        cache: True to read and write results in the user's cache, False for no cache, or the
            folder of a cache.
        progress: Progress callback ``(stage, done, total)``.
        stop: Called regularly; the work ends if it returns True. Finished results stay in the
            cache.

    Raises:
        ConfigError: An argument is not valid.
        StoppedError: ``stop`` returned True.
        PhysicalLimitError: A simulated result is outside the physical limits.
    """
    fleet = configs if isinstance(configs, Fleet) else build_fleet(configs)
    steps = whole_number("steps", steps, 1, MOST_STEPS)
    seed = whole_number("seed", seed, 0, 2**63 - 1)
    low_c, high_c = INLET_LIMITS_C
    if inlet_limit_c is not None and not low_c <= inlet_limit_c <= high_c:
        raise ConfigError(
            f"inlet_limit_c {inlet_limit_c:g}: valid is {low_c:g}..{high_c:g} C, or None"
        )
    if precision not in ("f32", "f64"):
        raise ConfigError(f"precision {precision!r}: valid are f32 and f64")
    require_traces(fleet)
    inputs = load_drivers(fleet.configs) if drivers is None else drivers
    if inputs.size != fleet.size:
        raise ConfigError(f"drivers of {inputs.size} data centers for a fleet of {fleet.size}")
    movable = checked_agents(agents, fleet)
    task = Task(
        fleet=fleet,
        drivers=with_prices(inputs, fleet.configs),
        start=checked_start(inputs.start if start is None else start, fleet.size),
        seed=seeds_of_sampled_events(seeds_of_fleet(seed, fleet.names), fleet),
        steps=steps,
        objective=Objective.parse(objective) if isinstance(objective, str) else objective,
        agents=movable,
        scored_from=whole_number("scored_from", scored_from, 0, steps - 1),
        inlet_limit_c=inlet_limit_c,
        precision=precision,
        uncoordinated=uncoordinated and len(_players(movable)) > 1,
    )
    if task.objective.heat:
        raise ConfigError(
            f"objective {task.objective}: heat is not planned; valid for optima are carbon, "
            "energy, cost, water, and sums of them"
        )
    used_cache = cache_in(cache)
    work = _Work(progress or (lambda _stage, _done, _total: None), stop or (lambda: False))
    return _optimum(task, work.entries(task, used_cache), used_cache)


def _optimum(task: Task, entries: Sequence[Entry], cache: Cache | None) -> Optimum:
    """Join the entries of B data centers to one ``Optimum``."""

    def each(name: str) -> F64:
        return np.array([getattr(entry, name) for entry in entries], dtype=np.float64)

    def paths(name: str) -> F64:
        return np.stack([getattr(entry, name) for entry in entries], axis=1)

    limits = [entry.certificate["inlet_limit_c"] for entry in entries]
    return Optimum(
        names=task.fleet.names,
        fingerprint=snapshot.fingerprint(task.fleet, task.drivers, task.precision),
        objective=task.objective,
        agents=task.agents,
        start=task.start,
        seed=task.seed,
        steps=task.steps,
        scored_from=task.scored_from,
        inlet_limit_c=np.array(limits),
        idle=each("idle"),
        idle_dropped_tasks=each("idle_dropped_tasks"),
        bound=each("bound"),
        achieved=each("achieved"),
        alone={agent: np.array([entry.alone[agent] for entry in entries]) for agent in task.agents},
        uncoordinated={
            way: np.array([entry.uncoordinated[way] for entry in entries])
            for way in (entries[0].uncoordinated if task.uncoordinated else ())
        },
        bound_kinds=tuple(entry.kind for entry in entries),
        failures=tuple(
            entry.failures + (entry.uncoordinated_failures if task.uncoordinated else ())
            for entry in entries
        ),
        certificates=tuple(entry.certificate for entry in entries),
        load=paths("load"),
        cooling=paths("cooling"),
        battery=paths("battery"),
        loops=np.stack([entry.loops for entry in entries], axis=1),
        bound_of_ends=BoundOfEnds(task, [entry.kind for entry in entries], cache),
    )


def _players(agents: Sequence[Agent]) -> tuple[Agent, ...]:
    """Return the agents that make a plan of their own; coolant loops follow the work."""
    return tuple(agent for agent in agents if agent != "liquid")


@dataclass(frozen=True, slots=True)
class _Run:
    """A simulated plan of one data center."""

    path: Targets
    """Target states of the plan."""
    done: RollOut
    """Simulated results of each step."""
    certificate: Certificate
    """Figure and constraints, measured in the scored steps."""


@dataclass(slots=True)
class _Case:
    """Intermediate results of one data center: its bound and its simulated plans."""

    problem: Problem
    """Planning problem of the data center."""
    no_bound: str | None
    """Reason why there is no bound, in words; None if there is a bound."""
    bound: float = float("nan")
    """Lower bound of the figure; nan if there is none."""
    runs: dict[str, _Run] = field(default_factory=dict)
    """Plans simulated so far, by name."""
    uncoordinated: tuple[str, ...] = ()
    """Names of the plans in ``runs`` that agents made without coordination."""
    responses: dict[tuple[Any, ...], F64 | None] = field(default_factory=dict)
    """Best responses computed so far, by agent and plans of the others; None if no plan satisfies
    the limits."""

    @property
    def joint(self) -> _Run:
        """Simulated plan that moves all agents of the problem."""
        return self.runs[JOINT if JOINT in self.runs else self.problem.agents[0]]

    def entry(self) -> Entry:
        """Return the cache entry with the bound, the best simulated plan and its figure."""
        certificates = {
            name: run.certificate
            for name, run in self.runs.items()
            if name not in self.uncoordinated
        }
        uncoordinated = {way: self.runs[way].certificate for way in self.uncoordinated}
        idle, capacity_kwh = certificates[IDLE], self.problem.storage.capacity_kwh
        failures = {
            name: of_path.failures(idle, capacity_kwh) for name, of_path in certificates.items()
        }
        valid = [name for name, texts in failures.items() if not texts] or [IDLE]

        def best_of(names: Iterable[str]) -> str:
            return min(names, key=lambda name: certificates[name].figure)

        best = best_of(valid)
        error = max(of_path.table_error for of_path in certificates.values())
        done, loops = self.runs[best].done, self.runs[best].path.loops
        margin = error + _SOLVER_ERROR + self.problem.loops_error
        return Entry(
            idle=idle.figure,
            idle_dropped_tasks=idle.dropped_tasks,
            # Lower the bound by the errors of the tables and of the solvers.
            bound=self.bound - margin * abs(self.bound),
            achieved=certificates[best].figure,
            alone={
                agent: certificates[best_of({agent, IDLE}.intersection(valid) or {IDLE})].figure
                for agent in self.problem.agents
            },
            kind=_kind(self.no_bound, error),
            failures=(
                *_unreachable_limit(certificates[best]),
                *(
                    f"the path of {name} {text}"
                    for name, texts in failures.items()
                    for text in texts
                ),
            ),
            certificate=asdict(certificates[best]) | {"table_error": error},
            load=done.load_command[:, 0],
            cooling=done.cooling_command[:, 0],
            battery=done.battery_command[:, 0],
            loops=np.ascontiguousarray(loops[:, 0]),
            uncoordinated={
                way: self._valued_figure(certificate) for way, certificate in uncoordinated.items()
            },
            uncoordinated_failures=tuple(
                f"the path of {title_of(way)} {text}"
                for way, certificate in uncoordinated.items()
                for text in (
                    certificate.failures(idle, capacity_kwh)
                    if self.no_bound
                    else certificate.broken(idle)
                )
            ),
        )

    def _valued_figure(self, of_path: Certificate) -> float:
        """Return the figure of a path, plus the value of what it lacks at its end.

        The value is the difference of the bounds for this end and for an end equal to the start; it
        is 0 without a bound.
        """
        if self.no_bound or not of_path.worse_ends(self.problem.storage.capacity_kwh):
            return of_path.figure
        start = of_path.start_kwh, of_path.start_tasks
        best, cyclic = (
            bound(self.problem, Ends(*start, *end)).figure
            for end in ((of_path.end_kwh, of_path.end_tasks), start)
        )
        return of_path.figure + cyclic - best

    def problem_of(self, path: Targets) -> Problem:
        """Return the problem with the tables of a path, which moves the coolant loops or not."""
        return self.problem.moving(()) if np.isnan(path.loops).all() else self.problem

    def missing_kwh(self, name: str) -> float:
        """Return the stored energy that a simulated plan lacks at its end, in kWh; 0 without it."""
        if name not in self.runs:
            return 0.0
        return self.runs[name].certificate.missing_kwh(self.problem.storage.capacity_kwh)

    def best_response(
        self, agent: Agent, others: Mapping[Agent, F64], check: Callable[[], None]
    ) -> F64 | None:
        """Return the plan of one agent of least objective while others follow given plans, (T,).

        Args:
            agent: Agent of the plan.
            others: Plans of other agents; agents without a plan are idle.
            check: Called regularly; an error that it raises ends the work.

        Returns:
            The plan; None if no plan satisfies the limits.
        """
        known = dict(others)
        if agent == "cooling" or not self.problem.months:
            # Setpoints, and without demand charges all plans, do not depend on the battery.
            known.pop("battery", None)
        key = agent, *((name, known[name].tobytes()) for name in sorted(known))
        if key not in self.responses:
            try:
                self.responses[key] = best_response(self.problem, agent, known, check)
            except ConfigError:
                self.responses[key] = None
        return self.responses[key]


def _of_case(plans: Mapping[Agent, _Plans], i: int) -> dict[Agent, F64]:
    """Return the plans of data center ``i``, without those of agents that have none."""
    of_case = {agent: of_all[i] for agent, of_all in plans.items()}
    return {agent: plan for agent, plan in of_case.items() if plan is not None}


def _beside(paths: Sequence[Targets]) -> Targets:
    """Return the paths of n data centers, each with B = 1, as those of one batch with B = n."""
    return Targets(
        **{
            f.name: np.concatenate([getattr(path, f.name) for path in paths], axis=1)
            for f in fields(Targets)
        }
    )


def _unreachable_limit(best: Certificate) -> tuple[str, ...]:
    """Return a text on the limit of inlets if no setpoint satisfies it in some step."""
    if best.reachable_limit_c <= best.inlet_limit_c + LEAST_K:
        return ()
    least_c = math.ceil(10.0 * best.reachable_limit_c) / 10.0
    return (
        f"the limit of inlets of {best.inlet_limit_c:g} C, as no setpoint keeps it in each step: "
        f"the least reachable limit is {least_c:.1f} C, and the achieved path has inlets up to "
        f"{best.hottest_inlet_c:.2f} C",
    )


def _kind(reason: str | None, error: float) -> str:
    """Return the kind of a bound, in words.

    Args:
        reason: Reason why there is no bound, or None.
        error: Relative error of the table in the simulated plans.
    """
    if reason is not None:
        return f"none: {reason}"
    if error > LARGEST_TABLE_ERROR:
        return (
            f"estimate: the simulator differs from its tables by {100.0 * error:.3g} % of the "
            "energy"
        )
    return "bound"


def _bound_or_path(
    case: _Case, name: str, check: Callable[[], None]
) -> float | Targets | ConfigError:
    """Compute the bound or one path of a data center; return the error if no plan is valid.

    Args:
        case: The data center.
        name: ``_BOUND`` or the name of a path.
        check: Called regularly; an error that it raises ends the work.
    """
    try:
        if name != _BOUND:
            return path_of(case.problem, agents_of(case.problem)[name], check)
        return float("nan") if case.no_bound else bound(case.problem, check=check).figure
    except ConfigError as error:
        return error


def _with_margin(case: _Case, name: str, _check: Callable[[], None]) -> Targets:
    """Plan the battery of a simulated path again, to end with more energy than the end needs.

    If no plan can, the path is returned as it is.
    """
    run, margin_kwh = case.runs[name], _MARGIN_FACTOR * case.missing_kwh(name)
    problem = replace(case.problem, end_margin_kwh=margin_kwh)
    try:
        return with_battery_for(problem, run.path, run.done.facility_kwh[:, 0])
    except ConfigError:
        return run.path


class _Work:
    """Solves a task stage by stage, with progress reports and a way to stop.

    Args:
        progress: Progress callback ``(stage, done, total)``.
        stop: Called regularly; the work ends if it returns True.
    """

    def __init__(self, progress: Progress, stop: Callable[[], bool]) -> None:
        self._progress, self._stop = progress, stop
        self._all = self._kept = self._missing = self._solved = self._size = 0

    def entries(self, task: Task, cache: Cache | None) -> list[Entry]:
        """Return the entry of each of B data centers, from the cache or newly computed.

        Args:
            task: The data centers with their inputs and options.
            cache: Cache of entries; None uses no cache.

        Raises:
            StoppedError: The caller stopped the work.
        """
        keys = [""] * task.fleet.size if cache is None else task.keys()
        entries: dict[int, Entry] = {}
        if cache is not None:
            known = {i: cache.find(key, task.steps, task.agents) for i, key in enumerate(keys)}
            entries = {
                i: entry
                for i, entry in known.items()
                if entry is not None and (entry.uncoordinated or not task.uncoordinated)
            }
        missing = [i for i in range(task.fleet.size) if i not in entries]
        self._all, self._kept, self._missing = len(keys), len(entries), len(missing)
        for part in task.parts(missing):
            self._size = len(part)
            for i, case in zip(part, self._solve(task.part(part)), strict=True):
                entries[i] = case.entry()
                if cache is not None:
                    cache.keep(keys[i], entries[i])
            self._solved += len(part)
            self._kept += len(part) if cache is not None else 0
        return [entries[i] for i in range(task.fleet.size)]

    def _solve(self, task: Task) -> list[_Case]:
        """Compute bounds and simulate plans of B data centers whose tables fit into memory."""
        problems = task.problems(lambda done, total: self._tell("tables", done / total, task.steps))
        cases = [
            _Case(
                problem,
                of_config
                or loops_reason(problem, config)
                or uncooled_reason(problem.table, problem.work.idle_tasks / TASKS_PER_STEP)
                or forced_discharge_reason(problem),
            )
            for of_config, config, problem in zip(
                no_table_reasons(task.fleet), task.fleet.configs, problems, strict=True
            )
        ]
        self._run(task, cases, self._bounds_and_paths(cases))
        self._plan_batteries_again(task, cases)
        self._plan_short_ends_again(task, cases)
        if task.uncoordinated:
            self._run_uncoordinated(task, cases)
        return cases

    def _bounds_and_paths(self, cases: Sequence[_Case]) -> list[dict[str, Targets]]:
        """Compute the bound and the paths of each of B data centers; return the paths by name."""
        names = [*reversed(agents_of(cases[0].problem)), _BOUND]
        results = self._in_threads(
            [partial(_bound_or_path, case, name) for case in cases for name in names]
        )
        paths = []
        for i, case in enumerate(cases):
            of_case = dict(zip(names, results[i * len(names) :], strict=False))
            figure = of_case.pop(_BOUND)
            errors = [each for each in (*of_case.values(), figure) if isinstance(each, ConfigError)]
            if errors:
                case.no_bound = case.no_bound or str(errors[0])
                idle = path_of(case.problem, ())
                paths.append(dict.fromkeys(agents_of(case.problem), idle))
                continue
            case.bound = float(figure)  # type: ignore[arg-type]
            paths.append({name: x for name, x in of_case.items() if isinstance(x, Targets)})
        return paths

    def _plan_batteries_again(self, task: Task, cases: Sequence[_Case]) -> None:
        """Plan batteries again for the simulated energy, if it differs from the planned energy."""
        chosen = []
        for i, case in enumerate(cases):
            planned, simulated = case.joint.path.facility_kwh, case.joint.done.facility_kwh
            error = float(np.abs(planned - simulated).sum() / simulated.sum())
            if "battery" in case.problem.agents and error > _LEAST_ENERGY_ERROR:
                chosen.append(i)
        if not chosen:
            return

        def battery_again(case: _Case, _check: Callable[[], None]) -> Targets:
            run = case.joint
            return with_battery_for(case.problem, run.path, run.done.facility_kwh[:, 0])

        again = [cases[i] for i in chosen]
        paths = self._in_threads([partial(battery_again, case) for case in again])
        self._run(task.part(chosen), again, [{_AGAIN: path} for path in paths])

    def _plan_short_ends_again(self, task: Task, cases: Sequence[_Case]) -> None:
        """Plan batteries again, with a margin, if a simulated battery ends with too little energy.

        The square loss of a battery is a little larger than that of its linear programme, so a
        battery that charges in the last step may miss the end by a small amount.
        """
        for name in ("battery", JOINT, _AGAIN):
            chosen = [i for i, case in enumerate(cases) if case.missing_kwh(name) > 0.0]
            if chosen:
                short = [cases[i] for i in chosen]
                paths = self._in_threads([partial(_with_margin, case, name) for case in short])
                self._run(task.part(chosen), short, [{name: path} for path in paths])

    def _run_uncoordinated(self, task: Task, cases: Sequence[_Case]) -> None:
        """Simulate the plans that the agents of B data centers make without coordination."""
        players = _players(task.agents)
        count, all_calls = 0, response_count(len(players))

        def responses(agent: Agent, others: Mapping[Agent, _Plans]) -> _Plans:
            nonlocal count
            count += 1
            return self._in_threads(
                [
                    partial(case.best_response, agent, _of_case(others, i))
                    for i, case in enumerate(cases)
                ],
                "best responses",
                (count - 1, all_calls),
            )

        ways = uncoordinated(players, responses)
        for case in cases:
            case.uncoordinated = tuple(ways)
        self._run(
            task,
            cases,
            [
                {way: targets_of(case.problem, _of_case(plans, i)) for way, plans in ways.items()}
                for i, case in enumerate(cases)
            ],
        )

    def _in_threads(
        self,
        calls: Sequence[Callable[[Callable[[], None]], _X]],
        stage: str = "programmes",
        part: tuple[int, int] = (0, 1),
    ) -> list[_X]:
        """Call functions in parallel threads and return their results in order.

        Args:
            calls: Functions that release Python's global lock most of the time. Their argument is a
                function that raises an error if the work is to end.
            stage: Name of the stage in reports of progress.
            part: Index of this call among the calls of the stage, and their number.
        """
        pool, ends = ThreadPoolExecutor(runtime.ensure_started()), Event()

        def check() -> None:
            if ends.is_set():
                raise self._stopped()

        try:
            futures = [pool.submit(call, check) for call in calls]
            waiting = set(futures)
            while waiting:
                self._go_on()
                _, waiting = wait(waiting, timeout=_POLL_S)
                share = (part[0] + 1.0 - len(waiting) / len(calls)) / part[1]
                done = self._solved + round(share * self._size)
                self._progress(stage, done, self._missing)
            return [future.result() for future in futures]
        finally:
            ends.set()
            pool.shutdown(wait=False, cancel_futures=True)

    def _tell(self, stage: str, share: float, steps: int) -> None:
        """Report the progress of a stage in the current part, in steps times data centers."""
        done = self._solved + share * self._size
        self._progress(stage, round(done * steps), self._missing * steps)
        self._go_on()

    def _go_on(self) -> None:
        """Raise a ``StoppedError`` if the caller has stopped the work."""
        if self._stop():
            raise self._stopped()

    def _stopped(self) -> StoppedError:
        return StoppedError(f"optima of {self._kept} of {self._all} data centers are kept")

    def _run(
        self, task: Task, cases: Sequence[_Case], paths: Sequence[Mapping[str, Targets]]
    ) -> None:
        """Simulate all paths of B data centers in one batch.

        Args:
            task: The B data centers with their inputs and options.
            cases: Results of the data centers, B; the simulated paths are added to ``runs``.
            paths: Paths of each data center by name, B; all data centers have the same names.
        """
        names, size, steps = list(paths[0]), task.fleet.size, 0
        # Path k of data center i has index k*B + i in the batch.
        in_order = [of_case[name] for name in names for of_case in paths]

        def on_step() -> None:
            nonlocal steps
            steps += 1
            self._tell("runs", steps / task.steps, task.steps)

        done, score = roll_out(
            build_fleet(task.fleet.configs * len(names)),
            task.drivers.take(list(range(size)) * len(names)),
            _beside(in_order),
            start=np.tile(task.start, len(names)),
            objective=task.objective,
            scored_from=task.scored_from,
            seed=np.tile(task.seed, len(names)),
            precision=task.precision,
            on_step=on_step,
        )
        for at, path in enumerate(in_order):
            case, of_path = cases[at % size], done.of([at])
            case.runs[names[at // size]] = _Run(
                path, of_path, certificate(case.problem_of(path), of_path, score, at)
            )
