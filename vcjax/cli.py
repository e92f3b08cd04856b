"""The `vcjax` command. Its options are made from the configuration classes by tyro."""

import contextlib
import dataclasses
import io
import sys
import traceback
from collections.abc import Collection, Sequence
from typing import Annotated, Any

import jax
import tyro
from rich.console import Console

from vcjax.commands.bench import Bench
from vcjax.commands.console import say
from vcjax.commands.detect import Detect
from vcjax.commands.detectability import Detectability
from vcjax.commands.evaluate import Evaluate
from vcjax.commands.inspect import Inspect
from vcjax.commands.paper import Report, Reproduce
from vcjax.commands.record import Record
from vcjax.commands.run import Run
from vcjax.commands.simulate import Simulate
from vcjax.commands.sweep import Sweep
from vcjax.commands.track import Track
from vcjax.commands.tune import Tune
from vcjax.filter.config import FilterConfig
from vcjax.filter.motion_model import MOTIONS
from vcjax.study.reproduce import DETECTORS, GATES

WITHOUT_DEVICES = (Report, Track, Record, Inspect, Evaluate)
"""Commands that compute nothing in JAX."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the `vcjax` command; returns its exit status.

    Bad input gives one line on standard error and status 1, not a traceback. What is wrong with the command line itself
    the parser says, in a box, and exits with status 2.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # where a terminal's encoding lacks a sign, a question mark will do
    console = Console(stderr=True)
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        command = _parse(arguments)
        if not isinstance(command, WITHOUT_DEVICES):
            command.devices.start()
        command(console)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        say(console, f"vcjax: {error}", style="bold red")
        return 1
    except jax.errors.JaxRuntimeError as error:
        if jax.process_count() == 1:
            raise
        say(console, f"vcjax: another process has stopped or is late ({str(error).splitlines()[0]}).", style="bold red")
        return 1
    except KeyboardInterrupt:
        say(
            console,
            "vcjax: stopped; what `reproduce`, `detect`, `tune`, `sweep` and `run` have saved until now is on disk, "
            "and they go on there.",
        )
        return 130
    return 0


def _parse(arguments: list[str]) -> Any:
    """The command with its options. Gate and detector have options of their own, so they are looked up first."""
    gate = _named(arguments, "--gate", GATES, "VC")
    detector = _named(arguments, "--detector", DETECTORS, "inlier_ratio")
    config = FilterConfig(gate=GATES[gate](), detector=DETECTORS[detector]())
    simulate = Simulate(scenario=tyro.MISSING, config=config)
    motion = MOTIONS[_named(arguments, "--motion", MOTIONS, "odometry")]()
    config = dataclasses.replace(config, motion=motion)
    run = Run(recording=tyro.MISSING, config=config)
    union = (
        Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
        | Annotated[Report, tyro.conf.subcommand("report")]
        | Annotated[Simulate, tyro.conf.subcommand("simulate", default=simulate)]
        | Annotated[Tune, tyro.conf.subcommand("tune")]
        | Annotated[Sweep, tyro.conf.subcommand("sweep")]
        | Annotated[Detect, tyro.conf.subcommand("detect")]
        | Annotated[Detectability, tyro.conf.subcommand("detectability")]
        | Annotated[Track, tyro.conf.subcommand("track")]
        | Annotated[Record, tyro.conf.subcommand("record")]
        | Annotated[Inspect, tyro.conf.subcommand("inspect")]
        | Annotated[Run, tyro.conf.subcommand("run", default=run)]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Bench, tyro.conf.subcommand("bench")]
    )
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(
                union,  # type: ignore[arg-type]
                args=arguments,
                prog="vcjax",
                description="Which image features belong to moving things, and how should a camera move to find out?",
                config=(tyro.conf.OmitArgPrefixes,),
            )
    except SystemExit as stop:
        if refusal := _refusal(stop):
            raise refusal from None
        sys.stderr.write(told.getvalue())
        raise


def _refusal(stop: BaseException) -> ValueError | None:
    """What this package refused while the parser built a scenario or configuration, if that is why it stopped.

    The parser would put it into its box behind a name of its own making.
    """
    error = stop.__context__
    while error is not None:
        places = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
        if isinstance(error, ValueError) and places and places[-1].startswith("vcjax."):
            return error
        error = error.__context__
    return None


def _named(arguments: list[str], choice: str, known: Collection[str], default: str) -> str:
    """The last value of an option; the default where there is none, or one that the parser will refuse."""
    for option, value in zip(arguments, [*arguments, ""][1:], strict=True):
        name = value if option == choice else option[len(choice) + 1 :] if option.startswith(f"{choice}=") else ""
        default = name if name in known else default
    return default
