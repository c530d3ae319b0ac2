# SPDX-License-Identifier: Apache-2.0
"""All commands, and how errors end a process.

Exit codes: 0 done (also for a run that was interrupted and finished with the frames it had), 1 failed, 2 the
input or the command line is wrong, 130 interrupted with nothing to save. Modules that take long to import are
imported inside the commands.
"""

from __future__ import annotations

import logging
import os
import sys
from typing import Annotated, Any, NoReturn

import typer

from slamdepth.cli import (
    batch,
    calibrate,
    compare,
    data_stats,
    depth,
    eval_depth,
    evaluate,
    evaluate_mesh,
    export,
    info,
    localize,
    merge,
    render,
    run,
    scale,
    synth,
    train,
    view,
    weights,
)
from slamdepth.cli.console import QuietOption, UsageProblem, VerboseOption, error_console, is_verbose
from slamdepth.errors import SlamdepthError

app = typer.Typer(
    name="slamdepth",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("run")(run.run_command)
app.command("batch")(batch.batch_command)
app.command("export")(export.export_command)
app.command("localize")(localize.localize_command)
app.command("merge")(merge.merge_command)
app.command("info")(info.info_command)
app.command("view")(view.view_command)
app.command("compare")(compare.compare_command)
app.command("render")(render.render_command)
app.command("scale")(scale.scale_command)
app.command("calibrate")(calibrate.calibrate_command)
app.command("synth")(synth.synth_command)
app.command("evaluate")(evaluate.evaluate_command)
app.command("evaluate-mesh")(evaluate_mesh.evaluate_mesh_command)
app.command("depth")(depth.depth_command)
app.command("eval-depth")(eval_depth.eval_depth_command)
app.command("train-depth")(train.train_depth_command)
app.command("data-stats")(data_stats.data_stats_command)
app.add_typer(weights.app, name="weights")


def _print_version(asked: bool) -> None:
    if asked:
        from slamdepth._version import __version__

        typer.echo(f"slamdepth {__version__}")
        raise typer.Exit


@app.callback()
def _everything(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """One camera in, a metric trajectory and a mesh out.

    Example: slamdepth synth room --frames 60, then slamdepth run room --depth sensor

    'slamdepth COMMAND --help' explains a command, with an example.
    """


def main() -> NoReturn:
    """Run the command line; known errors end in one line on standard error."""
    # Read when PyTorch loads. Spinning threads make the network ten times slower as soon as another
    # program uses the processor.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        code = app(standalone_mode=False)
    except SlamdepthError as error:
        _print_error(str(error))
        code = error.exit_code
    except UsageProblem as problem:
        # typer shows the help itself where no command is given; its message is then empty.
        if message := problem.format_message():
            context = getattr(problem, "ctx", None)
            command = getattr(context, "command_path", None) or "slamdepth"
            _print_error(f"{message}{_usage(context, message)} (see '{command} --help')")
        code = problem.exit_code
    except (KeyboardInterrupt, typer.Abort):
        _print_error("interrupted")
        code = 130
    except BrokenPipeError:  # the reader of a pipe has gone: 'slamdepth ... | head'
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    logging.shutdown()
    sys.exit(code if isinstance(code, int) else 0)


def _usage(context: Any, message: str) -> str:
    """The usage of the command where an argument is missing, otherwise an empty text."""
    if context is None or not message.startswith("Missing argument"):
        return ""
    pieces = " ".join(context.command.collect_usage_pieces(context))
    return f" Usage: {context.command_path} {pieces.translate(str.maketrans('', '', '{}'))}"


def _print_error(message: str) -> None:
    """Print an error in one line."""
    if is_verbose() and sys.exc_info()[0] is not None:
        error_console().print_exception()
    print("error:", " ".join(message.split()), file=sys.stderr)
