"""One update of HAPPO and HAA2C by their authors' code and by ours, from equal weights and steps.

    pip download --no-deps harl-aht==0.1.0 && unzip -d harl harl_aht-*.whl
    PYTHONPATH=harl python examples/compare_harl.py

``harl-aht`` is a fork of the code of Zhong et al. (2024), *Heterogeneous-agent reinforcement
learning*, JMLR 25. Both sides get the weights, observations, actions and rewards of one rollout of
preset ``corrected``. Prints, for each network, the largest change of a weight in our update and the
largest difference to theirs, and ends with an error where that is over 1e-5.

Made equal: their layer norms are left out, their observations are normalised by our moments, and
their critics, whose normaliser of values is another, learn our normalised returns from our rescaled
weights; passes are one mini-batch each, so that the order of rows does not matter; and no episode
ends in the rollout, because their returns end where one is cut off.

Left: advantages are divided by their standard deviation plus 1e-5 with n in its denominator there,
and plus 1e-8 with n - 1 here, which Adam all but takes out.
"""

from __future__ import annotations

import argparse
import copy
import importlib
import sys
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from torch import Tensor, nn

import sdc_taichi
from sdc_taichi.learning.algorithms import ON_POLICY
from sdc_taichi.learning.normalise import RunningMoments
from sdc_taichi.learning.on_policy import ADAM_EPSILON, TEAM, OnPolicy
from sdc_taichi.learning.policy import CHOICES
from sdc_taichi.learning.settings import OnPolicySettings
from sdc_taichi.learning.stream import EnvironmentStream

TOLERANCE = 1e-5
SETTINGS = OnPolicySettings(decision_steps=1, mini_batches=1, anneal=False)
Weights = Mapping[str, Tensor]


class Update(NamedTuple):
    """Transitions of an update of an algorithm, and its states before and after the update."""

    before: dict[str, Any]
    """State of the algorithm before the update."""
    after: dict[str, Any]
    """State of the algorithm after the update."""
    order: list[str]
    """Learners in the order of their updates."""
    observations: dict[str, Tensor]
    """Observations by learner before each step and after the last, (T + 1, B, n)."""
    state: Tensor
    """Shared state before each step and after the last, (T + 1, B, m)."""
    actions: dict[str, Tensor]
    """Choices by learner, (T, B, 1)."""
    rewards: Tensor
    """Mean reward of the learners, (T, B)."""


def our_update(name: str, num_envs: int, seed: int) -> Update:
    """The second update of an algorithm, the first that learns."""
    env = sdc_taichi.vector_env(num_envs, autoreset_mode="SameStep")
    stream = EnvironmentStream(env, seed=seed)
    algorithm = OnPolicy(
        ON_POLICY[name], SETTINGS, stream.spaces, stream.state_width, updates=1, seed=seed
    )
    algorithm.update(stream)
    before, step = copy.deepcopy(algorithm.state_dict()), stream.step
    seen: list[dict[str, Tensor]] = [stream.observations]
    states, made, paid = [stream.state], [], []

    def noted(actions: Mapping[str, Tensor]) -> Any:
        made.append({learner: chosen.clone() for learner, chosen in actions.items()})
        after = step(actions)
        paid.append(torch.stack(list(after.rewards.values())).mean(0))
        seen.append(after.next_observations)
        states.append(after.next_state)
        assert not after.ended
        return after

    stream.step = noted  # type: ignore[method-assign]
    logged = algorithm.update(stream)
    env.close()
    prefix = "policy_loss/"
    return Update(
        before,
        copy.deepcopy(algorithm.state_dict()),
        [key.removeprefix(prefix) for key in logged if key.startswith(prefix)],
        {learner: torch.stack([s[learner] for s in seen]) for learner in stream.learners},
        torch.stack(states),
        {learner: torch.stack([a[learner] for a in made]) for learner in stream.learners},
        torch.stack(paid),
    )


def normalised(moments: Mapping[str, Any], values: Tensor) -> Tensor:
    """Values by the moments of a ``state_dict``."""
    of = RunningMoments(values.shape[-1])
    of.load_state_dict(dict(moments))
    return of.normalise(values)


