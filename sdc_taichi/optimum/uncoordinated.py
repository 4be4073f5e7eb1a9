"""Plans of players that do not plan together, to measure what coordination is worth.

A player is anything with a plan of its own, such as the battery agent of a data center, a site of a
fleet or a CRAC unit of a hall. The price of not coordinating is the figure of the plans that this
module makes, minus the figure of the joint plan of all players.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TypeVar

ROUNDS = (1, 10)
"""Numbers of rounds of best responses whose plans are returned."""
TOGETHER, IN_TURN, _ROUND = "together", "in_turn", "round_"
WAYS = (TOGETHER, IN_TURN, *(f"{_ROUND}{n}" for n in ROUNDS))
"""Names of the ways of planning that ``uncoordinated`` returns by default."""
_TITLES = {TOGETHER: "each alone, played together", IN_TURN: "one after another"}

Player = TypeVar("Player", bound=Hashable)
Plan = TypeVar("Plan")


def uncoordinated(
    players: Sequence[Player],
    best_response: Callable[[Player, Mapping[Player, Plan]], Plan],
    rounds: Sequence[int] = ROUNDS,
) -> dict[str, dict[Player, Plan]]:
    """Return the plans of all players in several ways of planning without coordination.

    - ``together``: each player plans as if all others were idle.
    - ``in_turn``: each player knows the plans of the players before it; those after it are idle.
    - ``round_N``: the plans of ``together``, after N rounds in which all players at once choose the
      best response to the last plans of the others. The plans need not converge.

    The figure of each way is that of a run with its plans. With a function ``evaluate`` for this,
    the figures are ``{name: evaluate(plans) for name, plans in uncoordinated(...).items()}``.

    Args:
        players: Names of the players, in the order of ``in_turn``.
        best_response: Function of a player and the known plans of other players; players without a
            plan are idle. It returns the best plan of the player.
        rounds: Numbers of rounds N for which plans are returned.

    Returns:
        Plan of each player by name of the way, in the order of the list above.
    """
    plans = {player: best_response(player, {}) for player in players}
    in_turn = {player: plans[player] for player in players[:1]}
    for player in players[1:]:
        in_turn[player] = best_response(player, dict(in_turn))
    ways = {TOGETHER: plans, IN_TURN: in_turn}
    for done in range(1, max(rounds, default=0) + 1):
        plans = {
            player: best_response(player, {k: x for k, x in plans.items() if k != player})
            for player in players
        }
        if done in rounds:
            ways[f"{_ROUND}{done}"] = plans
    return ways


def response_count(players: int) -> int:
    """Return how often ``uncoordinated`` asks for a best response."""
    return players * (2 + max(ROUNDS)) - 1


def title_of(way: str) -> str:
    """Return the title in tables of a way of planning that ``uncoordinated`` names."""
    if way in _TITLES:
        return _TITLES[way]
    count = int(way.removeprefix(_ROUND))
    return f"best responses, {count} round{'' if count == 1 else 's'}"
