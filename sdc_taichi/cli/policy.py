"""``sdc-taichi policy``: describe, import or export a policy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sdc_taichi.cli.options import CommandApp, check_out_file, force_option, json_option, out_option
from sdc_taichi.errors import printable

if TYPE_CHECKING:
    from sdc_taichi.learning.policy import Policy

policy_app = CommandApp(help="Show, import and export policies.", no_args_is_help=True)
Folder = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="Folder of a training run, or of a policy.")
]


@policy_app.command("show")
def show_policy(
    folder: Folder,
    as_json: Annotated[bool, json_option("Print policy.json instead.")] = False,
) -> None:
    """Say where a policy comes from, what it observes and what it decides."""
    from sdc_taichi.learning.policy import Policy, policy_folder

    policy = Policy.load(folder)
    if as_json:
        print(policy.description())
        return
    print(f"{printable(policy_folder(folder))}: {printable(_origin(policy))}")
    for label, text in _facts(policy):
        print(f"  {label:<12} {printable(text)}")


@policy_app.command("export")
def export_policy(
    folder: Folder,
    out: Annotated[Path, out_option("File to write, ending in .onnx.", "FILE.onnx")],
    force: Annotated[bool, force_option()] = False,
) -> None:
    """Write a policy as an ONNX model, with its scaling of observations."""
    from sdc_taichi.learning.export import export_onnx
    from sdc_taichi.learning.policy import Policy

    check_out_file(out, ".onnx", force=force)
    policy = Policy.load(folder)
    export_onnx(policy, out)
    fits = policy.interface
    inputs = [agent for group in fits.agents for agent in fits.policies_of(group)]
    print(f"{printable(out)}: inputs {', '.join(inputs)}")


@policy_app.command("import")
def import_policy(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE.pt...", help="Weights of actors that HARL has stored."),
    ],
    out: Annotated[Path, out_option("Folder of the policy to write.", "FOLDER")],
    agents: Annotated[
        str, typer.Option("--agents", help="Agents of the files, in the same order.")
    ] = "agent_ls,agent_dc,agent_bat",
    activation: Annotated[
        Literal["tanh", "relu"],
        typer.Option("--activation", help="Activation function of the actors."),
    ] = "tanh",
    force: Annotated[bool, force_option()] = False,
) -> None:
    """Convert actors that HARL has trained on SustainDC to a policy."""
    from sdc_taichi.learning.import_harl import import_harl
    from sdc_taichi.learning.policy import WEIGHTS

    check_out_file(out / WEIGHTS, ".safetensors", force=force)
    names = [name.strip() for name in agents.split(",")]
    policy = import_harl(files, names, activation)
    policy.save(out)
    print(f"{printable(out)}: policy of {', '.join(policy.interface.agents)}")


def _origin(policy: Policy) -> str:
    """Return algorithm, steps, seed and version of a policy as one line of text."""
    about = policy.about
    parts = [about.algorithm, f"{about.steps:,} steps"]
    parts += [] if about.seed is None else [f"seed {about.seed}"]
    parts += [f"sdc-taichi {about.version}"] if about.version else []
    return ", ".join(parts)


def _facts(policy: Policy) -> list[tuple[str, str]]:
    """Return facts about interface and networks of a policy, as pairs of label and text."""
    fits = policy.interface
    order = "" if fits.action_order is None else f", order {fits.action_order}"
    facts = [("others", policy.about.others), ("actions", f"{fits.actions}{order}")]
    interval = policy.decision_steps
    facts += [("decides", "in every step" if interval == 1 else f"every {interval} steps")]
    facts += [("step", f"{fits.step_min} min"), ("observations", fits.observations)]
    for label, number in (("CRAC units", fits.crac_units), ("racks", fits.racks)):
        facts += [] if number is None else [(label, str(number))]
    for network in policy.networks:
        sizes = " x ".join(map(str, network.sizes))
        facts.append(("network", f"{', '.join(network.agents)}: {sizes}, {network.activation}"))
    for agent in fits.agents:
        names = (f.name if f.size == 1 else f"{f.name} ({f.size})" for f in fits.features[agent])
        facts.append((agent, f"{', '.join(fits.commands[agent])} by {', '.join(names)}"))
    return facts
