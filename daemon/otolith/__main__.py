"""Entry point of ``otolith`` and ``python -m otolith``."""

# First of all, and by the C module, which imports nothing itself: during start-up Ctrl-C ends the process at once,
# without a traceback. The commands install their own handlers later.
import _signal  # type: ignore[import-not-found]  # mypy has no stub for the C module

_signal.signal(_signal.SIGINT, _signal.SIG_DFL)

import codecs  # noqa: E402 - after the line above
import errno  # noqa: E402 - as above
import io  # noqa: E402 - as above
import logging  # noqa: E402 - as above
import os  # noqa: E402 - as above
import sys  # noqa: E402 - as above

# The matrices are small, so threads of the linear algebra cost more than they save. Set before NumPy is loaded.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


PLAIN = {"Ω": "ohm", "µ": "u", "·": "*", "²": "^2", "³": "^3", "°": "deg", "θ": "angle", "±": "+-", "−": "-"}
PLAIN |= dict(zip("▁▂▃▄▅▆▇█", "__..--^^", strict=True))  # curves
"""What stands for a symbol where the encoding of a terminal lacks it; for others a question mark."""


def written_plainly(error: UnicodeError) -> tuple[str, int]:
    """Handle the error of a codec: return what stands for the characters that it lacks, and where they end."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(PLAIN.get(character, "?") for character in error.object[error.start : error.end]), error.end


def main() -> None:
    """Run the command line and exit. An error is printed as one line per fault, never as a traceback."""
    import click  # noqa: PLC0415 - after the lines above

    from otolith.cli.common import INTERRUPTED  # noqa: PLC0415
    from otolith.cli.main import cli  # noqa: PLC0415
    from otolith.cli.terminal import LogFormatter, echo, echo_traceback  # noqa: PLC0415
    from otolith_drivers.errors import OtolithError  # noqa: PLC0415

    codecs.register_error("otolith", written_plainly)
    sys.excepthook = echo_traceback
    if logging.lastResort is not None:  # by which a command without a log prints warnings, also those of libraries
        logging.lastResort.setFormatter(LogFormatter())
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that has no 'Ω' gets 'ohm'
            stream.reconfigure(errors="otolith")
    try:
        code = cli.main(prog_name="otolith", standalone_mode=False)
    except click.ClickException as error:
        error.show(shown := io.StringIO())
        echo(*shown.getvalue().rstrip("\n").split("\n"), err=True)
        code = error.exit_code
    except OtolithError as error:
        echo(*(f"Error: {line}" for line in str(error).split("\n")), err=True)
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = INTERRUPTED
    except OSError as error:  # such as a full disk or a file that was removed: a traceback would explain nothing
        place = error.filename or "a file of this command, or its standard output"
        remedy = ": free space on its disk, then repeat the command" if error.errno == errno.ENOSPC else ""
        echo(f"Error: {place}: {error.strerror or error}{remedy}", err=True)
        code = 2
    sys.exit(code or 0)


if __name__ == "__main__":
    main()
