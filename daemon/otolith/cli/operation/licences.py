"""``otolith licences``: the packages of this installation, and what their licences require to be passed on."""

import re
import sysconfig
from collections.abc import Iterator
from importlib.metadata import Distribution, distributions
from pathlib import Path

import click

NOTICE = re.compile(r"licen[cs]e|copying|notice|authors", re.IGNORECASE)
CLASSIFIER = "License :: "


@click.command()
@click.option("--texts", is_flag=True, help="Also print their licences and notices.")
def licences(texts: bool) -> None:
    """List the installed packages with their licences.

    Who passes Otolith on with them, as on a PC beside a machine, passes their
    licences and notices on as well.

    \b
    Examples:
      otolith licences
      otolith licences --texts > THIRD-PARTY-NOTICES.txt
    """
    installed = distributions(path=[sysconfig.get_path("purelib")])
    packages = {package.metadata["Name"].lower(): package for package in installed}
    width = max(len(f"{name} {package.version}") for name, package in packages.items())
    for name, package in sorted(packages.items()):
        click.echo(f"{f'{name} {package.version}':<{width}}  {_licence(package)}")
        for path in _notices(package) if texts else ():
            click.echo(f"\n--- {path.name}\n\n{path.read_text(encoding='utf-8', errors='replace').rstrip()}\n")


def _licence(package: Distribution) -> str:
    """Return the licence as the package states it: an expression, a name, or the classifiers."""
    get_all = package.metadata.get_all
    stated = str((get_all("License-Expression") or get_all("License") or [""])[0]).strip()
    if not stated or "\n" in stated or len(stated) > 80:  # some give the whole text
        rows = get_all("Classifier") or []
        named = [row.removeprefix(CLASSIFIER).split(" :: ")[-1] for row in rows if row.startswith(CLASSIFIER)]
        stated = ", ".join(named) or stated.partition("\n")[0]
    return stated or "not stated: see its files"


def _notices(package: Distribution) -> Iterator[Path]:
    for file in package.files or ():
        path = Path(str(package.locate_file(file)))
        if NOTICE.search(file.name) and path.suffix not in {".py", ".pyc", ".so"} and path.is_file():
            yield path
