"""The docs are true: every command is documented and has help with an example, every file they name is there."""

import re
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from otolith.cli.main import TRANSPORTS, cli
from otolith.cli.operation.history import report
from otolith.publishing.zenoh_session import TOPICS
from otolith_drivers.plant.realtime import NODES

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCS = sorted((ROOT / "docs").rglob("*.md"))
COMMANDS = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
REPORT = (ROOT / "docs" / "reference" / "report.md").read_text(encoding="utf-8")
HOMES = ("config", "systemd", "daemon", "drivers", "docs", "tests", "benchmarks", ".ci")
FILES = [f"/{path.name}" for path in ROOT.iterdir()]
FILES += [path.as_posix() for home in HOMES for path in (ROOT / home).rglob("*")]
PAGES = ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", *(page.relative_to(ROOT).as_posix() for page in DOCS)]


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_every_command_has_help_and_is_documented(name: str) -> None:
    result = CliRunner().invoke(cli, [name, "--help"])
    assert result.exit_code == 0
    assert re.search(r"Examples?:\n\s+otolith " + name, result.output)
    assert f"`otolith {name}" in COMMANDS


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_an_unknown_option_is_a_usage_error(name: str) -> None:
    with pytest.raises(click.exceptions.NoSuchOption):
        CliRunner().invoke(cli, [name, "--no-such"], standalone_mode=False, catch_exceptions=False)


@pytest.mark.parametrize("arguments", [("twin", "list"), ("--help",)], ids=" ".join)
def test_a_reader_that_has_seen_enough_is_no_error(arguments: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "otolith", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()  # before it has begun to write
        assert not process.stderr.read()
    assert process.returncode == 0


def test_the_plant_can_be_whatever_it_has_a_node_for() -> None:
    assert set(TRANSPORTS) == set(NODES)


def test_every_topic_is_documented() -> None:
    for topic in TOPICS:
        assert f"`otolith/<site>/<machine>/{topic.key.replace('*', '<name>')}`" in REPORT


@pytest.mark.parametrize("page", PAGES)
def test_every_file_a_page_names_is_there(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"`([\w./@-]+\.(?:py|toml|md|txt|service|conf|dbc))`", text))
    lost = {name for name in named if not any(path.endswith(f"/{name}") for path in FILES)}
    assert lost <= {"my-machine.toml"}


@pytest.mark.parametrize("page", [*PAGES, "CHANGELOG.md"])
def test_lines_are_at_most_120_wide(page: str) -> None:
    """Except tables and code."""
    text = re.sub(r"^ *```.*?^ *```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    prose = [line for line in text.splitlines() if not line.startswith(("|", "    "))]
    assert [line for line in prose if len(line) > 120] == []


def test_every_make_target_of_the_docs_exists() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for page in PAGES:
        for target in re.findall(r"`make ([\w-]+)`", (ROOT / page).read_text(encoding="utf-8")):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE)


def test_ci_calls_the_readmes_test_command() -> None:
    assert "    make test\n" in README
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("otolith.cli.main", {"numpy", "numba", "rerun", "pymoo", "pint", "can", "zenoh", "pydantic", "asyncio"}),
        ("otolith.adaptation.adapt", {"rerun", "pymoo", "sympy", "matplotlib", "asyncio"}),
        ("otolith.runtime.service", {"scipy", "numba", "rerun", "pymoo", "sympy", "matplotlib", "asyncio"}),
    ],
)
def test_nobody_loads_what_others_need(module: str, absent: set[str]) -> None:
    """Help is quick, and the daemon's main process stays small: compiler, optimiser and recorder live beside it."""
    program = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert not absent & set(loaded)


def test_no_path_of_a_developers_machine_is_in_the_tree() -> None:
    files = subprocess.run(
        ["/usr/bin/env", "git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\0")[:-1]
    for name in files:
        text = (ROOT / name).read_text(encoding="utf-8", errors="replace")
        assert not re.search(r"/(?:root|work|home/\w+)/", text), name


@pytest.mark.parametrize("page", PAGES)
def test_every_link_of_a_page_leads_to_a_file(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if not link.startswith("http")]
    assert [link for link in links if not (ROOT / page).parent.joinpath(link).exists()] == []


def test_no_text_tells_to_install_otolith_from_an_index() -> None:
    """It is in none."""
    sources = [path for folder in ("drivers", "daemon") for path in (ROOT / folder).rglob("*.py")]
    wrong = re.compile(r"pip install[^\n]* '?otolith(?:\[|'|$)")
    texts = {
        path: path.read_text(encoding="utf-8").splitlines() for path in (*(ROOT / page for page in PAGES), *sources)
    }
    found = [path for path, lines in texts.items() for line in lines if wrong.search(line) and "--no-index" not in line]
    assert found == []


def test_a_clone_is_at_most_five_commands_from_a_page_in_the_browser() -> None:
    first = README.partition("## Your machine")[0]
    commands = re.findall(r"^    ((?:make|\.venv/bin/otolith) .*)$", first, re.MULTILINE)
    assert commands[0] == "make demo"
    assert commands[-1].startswith(".venv/bin/otolith report dc-motor")
    assert len(commands) <= 5
    options = {option for row in report.params for option in row.opts}
    assert set(re.findall(r"--\w+", commands[-1])) <= options
