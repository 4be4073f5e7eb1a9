"""Controller that runs a trained policy: observe, evaluate the networks, decode their actions.

The commands are bit-identical to those in a training environment with the same networks.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sdc_taichi.control import (
    CONTROLLABLE,
    View,
    commands_of,
    make_controller,
)
from sdc_taichi.envs.actions import AgentActions
from sdc_taichi.envs.agents import commands_by_others
from sdc_taichi.envs.observer import Observer, make_observer
from sdc_taichi.envs.released import ReleasedObserver
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.learning.policy import Policy
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F32, I64, Actions

_MOST_NESTED = 8
"""Maximum depth of nested policies: a policy may control the agents ``others`` in the training of
another policy, which does the same in a third one, and so on."""
_loading: list[Path] = []
"""Folders of the policies that are being loaded; each policy after the first is named as
controller ``others`` by the policy before it."""


class PolicyController:
    """Controller that runs a policy; agents without a network act as they did in the training.

    Args:
        policy: the policy.
        fleet: the data centers to control.
        name: name of the controller in messages.
        others: name of the controller of the agents without a network; None selects the controller
            that was used in the training.
        allow_code: True if that name may be an import path; the policy's file names it.

    Attributes:
        policy: the policy.
        commands: fields of ``Actions`` that the controller sets.

    Raises:
        SdcError: the policy does not fit the data centers; the message names the difference.
    """

    def __init__(
        self,
        policy: Policy,
        fleet: Fleet,
        name: str = "policy",
        others: str | None = None,
        *,
        allow_code: bool = False,
    ) -> None:
        self.policy, self._name, self._allow_code = policy, name, allow_code
        self._named_others = policy.about.others if others is None else others
        self._prepare(fleet)

    def __deepcopy__(self, _: Any) -> PolicyController:
        """Return a new controller with the same policy object (policies are immutable)."""
        return PolicyController(
            self.policy,
            self._fleet,
            self._name,
            self._named_others,
            allow_code=self._allow_code,
        )

    def _prepare(self, fleet: Fleet) -> None:
        """Build everything that depends on the data centers."""
        interface, others = self.policy.interface, self._named_others
        interface.require_fit(self._name, fleet)
        self._fleet = fleet
        self._decoder = AgentActions(fleet, interface.options())
        try:
            self._others = make_controller(others, fleet, allow_code=self._allow_code)
        except SdcError as error:
            raise ConfigError(f"{self._name}: others of its training: {error}") from None
        decided = self._decoder.commands
        by_others = commands_by_others(interface.agents, decided, commands_of(self._others))
        self._by_others = tuple(by_others)
        self.commands: tuple[str, ...] = (*decided, *self._by_others)
        self._observer: Observer | ReleasedObserver | None = None
        self._begun = False
        # Actions of the last decision, repeated until the next decision.
        self._actions: dict[str, F32 | I64] = {}

    def reset(self, seed: int | I64) -> None:
        """Begin a new episode."""
        self._others.reset(seed)
        self._begun = False
        self._actions = {}

    def act(self, view: View) -> Actions:
        """Return the policy's commands, together with those of the controller of other agents.

        Raises:
            SdcError: the policy does not fit the data centers.
        """
        if view.fleet is not self._fleet:
            self._prepare(view.fleet)
        observer = self._observer_of(view)
        if not self._actions or view.state.step % self.policy.decision_steps == 0:
            self._actions = {
                group: chosen.reshape(
                    *chosen.shape[:-1], *(self._decoder.spaces[group].shape or ())
                )
                for group, chosen in self.policy.actions(observer.observe(view)).items()
            }
        commands: dict[str, Any] = {**self._decoder.decode(self._actions, view)}
        if self._by_others:
            by_others = self._others.act(view)
            commands |= {name: getattr(by_others, name) for name in self._by_others}
        return Actions(**commands)

    def _observer_of(self, view: View) -> Observer | ReleasedObserver:
        """Return the observer, after a reset if the episode has just begun."""
        if self._observer is None:
            options = self.policy.interface.options()
            self._observer = make_observer(view.fleet, options, new_inputs=True)
        if not self._begun:
            self._observer.reset(view)
            self._begun = True
        return self._observer


def policy_controller(text: str, fleet: Fleet, parts: tuple[str, ...]) -> PolicyController:
    """Return the controller that is specified as ``policy:FOLDER``.

    Args:
        text: folder of a training or of a policy.
        fleet: the data centers to control.
        parts: agents (load, cooling, battery) that the spec assigns to this controller.

    Raises:
        SdcError: the folder has no policy, or the policy is damaged or does not fit the fleet.
    """
    if not text:
        raise ConfigError("controller 'policy': valid is policy:FOLDER, such as policy:runs/happo")
    folder = Path(text).resolve()
    if folder in _loading:
        raise ConfigError(f"policy {text}: its training had this policy for others")
    if len(_loading) == _MOST_NESTED:
        raise ConfigError(
            f"policy {text}: it is nested in {_MOST_NESTED} policies, each of which names the next "
            f"as its controller others; valid is a depth of up to {_MOST_NESTED}"
        )
    # If the spec names further controllers, the policy sets only the commands of its agents.
    others = None if set(parts) == set(CONTROLLABLE) else "idle"
    _loading.append(folder)
    try:
        return PolicyController(Policy.load(Path(text)), fleet, f"policy {text}", others)
    finally:
        _loading.pop()
