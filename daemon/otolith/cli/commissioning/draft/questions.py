"""Questions of ``otolith init``: each has a proposal, which is the answer where nobody is asked."""

from collections.abc import Callable

import click

from otolith.cli.terminal import echo
from otolith_drivers.errors import ConfigurationError, OtolithError


class Questions:
    """Asks at the terminal, or takes every proposal."""

    def __init__(self, *, asks: bool) -> None:
        self.asks = asks

    def text(self, question: str, proposed: str, check: Callable[[str], str]) -> str:
        """Return what ``check`` makes of the answer; asks again while it raises ValueError or OtolithError.

        The proposal may be text from outside, so that the escape of the terminal prints it.

        Raises:
            OtolithError: nobody is asked, and ``check`` refuses the proposal.
        """
        while self.asks:
            echo(f"{question}  [{proposed}]" if proposed else question)
            try:
                return check(click.prompt(">", default=proposed, show_default=False, prompt_suffix=" "))
            except click.Abort:  # Ctrl-C, or the end of standard input
                echo("", "nothing is written", err=True)
                raise
            except (ValueError, OtolithError) as error:
                echo(f"! {error}")
        try:
            return check(proposed)
        except ValueError as error:
            raise ConfigurationError(f"{question}: {error}") from error

    def choice(self, question: str, options: list[str]) -> str | None:
        """Return one of ``options``; None where nobody is asked."""
        if not self.asks:
            return None
        return str(click.prompt(question, type=click.Choice(options)))
