"""Pages of the site that the code makes: commands, quantities, fields of suites, and the API.

    python docs/site/generate.py OUT

writes ``commands.md``, ``quantities.md``, ``training-settings.md`` and a page for each part of the
API to OUT/reference/generated.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer.main
from field_tables import settings_markdown, suite_markdown
from stage import write

from sdc_taichi.cli.app import app
from sdc_taichi.types import CDUS, CRAC_UNITS, DATA_CENTERS, QUANTITIES, RACKS, meanings

FOLDER = "reference/generated"
"""Folder of the generated pages on the site."""


@dataclass(frozen=True)
class Part:
    """A page of the API."""

    name: str
    """Name of its file, without ending."""
    title: str
    """Title of the page."""
    about: str
    """What its first sentences say."""
    names: Sequence[tuple[str, Sequence[str]]]
    """Modules, and what of them is on the page; nothing named is all that they export."""


API = (
    Part(
        "simulation",
        "Simulation",
        "Data centers that step side by side. `Simulator` holds them; each of its steps takes "
        "`Actions` and returns a `StepResult`, whose fields are arrays with one value per data "
        "center.",
        [
            (
                "sdc_taichi",
                [
                    *("Simulator", "Actions", "StepResult", "State", "ServerLayers", "LoadAction"),
                    *("CoolAction", "BatteryAction", "FanAction", "Exogenous", "simulate"),
                    *("simulate_to_folder", "RunRequest", "Fleet", "build_fleet"),
                ],
            )
        ],
    ),
    Part(
        "configuration",
        "Configuration",
        "Descriptions of data centers, as presets, files and values put over them. Fields are "
        "listed under [configuration fields](../../configuration.md).",
        [
            (
                "sdc_taichi",
                ["load_config", "make_configs", "with_values", "preset_names", "DataCenterConfig"],
            ),
            ("sdc_taichi.config", ["config_from_dict", "apply_overrides"]),
        ],
    ),
    Part(
        "inputs",
        "Weather, carbon intensity and workload",
        "Series that drive data centers, from embedded years, files or arrays.",
        [
            ("sdc_taichi", ["Drivers", "load_drivers", "drivers_from_arrays"]),
            ("sdc_taichi.exogenous", []),
        ],
    ),
    Part(
        "controllers",
        "Controllers",
        "What decides on the actions of a step: rules, model-predictive control, trained policies, "
        "and controllers of your own. [Command line](../../cli.md#controllers) lists their names.",
        [
            ("sdc_taichi", ["make_controller", "register_controller", "View", "ForecastError"]),
            ("sdc_taichi.control", []),
        ],
    ),
    Part(
        "environments",
        "Environments",
        "Gymnasium and PettingZoo environments over the simulator; "
        "[environments](../../environments.md) says how they are used.",
        [
            (
                "sdc_taichi",
                [
                    *("vector_env", "parallel_env", "aec_env", "hall_env", "HallFamily"),
                    *("EnvOptions", "EndedBy"),
                    *("register_reward", "register_cost", "RecordEpisodes", "EpisodeRecorder"),
                    "compat",
                ],
            ),
            ("sdc_taichi.compat", ["SustainDC"]),
        ],
    ),
    Part(
        "optimum",
        "Known optimum",
        "Bounds and best paths with all inputs known; [known optimum](../../optimum.md) says how "
        "they are found.",
        [("sdc_taichi.optimum", [])],
    ),
    Part(
        "learning",
        "Learning",
        "Trainings, their settings, policies, and evaluations in weeks of the year.",
        [
            ("sdc_taichi.learning", ["train", "TrainingSettings"]),
            ("sdc_taichi.learning.policy", ["Policy", "About"]),
            (
                "sdc_taichi.learning.evaluation",
                ["prepare", "evaluate", "validate", "Contender", "DataCenterWeeks", "Evaluation"],
            ),
        ],
    ),
    Part(
        "benchmark",
        "Benchmark and studies",
        "Suites, sweeps and jobs of your own; [studies](../../studies.md) says how they are kept.",
        [
            ("sdc_taichi.benchmark.suite", ["Suite", "Case", "Row", "load_suite", "make_suite"]),
            ("sdc_taichi.benchmark.suite_run", ["run_suite", "study_of"]),
            ("sdc_taichi.benchmark.jobs", ["Job", "JobResult", "DoneJob"]),
            ("sdc_taichi.benchmark.executors", ["run_jobs", "JobSummary", "LocalProcesses"]),
            ("sdc_taichi.benchmark.store", ["ResultStore", "Study"]),
        ],
    ),
    Part(
        "recordings",
        "Recordings",
        "Heat maps, series and events for the Rerun viewer; "
        "[recordings and pictures](../../viz.md) shows them.",
        [("sdc_taichi", ["Recorder"])],
    ),
    Part(
        "errors",
        "Errors and warnings",
        "Errors that input can cause derive from `SdcError`, which is a `ValueError`; each says in "
        "one line what was found where, and what would be valid.",
        [
            (
                "sdc_taichi",
                [
                    *("SdcError", "ConfigError", "DataError", "PhysicalLimitError"),
                    *("RuntimeStateError", "SdcWarning", "OddInputWarning"),
                ],
            )
        ],
    ),
)
"""Pages of the API, in their order."""


def main() -> None:
    """Write the pages from the command line."""
    for name, text in pages().items():
        write(Path(sys.argv[1], FOLDER, f"{name}.md"), text.encode())


def pages() -> dict[str, str]:
    """Markdown of each generated page by the name of its file."""
    made = {
        "commands": commands_page(),
        "quantities": quantities_page(),
        "training-settings": settings_page(),
        "suite-fields": f"# Fields of suites\n\n{suite_markdown()}\n",
        "api": api_index(),
    }
    return made | {f"api-{part.name}": api_page(part) for part in API}


# --- The command line -----------------------------------------------------------------------------


def commands_page() -> str:
    """Every command with its arguments and options."""
    lines = [
        "# Commands and options",
        "",
        "Every command, as `--help` tells it. [Command line](../../cli.md) says by task how they "
        "are used.",
    ]
    for path, command in commands(typer.main.get_command(app), "sdc-taichi"):
        lines += ["", f"## `{path}`", "", plain(command.help or "")]
        arguments = [x for x in command.params if x.param_type_name == "argument"]
        options = [x for x in command.params if x.param_type_name == "option" and not hidden(x)]
        usage = " ".join([path, "[OPTIONS]", *map(value_text, arguments)])
        lines += ["", "```text", usage, "```"]
        for title, params in (("argument", arguments), ("option", options)):
            if params:
                lines += ["", f"| {title} | default | meaning |", "|---|---|---|"]
                lines += map(row, params)
    return "\n".join(lines) + "\n"


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Commands that do something, each with its path on the command line."""
    within = getattr(command, "commands", {})
    if not within or getattr(command, "invoke_without_command", False):
        yield path, command
    for name, each in within.items():
        if not each.hidden:
            yield from commands(each, f"{path} {name}")