def their_runner() -> Any:
    """The class that updates heterogeneous agents, without the packages of its environments."""
    try:
        harl = importlib.import_module("harl")
    except ImportError:
        sys.exit("harl is not installed: see the first lines of examples/compare_harl.py")
    package, base = (
        types.ModuleType(f"harl.runners{part}") for part in ("", ".on_policy_base_runner")
    )
    package.__path__ = [str(Path(str(harl.__file__)).parent / "runners")]
    base.OnPolicyBaseRunner = object  # type: ignore[attr-defined]
    sys.modules |= {module.__name__: module for module in (package, base)}
    return importlib.import_module("harl.runners.on_policy_ha_runner").OnPolicyHARunner


def their_settings(name: str, steps: int, num_envs: int) -> dict[str, Any]:
    """Our settings by the names that HARL has for them."""
    s = SETTINGS
    epochs = 1 if name == "haa2c" else s.epochs
    return {
        "episode_length": steps,
        "n_rollout_threads": num_envs,
        "hidden_sizes": list(s.hidden),
        "activation_func": s.activation,
        "initialization_method": "orthogonal_",
        "gain": 0.01,
        "recurrent_n": 1,
        "data_chunk_length": 1,
        "use_feature_normalization": False,
        "use_recurrent_policy": False,
        "use_naive_recurrent_policy": False,
        "use_policy_active_masks": True,
        "action_aggregation": "prod",
        "lr": s.rate,
        "critic_lr": s.rate,
        "opti_eps": ADAM_EPSILON,
        "weight_decay": 0.0,
        "clip_param": s.clip,
        "ppo_epoch": epochs,
        "a2c_epoch": epochs,
        "critic_epoch": epochs,
        "actor_num_mini_batch": 1,
        "critic_num_mini_batch": 1,
        "entropy_coef": s.entropy,
        "value_loss_coef": 1.0,
        "use_max_grad_norm": True,
        "max_grad_norm": s.gradient_norm,
        "use_clipped_value_loss": False,
        "use_huber_loss": False,
        "huber_delta": 10.0,
        "gamma": s.discount,
        "gae_lambda": s.gae_lambda,
        "use_gae": True,
        "use_proper_time_limits": True,
    }


def put(weights: Weights, body: nn.Sequential, last: nn.Linear) -> None:
    """Weights of one of our perceptrons into one of theirs."""
    layers = [layer for layer in body if isinstance(layer, nn.Linear)] + [last]
    names = sorted({key.rpartition(".")[0] for key in weights})
    with torch.no_grad():
        for name, layer in zip(names, layers, strict=True):
            layer.weight.copy_(weights[f"{name}.weight"])
            layer.bias.copy_(weights[f"{name}.bias"])


def without_layer_norms(model: Any) -> nn.Sequential:
    """The hidden layers of a model, which it keeps, without their layer norms."""
    body = nn.Sequential(*(m for m in model.base.mlp.fc if not isinstance(m, nn.LayerNorm)))
    model.base.mlp.fc = body
    return body


def adam(model: nn.Module) -> torch.optim.Adam:
    """A new optimiser, because theirs holds the layer norms too."""
    return torch.optim.Adam(model.parameters(), SETTINGS.rate, eps=ADAM_EPSILON)


