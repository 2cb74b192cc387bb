"""The ``surgbench`` command: a thin skin over the package.

Every mistake a user can make ends in one line on standard error and exit code 2; a traceback is shown only
with ``--debug``.
"""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from surgbench.caches import settle_caches
from surgbench.cli.bench import bench_app
from surgbench.cli.check import tracker
from surgbench.cli.compare import compare
from surgbench.cli.convert import convert_app
from surgbench.cli.export import export
from surgbench.cli.generate import generate
from surgbench.cli.grouped import GroupedCommand
from surgbench.cli.handeye import handeye
from surgbench.cli.import_ import import_app
from surgbench.cli.instrument import INSTRUMENT, instrument_app
from surgbench.cli.list_ import list_names
from surgbench.cli.options import field_options, with_options
from surgbench.cli.report import report
from surgbench.cli.reproduce import reproduce
from surgbench.cli.run import run
from surgbench.cli.score import score
from surgbench.cli.serve_viewpoint import REMOTE, serve_viewpoint
from surgbench.cli.submit import submit, verify
from surgbench.cli.track import IMPORTER, NOT_ASKED, track
from surgbench.cli.train import train_app
from surgbench.cli.validate import validate
from surgbench.cli.video import video
from surgbench.cli.view import view
from surgbench.errors import SurgbenchError
from surgbench.extras import not_installed
from surgbench.processes.streams import abandon_output, flush_output, print_whatever_comes
from surgbench.version import __version__

# What these write appears when it is whole; of all others, what is done is not done again.
_WHOLE = ("import", "export", "track", "handeye", "video", "view", "convert")
INTERRUPTED = 130  # typer's own exit code for Ctrl-C, and the shell's
BROKEN_PIPE = 1  # typer's own exit code for output that nobody reads any more


class _Commands(TyperGroup):
    """What tasks and importers may be told is looked for when it is asked for: it takes longer than all the rest."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that the arguments begin with."""
        name, command, rest = super().resolve_command(ctx, args)
        more = {
            "run": _run_with_all_options,
            "track": _track_with_all_options,
            "serve-viewpoint": _serve_with_all_options,
        }
        whole = more.get(name or "")
        return name, command if whole is None else whole(), rest


def _run_with_all_options() -> Any:
    from surgbench.suite.asked import RowRequest
    from surgbench.task import all_tasks

    options = field_options({task.row: f"Of the {task.name} task" for task in all_tasks()}, RowRequest)
    own = typer.Typer(rich_markup_mode=None, add_completion=False, pretty_exceptions_enable=False)
    own.command("run", cls=GroupedCommand)(with_options(run, options, "asked"))
    return typer.main.get_command(own)


def _track_with_all_options() -> Any:
    from surgbench.registry import find

    model: Any = getattr(find("importer", IMPORTER).cls, "Config")  # noqa: B009
    options = {key: value for key, value in field_options({model: ""}).items() if key not in NOT_ASKED}
    own = typer.Typer(rich_markup_mode=None, add_completion=False, pretty_exceptions_enable=False)
    own.command("track", cls=GroupedCommand)(with_options(track, options, "options"))
    return typer.main.get_command(own)


def _serve_with_all_options() -> Any:
    from surgbench.registry import find
    from surgbench.suite.asked import RowRequest
    from surgbench.task import find_task

    options = field_options({find_task(find("tracker", REMOTE).task).row: "With --dataset"}, RowRequest)
    own = typer.Typer(rich_markup_mode=None, add_completion=False, pretty_exceptions_enable=False)
    own.command("serve-viewpoint", cls=GroupedCommand)(with_options(serve_viewpoint, options, "asked"))
    return typer.main.get_command(own)


app = typer.Typer(
    name="surgbench",
    cls=_Commands,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Example: surgbench generate mini --out data/mini && surgbench run --dataset data/mini --tracker cmaes",
)
check_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


def _version(asked: bool) -> None:
    if asked:
        print(f"surgbench {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show tracebacks; stands before or after the command.")
    ] = False,
) -> None:
    """Make surgical instrument tracking data, run trackers on it, and compare them."""


app.command("generate")(generate)
app.add_typer(import_app, name="import")
app.command("validate")(validate)
app.command("run")(with_options(run, {}, "asked"))  # for the list of commands
app.command("report")(report)
app.command("compare")(compare)
app.command("reproduce")(reproduce)
app.command("video")(video)
app.command("view")(view)
app.command("export")(export)
app.command("score")(score)
app.command("submit")(submit)
app.command("verify")(verify)
app.command("track")(with_options(track, {}, "options"))  # likewise
app.command("handeye")(handeye)
app.command("serve-viewpoint")(with_options(serve_viewpoint, {}, "asked"))  # likewise
app.command("list")(list_names)
check_app.command("tracker")(tracker)
app.add_typer(check_app, name="check")
app.add_typer(train_app, name="train")
app.add_typer(convert_app, name="convert")
app.add_typer(instrument_app, name=INSTRUMENT)
app.add_typer(bench_app, name="bench")


@check_app.callback()
def _check() -> None:
    """See whether a plug-in keeps the rules.

    Example: surgbench check tracker cmaes
    """


def main() -> None:
    """Entry point of the console script."""
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    print_whatever_comes()
    settle_caches()
    try:
        code = _run(arguments, debug)
        flush_output()
    except BrokenPipeError:  # `| head`: what was asked for is done
        abandon_output()
        code = BROKEN_PIPE
    except OSError as error:
        if debug:
            raise
        abandon_output()
        code = _complain(f"standard output: {(error.strerror or str(error)).lower()}")
    sys.exit(code)


def _run(arguments: list[str], debug: bool) -> int:
    """Run a command; what goes wrong becomes a line.

    Raises:
        BrokenPipeError: Nobody reads standard output any more.
    """
    try:
        code = app(arguments, standalone_mode=False)
    except BrokenPipeError:
        raise
    except SurgbenchError as error:
        if debug:
            raise
        code = _complain(str(error))
    except OSError as error:
        if debug:
            raise
        place = f"{error.filename}: " if error.filename else ""
        code = _complain(f"{place}{(error.strerror or str(error)).lower()}")
    except ImportError as error:
        if debug:
            raise
        lacking = isinstance(error, ModuleNotFoundError) and error.name is not None
        code = _complain(not_installed([error.name or ""]) if lacking else f"{error.name} cannot be loaded: {error}")
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:
        # What typer raises for a wrong command line knows how to say so.
        describe = getattr(error, "format_message", None)
        if debug or describe is None:
            raise
        message = str(describe()).strip()
        if "\n" in message:  # no command at all: the help
            print(message)
            code = 2
        else:
            code = _complain(message or "not enough arguments; see --help")
    if code == INTERRUPTED:
        command = next((word for word in arguments if not word.startswith("-")), "")
        again = "begins anew, nothing is left" if command in _WHOLE else "goes on from here"
        print(f"surgbench: interrupted; the same command again {again}", file=sys.stderr)
    return code if isinstance(code, int) else 0


def _complain(message: str) -> int:
    print(f"surgbench: {' '.join(message.split())}", file=sys.stderr)
    return 2