def hidden(param: Any) -> bool:
    """Whether an option is left out of the help."""
    return bool(getattr(param, "hidden", False))


def value_text(param: Any) -> str:
    """How help tells the value of an argument or option; empty for a flag."""
    if getattr(param, "is_flag", False):
        return ""
    return str(param.metavar or param.name.upper())


def row(param: Any) -> str:
    """Line of a table for an argument or option."""
    is_option = param.param_type_name == "option"
    names = [*param.opts, *param.secondary_opts] if is_option else []
    shown = " ".join(filter(None, [", ".join(names), value_text(param)]))
    meaning = plain(param.help or "")
    default, found = "", re.search(r"\s*\[default: ([^\]]*)\]", meaning)
    if found:
        default, meaning = found[1], meaning.replace(found[0], "")
    elif param.required:
        default = "required"
    elif isinstance(param.default, str | int | float) and param.default not in (False, ""):
        default = f"`{param.default}`"
    cells = (f"`{shown}`", default, meaning)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def plain(text: str) -> str:
    """Text of a help page without line breaks within its paragraphs, as Markdown."""
    text = re.split(r"\f", text)[0]
    paragraphs = [" ".join(each.split()) for each in re.split(r"\n\s*\n", text)]
    return "\n\n".join(re.sub(r"([<>*_`])", r"\\\1", each) for each in paragraphs)


