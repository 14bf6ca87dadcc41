"""``otolith compile``: the kernels of a machine's twin, before the daemon needs them."""

import time
from pathlib import Path

import click

from otolith.cli.common import MACHINE_FILE, progress_line


@click.command("compile")
@MACHINE_FILE
def compile_command(file: Path) -> None:
    """Compile the twin of the machine in FILE before it is needed.

    The kernels go into the cache of this user. 'otolith run' compiles what is missing there, during which it reports
    nothing; so does 'otolith install' for the service.

    \b
    Example:
      otolith compile config/dc-motor.toml
    """
    from otolith import kernel_cache
    from otolith.adaptation.state import initial_state
    from otolith.machine import load_machine
    from otolith.runtime.worker import warm_up
    from otolith_drivers.errors import ServiceError, counted
    from otolith_drivers.user_dirs import cache_directory

    machine, begun = load_machine(file, with_driver=False), time.monotonic()
    folder, count = cache_directory("kernels"), 0
    with progress_line(f"compiling {machine.twin.name}") as show:

        def observe(step: kernel_cache.CompileStep) -> None:
            nonlocal count
            count += step.compiled
            show(f"compiling {step.kernel}, {counted(count, 'kernel')} done in {time.monotonic() - begun:.0f} s")

        identity = machine.file.machine
        with kernel_cache.observed(observe):
            failure = warm_up(initial_state(identity.name, identity.site, machine.problem, machine.plan))
    if failure:
        raise ServiceError(f"{file}: twin {machine.twin.name!r} cannot be compiled or run: {failure}")
    if count:
        click.echo(f"compiled {counted(count, 'kernel')} in {time.monotonic() - begun:.0f} s: {folder}")
    else:
        click.echo(f"all kernels are there: {folder}")
