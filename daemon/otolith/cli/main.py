"""The group ``otolith`` and its simple commands. Each command imports what it needs, so that help is quick."""

import math
import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from otolith import __version__
from otolith.cli.commissioning.commission import commission
from otolith.cli.commissioning.components import components, reset
from otolith.cli.commissioning.config import config
from otolith.cli.commissioning.draft.command import init
from otolith.cli.commissioning.drivers import drivers
from otolith.cli.commissioning.noise import noise
from otolith.cli.commissioning.probe import probe
from otolith.cli.commissioning.twin import twin
from otolith.cli.common import (
    ANY_DATA_FILES,
    FILE,
    INTERRUPTED,
    MACHINE_FILE,
    MACHINES,
    StopSignal,
    endpoints,
    log_to_stderr,
    new_file,
    progress_line,
    reader_options,
    shipped_directory,
)
from otolith.cli.operation.baseline import baseline
from otolith.cli.operation.event import event
from otolith.cli.operation.explain import explain
from otolith.cli.operation.export import export
from otolith.cli.operation.history import history, report, reproduce
from otolith.cli.operation.install import install
from otolith.cli.operation.keys import keys
from otolith.cli.operation.simulate import simulate
from otolith.cli.operation.view import view
from otolith.cli.schema import schema
from otolith.cli.site import site
from otolith.cli.terminal import echo

if TYPE_CHECKING:
    from otolith.publishing.zenoh_config import Credentials

TRANSPORTS = ("can", "modbus-tcp", "modbus-rtu")  # the keys of plant.realtime.NODES, which is slow to import
EXIT_CODES = """\b
Exit codes:
  0    done; run and plant also when stopped by SIGTERM
  1    demo: an estimate was wrong; probe: nothing answered or was received;
       check: a signal was missing, or no window of DATA can be used;
       reproduce: a report was not the same
  2    a file, option, bus or port cannot be used; the message says which, why
       and what to do
  78   the same of 'run' and 'site' for a file that is wrong: no restart helps
  130  interrupted by Ctrl-C (128 + n by another signal n)"""


def _new_recording(context: click.Context, option: click.Parameter, path: Path | None) -> Path | None:
    if path is not None and path.suffix != ".rrd":
        raise click.BadParameter(f"{str(path)!r}: the name of a recording ends in .rrd")
    return new_file(context, option, path)


def _new_page(context: click.Context, option: click.Parameter, path: Path | None) -> Path | None:
    """Return the file of a page, whose folder is made."""
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise click.BadParameter(f"{str(path)!r}: its folder cannot be made: {error.strerror}") from error
    return new_file(context, option, path)


def _watched(_: click.Context, __: click.Parameter, text: str) -> str:
    from otolith.cli.machines import is_file, key_of

    if not is_file(text) and not re.fullmatch(r"[A-Za-z0-9_\-*]+(\.[A-Za-z0-9_\-*]+)?", text):
        raise click.BadParameter(f"{text!r} is no machine name: use letters, digits, '_', '-' and '*'")
    return key_of(text)


def _replayed(_: click.Context, __: click.Parameter, text: str) -> Path:
    from otolith.cli.machines import file_of

    return Path(text) if Path(text).is_dir() else file_of(text)


def _replay_batch(
    machines: tuple[Path, ...],
    data: tuple[Path, ...],
    output: Path,
    state: Path | None,
    jobs: int | None,
    kind: str | None,
    cluster: tuple[str | None, Path | None, Path | None, Path | None],
    stop: StopSignal,
) -> None:
    from otolith.cli.replay_batch import replay_batch
    from otolith.runtime.batch.cluster import ClusterAccess
    from otolith.runtime.batch.outputs import OutputFormat

    if not data:
        raise click.UsageError("Missing argument 'DATA...'.")
    address, *files = cluster
    access = None if address is None else ClusterAccess(address, *files)
    if jobs is not None and access is not None:
        raise click.UsageError("--jobs is for this computer: a cluster has the workers that were started for it")
    log_to_stderr(verbose=False)
    replay_batch(machines, data, output, OutputFormat(kind or "jsonl"), state, jobs, access, stop.received)