# --- Quantities of a step -------------------------------------------------------------------------


def quantities_page() -> str:
    """Every quantity of ``StepResult``."""
    axes = {DATA_CENTERS: "data center", CRAC_UNITS: "CRAC unit", CDUS: "CDU", RACKS: "rack"}
    lines = [
        "# Quantities of a step",
        "",
        "Every quantity of `StepResult`: an array with one entry per data center, CRAC unit, "
        "CDU or rack. Those per data center are the columns of `steps.parquet` ([files of a run]"
        "(../../run-folder.md)). Powers are means over the step; energies, volumes and tasks are "
        "totals of the step.",
        "",
        "| name | unit | per | meaning |",
        "|---|---|---|---|",
    ]
    for name, meaning in meanings().items():
        quantity = QUANTITIES[name]
        cells = (f"`{name}`", quantity.unit, axes[quantity.axis], meaning.replace("``", "`"))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


# --- Settings of a training -----------------------------------------------------------------------


def settings_page() -> str:
    """Every setting of a training."""
    lines = [
        "# Settings of a training",
        "",
        "Every setting of `sdc-taichi train`. `None` in the meanings is YAML's `null`. Section "
        "`environment` has the [options of environments](../../environments.md#options), section "
        "`overrides` the [fields of a configuration](../../configuration.md). "
        "[Learning](../../learning.md) says which options of environments trainings change.",
        "",
    ]
    return "\n".join(lines) + settings_markdown() + "\n"


# --- The API --------------------------------------------------------------------------------------


def api_index() -> str:
    """The page that lists the pages of the API."""
    lines = ["# Python API", "", "What a program may import, by task.", ""]
    lines += ["| page | about |", "|---|---|"]
    lines += [f"| [{x.title}](api-{x.name}.md) | {x.about.partition('. ')[0]} |" for x in API]
    toctree = [f"api-{part.name}" for part in API]
    return "\n".join([*lines, "", "```{toctree}", ":hidden:", "", *toctree, "```", ""])


def api_page(part: Part) -> str:
    """A page of the API."""
    lines = [f"# {part.title}", "", part.about, "", "```{eval-rst}"]
    for module, name in documented(part):
        kind = kind_of(name)
        lines += ["", f".. auto{kind}:: {module}.{name}"]
        if kind == "class":
            lines += ["   :members:", "   :undoc-members:", f"   :exclude-members: {OF_PYDANTIC}"]
        if name == "StepResult":
            lines += ["   :inherited-members:"]
    return "\n".join([*lines, "```", ""])


OF_PYDANTIC = "model_config, model_post_init, model_computed_fields, model_fields"
"""Members of pydantic's models that are not those of their users."""


def documented(part: Part) -> list[tuple[str, str]]:
    """Modules and names on a page, each name once."""
    found: dict[str, str] = {}
    for module, names in part.names:
        for name in names or importlib.import_module(module).__all__:
            found.setdefault(name, module)
    return [(module, name) for name, module in found.items()]


MODULES = ("compat",)
"""Public names that are modules."""


def kind_of(name: str) -> str:
    """What a name is of, as its letters tell it; nothing is imported, as not all is installed."""
    if name in MODULES:
        return "module"
    if name.isupper():
        return "data"
    if name.endswith(("Error", "Warning")):
        return "exception"
    return "class" if name[0].isupper() else "function"


if __name__ == "__main__":
    main()
