"""The command's entry: its list of commands, its errors and its exit codes."""

from __future__ import annotations

import importlib
import keyword
import logging
import signal
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperGroup

from droguekit.cli.outputs import CheckedCommand
from droguekit.output_streams import guard_standard_streams, printable

DONE, FAULT, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


class Command(NamedTuple):
    """One command.

    Attributes:
        module: that holds the function of the command's name, and its lines of `EXAMPLES`; imported only when the
            command is asked for.
        summary: one line for the list of commands.
    """

    module: str
    summary: str


# Commands that continue where they stopped.
_GO_ON = ("demo", "render", "train")
COMMANDS = {
    "new": Command("droguekit.cli.dataset_commands", "Write a commented drogue, rig or recipe to start from."),
    "plan": Command(
        "droguekit.cli.dataset_commands", "Show what a recipe will make, how long it takes and how large it gets."
    ),
    "check": Command(
        "droguekit.cli.dataset_commands", "Predict how well a recipe's markers can be measured, and what will fail."
    ),
    "render": Command("droguekit.cli.dataset_commands", "Make a dataset from a recipe; continues where it stopped."),
    "merge": Command("droguekit.cli.dataset_commands", "Join shards of a dataset into one."),
    "import": Command("droguekit.cli.exchange_commands", "Make a dataset from real stereo images, without truth."),
    "validate": Command("droguekit.cli.dataset_commands", "Check a dataset: files, hashes, labels against part ids."),
    "coverage": Command(
        "droguekit.cli.assurance_commands", "Count a dataset's pairs in the cells of an operational design domain."
    ),
    "diff": Command("droguekit.cli.assurance_commands", "Tell how two datasets differ beyond chance."),
    "mine": Command("droguekit.cli.assurance_commands", "Write a recipe that draws more of what fails."),
    "real-check": Command(
        "droguekit.cli.assurance_commands", "Look for drogues in your own photographs, and compare their looks."
    ),
    "reproduce": Command("droguekit.cli.dataset_commands", "Render one frame of a dataset again and compare."),
    "export": Command("droguekit.cli.exchange_commands", "Write a dataset's labels in another format."),
    "preview": Command("droguekit.cli.viewing_commands", "Draw a contact sheet of a dataset with its labels."),
    "browse": Command("droguekit.cli.viewing_commands", "Write a page to look through a dataset in a browser."),
    "view": Command(
        "droguekit.cli.viewing_commands", "Show a dataset in the rerun viewer: images, labels, 3-D, errors."
    ),
    "detect": Command("droguekit.cli.navigation_commands", "Find the drogue in every image, without the truth."),
    "train": Command("droguekit.cli.navigation_commands", "Train a detector on datasets, evaluate and export it."),
    "navigate": Command(
        "droguekit.cli.navigation_commands", "Estimate the drogue's pose in every pair, without the truth."
    ),
    "benchmark": Command(
        "droguekit.cli.navigation_commands", "Compare estimates with the truth: numbers and a report."
    ),
    "report": Command(
        "studies.paper.report_command",
        "Put our numbers beside the seed paper's: its tables and figures, as page and PDF.",
    ),
    "model": Command("droguekit.cli.viewing_commands", "Write the drogue as a mesh."),
    "demo": Command("droguekit.cli.demo", "Render a small dataset, navigate on it, and report."),
    "bench": Command("droguekit.cli.machine_commands", "Measure the CPU time of a pair by distance and stage."),
    "doctor": Command("droguekit.cli.machine_commands", "Show what is installed and which engines work."),
}
# Characters around one that no encoding has, which tell the name that it belongs to.
_SHOWN_BESIDE = 40
# Studies are in the repository and not in the wheel: in a clone they lie beside this package.
_STUDIES, _REPOSITORY = "studies.", Path(__file__).resolve().parents[2]

HELP = """Synthetic stereo pairs of a refuelling drogue with ground truth, and navigation measured against it.

`droguekit COMMAND --help` explains a command and shows examples. With --debug anywhere, an error shows its traceback.

Exit codes: 0 done, 1 the work found a fault, 2 wrong usage or input, 130 interrupted.
"""


