"""The `fls-flow` command: a module per verb, loaded when it is called, so that `--help` loads no numerics.

Exit code 0 if all went well, 2 for a mistake in what the user wrote, 1 for a failure at run time, 130 after
Ctrl-C.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import sys
from difflib import get_close_matches

import click

from fls_flow.cli.common import show
from fls_flow.errors import FlsFlowError

__all__ = ["main"]

# verb -> its line in `--help`; each is the command `VERB` of the module `fls_flow.cli.VERB`
VERBS = {
    "run": "Run GRAPH, a file or the name of a shipped graph.",
    "check": "Find every mistake in GRAPHS without running them.",
    "plugins": "List the installed kinds, or show one.",
    "top": "Show what the nodes of a run are doing.",
    "draw": "Draw GRAPH as Mermaid text or as an SVG picture.",
    "schema": "Print the JSON Schema of graph or deployment files, for editors.",
    "evaluate": "Score tracks, detections and estimates against truth.",
    "train": "Train classifiers on the features of tracks.",
    "calibrate": "Find the threshold with which a detector meets a rate of false alarms.",
    "sweep": "Run GRAPH over a grid of parameters and score every cell.",
}


class Verbs(click.Group):
    """A group that imports a verb's module when the verb is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The verbs in the order in which one meets them."""
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name; None when there is none."""
        if cmd_name not in VERBS:
            return None
        module = importlib.import_module(f"fls_flow.cli.{cmd_name}")
        command: click.Command = getattr(module, cmd_name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that the words name; a misspelt one gets a suggestion."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = get_close_matches(args[0], VERBS, n=1)
            hint = f" Did you mean '{near[0]}'?" if near else ""
            raise click.UsageError(f"{error.message}{hint}", ctx) from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The verbs with their lines, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(VERBS.items()))


@click.group(cls=Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fls-flow", prog_name="fls-flow")
@click.option("--debug", is_flag=True, help="Show tracebacks and debug messages.")
def cli(debug: bool) -> None:
    """Forward-looking sonar, from pings to tracked obstacles.

    \b
    Example:
      fls-flow run surface_obstacle
    """


def main() -> None:
    """Run the command line; every error is one line, with a traceback only for --debug."""
    _open_streams()
    debug = "--debug" in sys.argv[1:]
    if debug:  # wherever it stands
        sys.argv = [sys.argv[0], "--debug", *(word for word in sys.argv[1:] if word != "--debug")]
    try:
        sys.exit(cli(standalone_mode=False) or 0)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(error.exit_code)
    except click.ClickException as error:
        show(FlsFlowError(_usage(error)), debug)
        sys.exit(error.exit_code)
    except click.exceptions.Abort:
        sys.exit(130)
    except BrokenPipeError:
        _drop_output()  # whoever read has had enough
        sys.exit(1)
    except FlsFlowError as error:
        show(error, debug)
        sys.exit(error.exit_code)
    except OSError as error:
        show(FlsFlowError(_told(error)), debug)
        _drop_output()  # nor can the rest be written
        sys.exit(1)
    except Exception as error:
        show(error, debug)
        sys.exit(1)


def _usage(error: click.ClickException) -> str:
    """What click has to say, and where help is, on one line."""
    context = error.ctx if isinstance(error, click.UsageError) else None
    command = context.command_path if context is not None else "fls-flow"
    return f"{error.format_message().removesuffix('.')}; see {command} --help"


def _open_streams() -> None:
    """Stand-ins for standard streams that are closed: what is opened next must not be taken for them."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest that is free: this one
    sys.stdout = sys.stdout or os.fdopen(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", encoding="utf-8", closefd=False)


def _told(error: OSError) -> str:
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return "too many open files; raise the limit (ulimit -n)"
    return f"{error.filename or 'output'}: {error.strerror or error}"


def _drop_output() -> None:
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