@contextmanager
def _output_may_close() -> Iterator[None]:
    """Exit code 0 where the reader of standard output has closed it, as ``head`` does; click and rich exit with 1."""
    try:
        yield
    except (BrokenPipeError, SystemExit) as error:
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is still buffered
        raise click.exceptions.Exit(0) from error


class _Commands(click.Group):
    @_output_may_close()
    def make_context(self, *arguments: Any, **options: Any) -> click.Context:
        return super().make_context(*arguments, **options)

    @_output_may_close()
    def invoke(self, ctx: click.Context) -> object:
        return super().invoke(ctx)


@click.group(
    cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "show_default": True}, epilog=EXIT_CODES
)
@click.version_option(__version__, prog_name="otolith")
def cli() -> None:
    """Otolith estimates the physical parameters of a machine while it runs.

    It listens to the drive, fits a white-box twin to every window of a few seconds, and reports in physical terms
    what has changed.

    \b
    Start here:
      otolith demo                        a simulated motor, daemon and live table
      otolith check config/dc-motor.toml  read a machine file, explain it, listen
      otolith run config/dc-motor.toml    the daemon, in the foreground
    """


@cli.command()
@MACHINES
@click.option("--listen", multiple=True, callback=endpoints, metavar="ENDPOINT",
              help="Publish here instead of where the file says; may be repeated.")  # fmt: skip
@click.option("--recording", type=FILE, callback=_new_recording,
              help="Record into this file instead of a new one in the state directory.")  # fmt: skip
@click.option("--workers", type=click.IntRange(1), metavar="NUMBER",
              help="Processes that compute for several machines.  [default: one per processor]")  # fmt: skip
@click.option("-v", "--verbose", is_flag=True, help="Log more.")
def run(
    paths: tuple[Path, ...], listen: tuple[str, ...], recording: Path | None, workers: int | None, verbose: bool
) -> int:
    """Run the daemon for the machines in PATH.

    PATH is a machine file, the name of a machine, or a directory of machine files. The machines of several files share
    the processes of one daemon: a hall.
    It runs until SIGTERM or Ctrl-C. SIGHUP takes over changed limits, rules,
    [recording], certificates and readers from the files, and in a hall files that were added, changed or removed.

    \b
    Examples:
      otolith run config/dc-motor.toml
      otolith run config/dc-motor.toml --listen tcp/127.0.0.1:7450
      otolith run /etc/otolith/hall
    """
    import faulthandler

    from otolith.cli.run import serve

    log_to_stderr(verbose=verbose)
    faulthandler.enable()  # systemd's watchdog sends SIGABRT: the log then has where each thread was
    ended_by = serve(paths, listen or None, recording, workers)
    return INTERRUPTED if ended_by == signal.SIGINT else 0


@cli.command()
@MACHINE_FILE
@ANY_DATA_FILES
@click.option("--no-device", is_flag=True, help="Do not open the machine's bus.")
@click.option("--json", "as_json", is_flag=True, help="Print only what DATA offers, as JSON.")
def check(file: Path, data: tuple[Path, ...], no_device: bool, as_json: bool) -> int:
    """Explain the machine file FILE, and listen for its signals.

    With DATA, recorded data in formats of 'otolith replay', it opens no bus: it shows rate, jitter, gaps and repeats
    of each signal, which windows can be used, and which parameters they are expected to determine.

    \b
    Examples:
      otolith check config/dc-motor.toml
      otolith check --no-device config/dc-motor.toml
      otolith check my-machine.toml monday.csv
    """
    from otolith.cli.commissioning.check import check_data, check_machine

    if data:
        return 0 if check_data(file, data, as_json=as_json) else 1
    if as_json:
        raise click.UsageError("--json needs DATA: it prints what recorded data offer")
    return 0 if check_machine(file, echo, with_device=not no_device) else 1


