"""Where execution starts: ``otolith`` and ``python -m otolith``."""

# Before anything else, by the C module, which needs no import of its own: Ctrl-C in start-up has nothing to clean
# up, so it ends the process at once, without a traceback. Commands take the signal over.
import _signal  # type: ignore[import-not-found]  # no stub: signal is the public face of it

_signal.signal(_signal.SIGINT, _signal.SIG_DFL)

import os  # noqa: E402
import sys  # noqa: E402

# Matrices here are small: threads of the linear algebra would only get into each other's way. Before NumPy is loaded.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

INTERRUPTED = 130  # as a shell reports a command that Ctrl-C ended


def main() -> None:
    """Run the command line; errors become one line each and an exit code, never a traceback."""
    import click  # noqa: PLC0415 - after the lines above

    from otolith.cli.common import NobodyReads  # noqa: PLC0415
    from otolith.cli.main import cli  # noqa: PLC0415
    from otolith_drivers.errors import OtolithError  # noqa: PLC0415

    try:
        code = cli.main(prog_name="otolith", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except OtolithError as error:
        for line in str(error).splitlines():
            click.echo(f"Error: {line}", err=True)
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = INTERRUPTED
    except NobodyReads:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except OSError as error:  # a disk that is full, a file that went away: nothing that a traceback would explain
        click.echo(f"Error: {error}", err=True)
        code = 2
    sys.exit(code or 0)


if __name__ == "__main__":
    main()