def their_update(name: str, ours: Update) -> dict[str, list[Tensor]]:
    """Weights of their networks after an update from the start and the steps of ours."""
    runner_class = their_runner()
    actors = importlib.import_module("harl.algorithms.actors").ALGO_REGISTRY
    v_critic = importlib.import_module("harl.algorithms.critics.v_critic").VCritic
    buffers = importlib.import_module("harl.common.buffers.on_policy_actor_buffer")
    critic_buffers = importlib.import_module("harl.common.buffers.on_policy_critic_buffer_ep")
    steps, num_envs = ours.rewards.shape
    settings = their_settings(name, steps, num_envs)

    runner = runner_class()
    runner.algo_args = {"train": settings}
    runner.value_normalizer, runner.state_type, runner.fixed_order = None, "EP", True
    runner.num_agents, runner.action_aggregation = len(ours.order), "prod"
    runner.actor, runner.actor_buffer = [], []
    for learner in ours.order:
        start = ours.before["learners"][learner]
        seen = normalised(start["moments"], ours.observations[learner])
        spaces = Box(-np.inf, np.inf, seen.shape[-1:]), Discrete(CHOICES)
        actor = actors[name](settings, *spaces)
        weights = {key.removeprefix("net."): value for key, value in start["actor"].items()}
        put(weights, without_layer_norms(actor.actor), actor.actor.act.action_out.linear)
        actor.actor_optimizer = adam(actor.actor)
        buffer = buffers.OnPolicyActorBuffer(settings, *spaces)
        buffer.obs[:], buffer.actions[:] = seen.numpy(), ours.actions[learner].numpy()
        flat = seen[:-1].flatten(0, 1).numpy(), buffer.rnn_states[:-1].reshape(-1, 1, 64)
        with torch.no_grad():
            log_p = actor.evaluate_actions(*flat, buffer.actions.reshape(-1, 1), buffer.masks)[0]
        buffer.action_log_probs[:] = log_p.reshape(steps, num_envs, 1).numpy()
        runner.actor.append(actor)
        runner.actor_buffer.append(buffer)

    start, end = (state["critics"][TEAM] for state in (ours.before, ours.after))
    seen = normalised(start["inputs"], ours.state)
    space = Box(-np.inf, np.inf, seen.shape[-1:])
    runner.critic = critic = v_critic(settings, space)
    body, last = without_layer_norms(critic.critic), critic.critic.v_out
    put(start["net"], body, last)
    (mean, std), (new_mean, new_std) = (scale_of(x["returns"]) for x in (start, end))
    buffer = runner.critic_buffer = critic_buffers.OnPolicyCriticBufferEP(settings, space)
    with torch.no_grad():
        values = last(body(seen)) * std + mean
        last.weight.mul_(std / new_std)
        last.bias.mul_(std).add_(mean - new_mean).div_(new_std)
    critic.critic_optimizer = adam(critic.critic)
    buffer.share_obs[:], buffer.rewards[:] = seen.numpy(), ours.rewards.unsqueeze(-1).numpy()
    buffer.value_preds[:] = values.numpy()
    buffer.compute_returns(buffer.value_preds[-1])

    update_critic = critic.train

    def with_normalised_returns(buffer: Any, normaliser: Any) -> Any:
        buffer.returns[:] = (buffer.returns - float(new_mean)) / float(new_std)
        return update_critic(buffer, normaliser)

    critic.train = with_normalised_returns
    runner.train()
    found = {
        learner: list(actor.actor.parameters())
        for learner, actor in zip(ours.order, runner.actor, strict=True)
    }
    return found | {TEAM: list(critic.critic.parameters())}


def scale_of(returns: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of returns."""
    moments = RunningMoments(1)
    moments.load_state_dict(dict(returns))
    return moments.mean.float(), moments.std


def compare(name: str, num_envs: int, seed: int) -> dict[str, tuple[float, float]]:
    """Largest change of a weight, and largest difference to theirs, by network."""
    ours = our_update(name, num_envs, seed)
    theirs = their_update(name, ours)
    found = {}
    for network, weights in theirs.items():
        part, key = ("critics", "net") if network == TEAM else ("learners", "actor")
        start, end = (
            torch.cat([w.flatten() for w in state[part][network][key].values()])
            for state in (ours.before, ours.after)
        )
        other = torch.cat([w.detach().flatten() for w in weights])
        found[network] = float((end - start).abs().max()), float((end - other).abs().max())
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    worst = 0.0
    for name in ("happo", "haa2c"):
        for network, (change, difference) in compare(name, given.num_envs, given.seed).items():
            print(f"{name} {network}: changed by {change:.1e}, differs by {difference:.1e}")
            worst = max(worst, difference)
    if worst > TOLERANCE:
        sys.exit(f"weights differ by {worst:.1e}; expected at most {TOLERANCE:.0e}")


if __name__ == "__main__":
    main()