def load_command(name: str) -> Any:
    """Import the module of a command and return the command; None where there is none."""
    if name not in COMMANDS:
        return None
    chosen = COMMANDS[name]
    if chosen.module.startswith(_STUDIES) and str(_REPOSITORY) not in sys.path:
        sys.path.append(str(_REPOSITORY))
    try:
        module = importlib.import_module(chosen.module)
    except ModuleNotFoundError as error:
        if not (error.name and f"{error.name}.".startswith(_STUDIES)):
            raise
        raise ValueError(f"{name}: is no part of the installed package; run it in a clone of the repository") from error
    # Some names are Python keywords, such as `import`, or have a hyphen.
    function = getattr(module, f"{name}_" if keyword.iskeyword(name) else name.replace("-", "_"))
    examples: tuple[str, ...] = module.EXAMPLES[name]
    # The backspace keeps the help's line breaks.
    epilog = "\n".join(["\b", "Examples:", *(f"  {line}" for line in examples)]) if examples else None
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    app.command(name=name, cls=CheckedCommand, epilog=epilog, short_help=chosen.summary, no_args_is_help=False)(
        function
    )
    return typer.main.get_command(app)


class LazyGroup(TyperGroup):
    """Commands whose modules are imported when one of them is used, so that `--help` answers at once."""

    def list_commands(self, ctx: typer.Context) -> list[str]:  # type: ignore[override]
        """Names of all commands."""
        return list(COMMANDS)

    def get_command(self, ctx: typer.Context, cmd_name: str) -> Any:  # type: ignore[override]
        """The command, imported now; None where there is none."""
        return load_command(cmd_name)

    def format_commands(self, ctx: typer.Context, formatter: Any) -> None:  # type: ignore[override]
        """List the commands for `--help` without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, command.summary) for name, command in COMMANDS.items()])


app = typer.Typer(
    cls=LazyGroup, add_completion=False, rich_markup_mode=None, no_args_is_help=True, pretty_exceptions_enable=False
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"droguekit {version('droguekit')}")
        raise typer.Exit(DONE)


@app.callback(help=HELP)
def droguekit(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """The command without a subcommand."""


def explain(error: BaseException) -> str:
    """An error as one line that names its subject."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    if isinstance(error, UnicodeEncodeError) and error.encoding == "utf-8":
        # Such a name cannot be written into a file, and libraries refuse it without saying which it is.
        part, *_ = error.object[error.end : error.end + _SHOWN_BESIDE].split("/")
        shown = " ".join((error.object[max(error.start - _SHOWN_BESIDE, 0) : error.end] + part).split())
        return f"{shown}: has characters that are not UTF-8; rename the file or folder"
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, ValueError | OSError):
        return text
    return f"internal fault, {type(error).__name__}: {text}; please report it with what --debug shows"


def _show_pair_faults() -> None:
    """Show the traces of faults that end the work on one pair and not the run."""
    logger = logging.getLogger("datasets_manifest.storage.pair_faults")
    if not logger.handlers:
        logger.addHandler(logging.StreamHandler())
    logger.setLevel(logging.DEBUG)


def run(arguments: list[str], command: typer.Typer = app, name: str = "droguekit") -> int:
    """Run a command line.

    Args:
        arguments: everything after the command's name. A `--debug` anywhere in it lets errors show their traceback.
        command: whose arguments they are.
        name: of the command, in its help and its errors.

    Returns:
        The exit code.
    """
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    if debug:
        _show_pair_faults()
    try:
        typer.main.get_command(command).main(args=arguments, prog_name=name, standalone_mode=True)
    except SystemExit as exit_:
        code = exit_.code if isinstance(exit_.code, int) else DONE if exit_.code is None else WRONG_INPUT
        if code == INTERRUPTED:
            goes_on = bool(arguments) and arguments[0] in _GO_ON
            print(f"{name}: interrupted{'; run the same command to continue' * goes_on}", file=sys.stderr)
        return code
    except Exception as error:
        if debug:
            raise
        print(f"{name}: error: {printable(explain(error))}", file=sys.stderr)
        return WRONG_INPUT
    return DONE


def main() -> None:
    """Entry point of the installed command."""
    # SIGTERM ends a command as Ctrl-C does: what is half written is removed.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    guard_standard_streams()
    code = run(sys.argv[1:])
    try:
        sys.stdout.flush()
    except OSError as error:
        print(f"droguekit: error: {explain(error)}", file=sys.stderr)
        code = WRONG_INPUT
    sys.exit(code)


if __name__ == "__main__":
    main()
