"""The pages of thresholds name constants that exist, with their values, and tests that exist."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DRIVERS, DAEMON = ROOT / "drivers" / "otolith_drivers", ROOT / "daemon" / "otolith"
SOURCES = {
    "acquisition": [DAEMON / "acquisition"],
    "canbus": [DRIVERS / "canbus"],
    "cli": [
        DAEMON / "cli",
        *(DAEMON / "cli").glob("*/"),
        DAEMON / "cli" / "commissioning" / "draft",
        DAEMON / "health",
    ],
    "commissioning": [DAEMON / "commissioning"],
    "discovery": [DAEMON / "discovery"],
    "drivers": [DRIVERS, DRIVERS / "common", DRIVERS / "grammars"],
    "estimation": [DAEMON / "estimation"],
    "exchange": [DAEMON / "exchange"],
    "health": [DAEMON / "health", DAEMON / "adaptation"],
    "modbus": [DRIVERS / "modbus"],
    "mqtt": [DRIVERS],
    "opcua": [DRIVERS / "opcua"],
    "plant": [DRIVERS / "plant"],
    "replay": [DRIVERS / "replay", DRIVERS / "replay" / "table", DRIVERS / "replay" / "exports"],
    "runtime": [
        DAEMON / "runtime",
        *(DAEMON / "runtime").glob("*/"),
        DAEMON / "publishing",
        DAEMON / "publishing" / "commands",
        DAEMON,
    ],
    "site": [DAEMON / "site", *(DAEMON / "site").glob("*/")],
    "simulation": [DAEMON / "simulation"],
    "storage": [DAEMON / "storage"],
    "twin": [DAEMON / "twin", DAEMON / "fmu", DAEMON],
}
PAGES = sorted((ROOT / "docs" / "reference").glob("thresholds-*.md"))
CODE = re.compile(r"`([^`]+)`")
NUMBER = re.compile(r"-?\d[\d ]*(?:\.\d+)?(?:e-?\d+)?")


def rows(page: Path) -> list[list[str]]:
    """The cells of every row, without headers."""
    lines = [line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def constants(folders: list[Path]) -> set[str]:
    """Names that are assigned in modules and classes."""
    names: set[str] = set()
    for path in (path for folder in folders for path in folder.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            targets = node.targets if isinstance(node, ast.Assign) else []
            targets = [node.target] if isinstance(node, ast.AnnAssign) else targets
            names |= {item.id for target in targets for item in ast.walk(target) if isinstance(item, ast.Name)}
    return names


def test_every_package_has_a_page_of_thresholds() -> None:
    assert {page.stem.removeprefix("thresholds-") for page in PAGES} == set(SOURCES)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_threshold_exists(page: Path) -> None:
    known = constants(SOURCES[page.stem.removeprefix("thresholds-")])
    named = {name.rpartition(".")[2] for row in rows(page) for name in CODE.findall(row[0])}
    assert named
    assert {name for name in named if name.isupper() or "_" in name} <= known


def values(folders: list[Path]) -> dict[str, set[float | None]]:
    """The values of the constants of modules, by name; None stands for one that is not a plain number."""
    known: dict[str, set[float | None]] = {}
    for path in (path for folder in folders for path in folder.glob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.Assign):
                continue
            target, value = node.targets[0], node.value
            pairs = [(target, value)]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = list(zip(target.elts, value.elts, strict=True))
            for name, number in pairs:
                is_number = isinstance(number, ast.Constant) and isinstance(number.value, int | float)
                known.setdefault(ast.unparse(name), set()).add(float(ast.literal_eval(number)) if is_number else None)
    return known


def stated(cell: str) -> set[float]:
    """The numbers in a cell, also in a thousandth or a millionth of the unit of the code."""
    plain = {float(text.replace(" ", "")) for text in NUMBER.findall(cell)}
    plain |= {float(int(text, 0)) for text in re.findall(r"0[xo][0-9A-F]+", cell)}
    return {round(scale * number, 15) for number in plain for scale in (1.0, 1e-3, 1e-6)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_threshold_has_the_value_of_the_code(page: Path) -> None:
    known = values(SOURCES[page.stem.removeprefix("thresholds-")])
    named = [(name.rpartition(".")[2], row[1]) for row in rows(page) for name in CODE.findall(row[0])]
    wrong = {name: cell for name, cell in named if not known.get(name, {None}) & {None, *stated(cell)}}
    assert wrong == {}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_row_has_value_unit_origin_and_guard(page: Path) -> None:
    for row in rows(page):
        assert len(row) == 6, row
        assert all(row), row


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_guarding_test_exists(page: Path) -> None:
    files = {path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("*.py")}
    functions = set(
        re.findall(r"^def (test_\w+)", "\n".join((ROOT / name).read_text() for name in files), re.MULTILINE)
    )
    for row in rows(page):
        for name in CODE.findall(row[5]):
            if name.endswith(".py"):
                assert any(path.endswith(f"/{name.removeprefix('tests/')}") for path in files), name
            elif name.startswith("test_"):
                assert name.partition("[")[0] in functions, name
