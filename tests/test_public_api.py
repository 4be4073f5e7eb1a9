"""What ``import sdc_taichi`` offers."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import sdc_taichi
from sdc_taichi import (
    Actions,
    LoadAction,
    Simulator,
    View,
    load_config,
    make_controller,
    simulate,
    with_values,
)


def test_every_public_name_is_there_and_documented() -> None:
    assert list(sdc_taichi.__all__) == sorted(set(sdc_taichi.__all__))
    for name in sdc_taichi.__all__:
        assert getattr(sdc_taichi, name).__doc__, name
        assert name in dir(sdc_taichi)


def test_names_that_bring_much_with_them_are_imported_on_first_use() -> None:
    code = (
        "import sys, sdc_taichi\n"
        "heavy = ('pettingzoo', 'rerun', 'taichi', 'sdc_taichi.envs.core', 'sdc_taichi.run.loop')\n"
        "assert not [name for name in heavy if name in sys.modules]\n"
        "sdc_taichi.simulate, sdc_taichi.vector_env\n"
        "assert 'sdc_taichi.run.loop' in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


class Defer:
    """A controller of one's own, by public names alone."""

    def __init__(self) -> None:
        self.seen: list[View] = []

    def reset(self, seed: Any) -> None:
        self.seen.clear()

    def act(self, view: View) -> Actions:
        self.seen.append(view)
        return Actions(load=LoadAction.DEFER)


def test_a_run_by_public_names_alone() -> None:
    config = with_values(load_config("tiny"), {"hvac.setpoint.initial_c": 20})
    mine = Defer()
    with Simulator(config) as sim:
        totals = simulate(sim, mine, 4)
        assert totals.steps == len(mine.seen) == 4
        assert mine.seen[0].setpoint_c == 20.0
        assert simulate(sim, make_controller("g36", sim.fleet), 2).steps == 2


def test_the_optimum_is_solved_by_public_names() -> None:
    import sdc_taichi.optimum.solve  # noqa: F401 - the module of that name must not hide it
    from sdc_taichi.optimum import Objective, Optimum, solve

    found = solve(load_config("tiny"), steps=4, objective=Objective(energy=1.0), cache=False)
    assert isinstance(found, Optimum)
    assert found.bound[0] <= found.achieved[0] <= found.idle[0]