@cli.command()
@click.argument("path", metavar="PATH", callback=_replayed)
@click.argument("data", metavar="DATA...", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--json", "as_json", is_flag=True, help="Print each report as a line of JSON instead of a summary.")
@click.option("--recording", type=FILE, callback=_new_recording, help="Record into this file, as the daemon does.")
@click.option("--report", "page", type=FILE, callback=_new_page, metavar="FILE",
              help="Write this new HTML page, as 'otolith report' does.")  # fmt: skip
@click.option("--history", "folder", type=click.Path(path_type=Path, file_okay=False), metavar="DIR",
              help="Keep the history of the reports in this folder.")  # fmt: skip
@click.option("--state", type=click.Path(path_type=Path, file_okay=False, exists=True), metavar="DIR",
              help="Use the decisions of this state directory, as a copy of that of another computer.")  # fmt: skip
@click.option("--real-time", is_flag=True, help="Wait for the end of each window, as in operation.")
@click.option("--timing", is_flag=True, help="Add computing times, which differ from run to run.")
@click.option("--output", type=click.Path(path_type=Path, file_okay=False), metavar="DIR",
              help="Replay by several processes, and leave reports and checkpoints in this folder.")  # fmt: skip
@click.option("--jobs", type=click.IntRange(1), metavar="NUMBER",
              help="With --output: processes; as many as processors without it.")  # fmt: skip
@click.option("--format", "kind", type=click.Choice(("jsonl", "parquet")), help="With --output.  [default: jsonl]")
@click.option("--scheduler", metavar="ADDRESS", help="With --output: compute on the cluster of this Dask scheduler.")
@click.option("--ca", type=FILE, help="With --scheduler tls://...: certificate of its CA.")
@click.option("--certificate", type=FILE, help="Own certificate, signed by that CA.")
@click.option("--key", type=FILE, help="Private key of the certificate.")
def replay(
    path: Path,
    data: tuple[Path, ...],
    as_json: bool,
    recording: Path | None,
    page: Path | None,
    folder: Path | None,
    state: Path | None,
    real_time: bool,
    timing: bool,
    output: Path | None,
    jobs: int | None,
    kind: str | None,
    scheduler: str | None,
    ca: Path | None,
    certificate: Path | None,
    key: Path | None,
) -> int:
    """Run recorded DATA through the daemon for the machine in PATH.

    DATA is a table (CSV: a column 't' in seconds and one for each signal of the twin, in its unit or the one in
    brackets), a recording (.rrd) or a log of a CAN bus (of candump, SavvyCAN or python-can, .asc, .blf, .trc, .mf4).
    PATH is its machine file or its name. The file needs [driver] and [signals] only for a log of a bus: they describe
    its frames.
    Each of several files is a recording of its own: no window spans two. The logs of a machine with several sources are
    one recording: drive=monday.log,encoder=monday.csv.

    With --output, PATH may also be a directory of machine files, more machine files may follow it, and DATA may be
    directories: of several machines, each has the files in a folder of its name, and those that begin with its name.
    The same command continues a replay that was killed.

    \b
    Examples:
      otolith replay my-machine.toml monday.csv
      otolith replay my-machine.toml monday.csv tuesday.csv
      otolith replay my-machine.toml monday.blf --real-time
      otolith replay my-machine.toml monday.csv --json | jq .parameters.R_a.value
      otolith replay my-machine.toml monday.csv --recording monday.rrd
      otolith replay my-machine.toml monday.csv --report monday.html
      otolith replay /etc/otolith/hall recordings --output reports --jobs 8
    """
    machines = (path, *(item for item in data if item.suffix == ".toml"))
    data, stop = tuple(item for item in data if item.suffix != ".toml"), StopSignal()
    cluster = scheduler, ca, certificate, key
    if output is not None:
        if as_json or real_time or timing or any((recording, page, folder)):
            raise click.UsageError("--output goes with --state, --jobs, --format and --scheduler only")
        if scheduler is None and any(cluster):
            raise click.UsageError("--ca, --certificate and --key are for --scheduler")
        _replay_batch(machines, data, output, state, jobs, kind, cluster, stop)
        return stop.code()
    if jobs or kind or any(cluster):
        raise click.UsageError("--jobs, --format and --scheduler need --output")
    if len(machines) > 1 or any(item.is_dir() for item in (path, *data)):
        raise click.UsageError("several machines, and directories, need --output")
    if not data:
        raise click.UsageError("Missing argument 'DATA...'.")
    from otolith.cli.replay import replay

    run = partial(replay, path, data, recording, stopped=stop.received, ending=stop.ending)
    run(page=page, folder=folder, state=state, as_json=as_json, real_time=real_time, timing=timing)
    return stop.code()


@cli.command()
@click.argument("machine", metavar="[FILE|MACHINE]", default="*", callback=_watched)
@reader_options
@click.option("--json", "as_json", is_flag=True, help="Print each report as a line of JSON instead of a table.")
@click.option("--details", is_flag=True, help="Also candidates while a cause is not yet known, hints, what it costs.")
@click.option("--after", type=click.IntRange(0), metavar="NUMBER",
              help="With --json: begin after the report with this sequence number.")  # fmt: skip
def watch(
    connect: tuple[str, ...], credentials: "Credentials", machine: str, as_json: bool, details: bool, after: int | None
) -> int:
    """Show the live table of running daemons, over Zenoh.

    MACHINE is the name of one, with or without its site, FILE its machine file; without it, all are shown.
    With --json each report is printed once and in order, also those that were
    published while the connection was down.
    Each of the options to connect can also be set in the environment, such as OTOLITH_CA for --ca.

    \b
    Examples:
      otolith watch
      otolith watch press-3
      otolith watch --connect tls/press-3.local:7447 --ca ca.crt
      otolith watch --json | jq .parameters.R_a
      otolith watch press-3 --json --after 1790000000000
    """
    if after is not None and not as_json:
        raise click.UsageError("--after needs --json")
    from otolith.cli.operation.live_table import watch_reports
    from otolith.publishing.zenoh_config import Connection

    stop = StopSignal()
    connection = Connection(connect, credentials)
    watch_reports(connection, machine, as_json=as_json, details=details, after=after, stopped=stop.received)
    return stop.code()


@cli.command("compile")
@MACHINES
def compile_command(paths: tuple[Path, ...]) -> None:
    """Compile the twins of the machines in PATH.

    PATH is a machine file, the name of a machine, or a directory of machine files.
    The kernels go into the cache of this user. 'otolith run' compiles what is missing there, during which it reports
    nothing; so does 'otolith install' for the service.

    \b
    Examples:
      otolith compile config/dc-motor.toml
      otolith compile /etc/otolith/hall
    """
    from otolith import kernel_cache
    from otolith.adaptation.fingerprints import kernels_fingerprint
    from otolith.adaptation.state import initial_state
    from otolith.machine import load_machine
    from otolith.runtime.hall.files import files_in
    from otolith.runtime.worker import WARM_UP_KERNELS, warm_up
    from otolith_drivers.errors import ConfigurationError, ServiceError, counted
    from otolith_drivers.user_dirs import cache_directory

    machines, begun = [load_machine(file, with_driver=False) for file in files_in(paths)], time.monotonic()
    if not machines:
        raise ConfigurationError(f"{', '.join(map(str, paths))}: there is no machine file (*.toml)")
    folder, count, done = cache_directory("kernels"), 0, 0
    failures = []
    with progress_line(f"compiling {machines[0].twin.name}") as show:

        def observe(step: kernel_cache.CompileStep) -> None:
            nonlocal count, done
            count, done = count + step.compiled, done + (step.is_end and step.is_kernel)
            took = f"{time.monotonic() - begun:.0f} s"
            show(f"compiling {step.kernel}, {done} of {max(done, WARM_UP_KERNELS)} kernels done in {took}")

        for machine in {kernels_fingerprint(machine.problem): machine for machine in machines}.values():
            machine.try_fmu()
            identity, done = machine.file.machine, 0
            with kernel_cache.observed(observe):
                failure = warm_up(initial_state(identity.name, identity.site, machine.problem, machine.plan))
            if failure:
                failures.append(f"{machine.path}: twin {machine.twin.name!r} cannot be compiled or run: {failure}")
    if failures:
        raise ServiceError("\n".join(failures))
    if count:
        echo(f"compiled {counted(count, 'kernel')} in {time.monotonic() - begun:.0f} s: {folder}")
    else:
        echo(f"all kernels are there: {folder}")


@cli.command()
@click.argument("scenario", type=FILE)
@click.option("--as", "transports", type=click.Choice(TRANSPORTS), multiple=True, default=("can",),
              help="A node on the CAN bus, or a Modbus drive on its port or serial line; may be repeated.")  # fmt: skip
@click.option("--truth", type=FILE, help="Write the true parameters and states into this CSV file.")
@click.option("--summary", type=FILE, help="At the end, write counts of frames and requests into this JSON file.")
@click.option("--duration", type=click.FloatRange(0.1), default=math.inf, show_default=False, metavar="SECONDS",
              help="End after so many seconds.")  # fmt: skip
def plant(
    scenario: Path, transports: tuple[str, ...], truth: Path | None, summary: Path | None, duration: float
) -> int:
    """Simulate the machine of SCENARIO in real time, on its buses.

    \b
    Examples:
      otolith plant config/scenarios/demo.toml
      otolith plant config/scenarios/bus-dropouts.toml --as modbus-tcp
      otolith plant config/scenarios/two-buses.toml --as can --as modbus-tcp
    """
    from contextlib import ExitStack, closing

    from otolith_drivers.plant.realtime import TruthFile, open_node, run_nodes, write_summary
    from otolith_drivers.plant.scenario import load_scenario
    from otolith_drivers.user_dirs import check_writable

    loaded = load_scenario(scenario)
    if summary is not None:
        check_writable(summary.absolute().parent)
    stop = StopSignal()
    with ExitStack() as stack:
        truth_file = stack.enter_context(closing(TruthFile(truth))) if truth is not None else None
        nodes = {name: stack.enter_context(closing(open_node(name, loaded))) for name in dict.fromkeys(transports)}
        for node in nodes.values():
            echo(f"{node.title()}; Ctrl-C ends it", err=True)
        counts = run_nodes(nodes, loaded, truth_file, stop.received, duration)
    if summary is not None:
        write_summary(summary, loaded, counts)
    for name, node in nodes.items():
        echo(node.summary_line(counts[name]), err=True)
    return stop.code(clean=signal.SIGTERM)


@cli.command()
@click.option("--duration", type=click.FloatRange(8, 3600), default=90.0, help="Seconds.")
@click.option("--machine", type=FILE, help="Machine file.  [default: dc-motor.toml]")
@click.option("--scenario", type=FILE, help="What happens to the machine.  [default: scenarios/demo.toml]")
@click.option("--json", "as_json", is_flag=True, help="Print the verdict as JSON, and no table.")
def demo(duration: float, machine: Path | None, scenario: Path | None, as_json: bool) -> int:
    """Run plant and daemon, and compare estimates with the truth.

    \b
    Examples:
      otolith demo
      otolith demo --duration 30 --json
    """
    from otolith.cli.demo import Demo

    stop = StopSignal()
    examples = shipped_directory("config")
    files = (machine or examples / "dc-motor.toml", scenario or examples / "scenarios" / "demo.toml")
    code = Demo(*files, duration, as_json=as_json).run(stop.received)
    return stop.code() or code


COMMANDS: tuple[click.Command, ...] = (
    baseline,
    commission,
    components,
    config,
    drivers,
    event,
    explain,
    export,
    history,
    init,
    install,
    keys,
    noise,
    probe,
    report,
    reproduce,
    reset,
    schema,
    simulate,
    site,
    twin,
    view,
)
for command in COMMANDS:
    cli.add_command(command)
