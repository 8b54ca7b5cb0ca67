"""The program ``gvtools``: one command a module, errors in one line, exit status 0, 2 or 1."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import threading
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import NoReturn

import gvtools
from gvtools.errors import GvError
from gvtools.system_libraries import advice, missing_libraries
from pipelines.console import Console
from pipelines.options import Arguments, add_command

# The module of each command, which has it as a class: demo is DemoCommand.
COMMANDS = {
    "demo": "pipelines.commands.reconstruct",
    "capture": "pipelines.commands.capture",
    "check": "pipelines.commands.data",
    "reconstruct": "pipelines.commands.reconstruct",
    "refine": "pipelines.commands.reconstruct",
    "split": "pipelines.commands.reconstruct",
    "merge": "pipelines.commands.reconstruct",
    "render": "pipelines.commands.render",
    "tradeoff": "pipelines.commands.sweep",
    "evaluate": "pipelines.commands.evaluate",
    "judge": "pipelines.commands.evaluate",
    "benchmark": "pipelines.commands.sweep",
    "fleet": "pipelines.commands.sweep",
    "trajectory": "pipelines.commands.evaluate",
    "report": "pipelines.commands.view",
    "plot": "pipelines.commands.view",
    "completers": "pipelines.commands.weights",
    "weights": "pipelines.commands.weights",
    "data": "pipelines.commands.data",
    "train": "pipelines.commands.train",
    "export": "pipelines.commands.export",
    "film": "pipelines.commands.render",
    "view": "pipelines.commands.view",
    "bench": "pipelines.commands.bench",
}


class _Terminated(KeyboardInterrupt):
    """The process was asked to end: it ends as on Ctrl-C."""


def _terminate(*_: object) -> NoReturn:
    raise _Terminated


class _Parser(argparse.ArgumentParser):
    """An argument parser whose complaint is one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"gvtools: {message}; see '{self.prog} --help'\n")


def build_parser(
    modules: Mapping[str, str] = COMMANDS, *, only: str | None = None
) -> argparse.ArgumentParser:
    """The parser of all commands, given as name and module.

    Args:
        only: name of the one that is loaded, which may take a second; None loads all, and "" all
            but their options.
    """
    parser = _Parser(
        prog="gvtools",
        description="Grow a coloured point-cloud memory from posed photographs or RGB-D, project "
        "it into new cameras, complete what it does not know, and measure the result.",
        epilog="gvtools COMMAND --help tells more of each command.",
    )
    parser.add_argument("--version", action="version", version=f"gvtools {gvtools.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    for name, path in modules.items():
        if only in modules and name != only:
            commands.add_parser(name)
            continue
        command: type[Arguments] = getattr(import_module(path), f"{name.capitalize()}Command")
        added = add_command(commands, name, command, whole=only in (None, name))
        added.add_argument("--quiet", action="store_true", help="print nothing but warnings")
        added.add_argument("--debug", action="store_true", help="show tracebacks of errors")
    return parser


def main(argv: Sequence[str] | None = None, *, modules: Mapping[str, str] = COMMANDS) -> int:
    """Run one command; returns the exit status: 0 done, 2 wrong input or options, 1 otherwise.

    Args:
        argv: the command line; None takes this process's.
        modules: the commands to choose from, as name and module.
    """
    # Waiting threads that spin would take the cores that other programs need, and with them ours.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for name in ("stdin", "stdout", "stderr"):
        # Closed ones: else files of ours would get their numbers, which libraries print to.
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            # What a console's encoding lacks is escaped: no work is lost for a name's sake.
            stream.reconfigure(errors="backslashreplace")
    main_thread = threading.current_thread() is threading.main_thread()
    if main_thread and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)
    words = sys.argv[1:] if argv is None else argv
    args = argparse.Namespace(debug=False)
    try:
        parser = build_parser(modules, only=words[0] if words and words[0][:1] != "-" else "")
        args = parser.parse_args(argv)
        if args.command is None:
            parser.print_help()
            return 2
        args.command_class.read(args).run(Console(quiet=args.quiet))
    except BrokenPipeError:
        # The reader of the output, such as ``head``, has seen enough; nothing is left to flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except GvError as error:
        if args.debug:
            raise
        print(f"gvtools: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        goes_on = (
            "reconstruct and train go on with --resume, tradeoff, benchmark, fleet and data shards "
            "by themselves; refine changed nothing"
        )
        ended = isinstance(interrupt, _Terminated)
        what = "terminated" if ended else "interrupted"
        print(f"gvtools: {what}; {goes_on}", file=sys.stderr)
        return 128 + signal.SIGTERM if ended else 1
    except Exception as error:
        if args.debug:
            raise
        missing = missing_libraries() if isinstance(error, ImportError | OSError) else ()
        # A loader's error names a library; a file's does not.
        if missing and ".so" in str(error):
            print(f"gvtools: {advice(missing)}", file=sys.stderr)
            return 2
        name = type(error).__name__
        print(f"gvtools: unexpected {name}: {error}; --debug shows where", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
