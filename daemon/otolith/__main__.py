"""Where execution starts: ``otolith`` and ``python -m otolith``."""

import os
import signal
import sys

INTERRUPTED = 130  # as a shell reports a command that Ctrl-C ended


def main() -> None:
    """Run the command line; errors become one line each and an exit code, never a traceback."""
    # Until a command takes the signal over, Ctrl-C has nothing to clean up: not even an import may print a traceback.
    signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    import click  # noqa: PLC0415 - only now is Ctrl-C safe

    from otolith.cli import cli  # noqa: PLC0415
    from otolith.errors import OtolithError  # noqa: PLC0415

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
    except BrokenPipeError:  # the reader of our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    sys.exit(code or 0)


if __name__ == "__main__":
    main()
