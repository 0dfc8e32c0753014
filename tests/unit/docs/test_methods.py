"""The pages of docs/methods and the code name the same equations, and nothing refers to a text that nobody has."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "wm_nodes" / "wm_nodes"
BENCHMARKS = ROOT / "wm_nodes" / "benchmarks"
METHODS = ROOT / "wm_nodes" / "docs" / "methods"
PAGES = {"RS": "roboscape_r.md", "DD": "dyndiff_grpo.md", "RA": "reward_agent.md"}
MOST_WORDS = 5000

CODE = ("wm_nodes/wm_nodes", "wm_nodes/benchmarks", "tests", "msgs_schema", "launch_scripts", "ros2_ws/src")
CODE_SUFFIXES = {".py", ".yaml", ".yml", ".toml", ".msg", ".srv", ".action", ".js"}

NUMBER = re.compile(r"\b(RS|DD|RA)-(\d+)([a-z]?)\b")
RANGE = re.compile(r"\b(RS|DD|RA)-(\d+)[a-z]? to (?:\1-)(\d+)[a-z]?\b")
HEADING = re.compile(r"^### ((?:RS|DD|RA)-\d+[a-z]?) (.+)$", re.MULTILINE)
FUNCTION = re.compile(r"`([a-z_0-9.]+):([A-Za-z_0-9.]+)`")
FORBIDDEN = {
    "a specification": re.compile(r"\bspecifications?\b", re.IGNORECASE),
    "an issue by its number": re.compile(r"\bissues? #?\d", re.IGNORECASE),
    "a finding by its number": re.compile(r"\bfinding \d"),
    "an equation by another number": re.compile(r"\beq(?:uation|uations|s)?\b\.? ?\(?E?\d", re.IGNORECASE),
    "an equation by its bare number": re.compile(r"(?<![\w\])}.'])\((?:1?[1-9]|10|20)[a-d]?\)"),
    "an equation by another number, E1 to E10d": re.compile(r"\bE(?:[1-9]|10[a-d]?)\b"),
    "a section by its number": re.compile(r"\bsections? \d", re.IGNORECASE),
    "[inferred]": re.compile(r"\[inferred\]", re.IGNORECASE),
}
CODE_ONLY = {"an equation by its bare number"}
SELF = Path(__file__).resolve()


@cache
def equations() -> dict[str, str]:
    """The text of each equation by its number."""
    found: dict[str, str] = {}
    for prefix, page in PAGES.items():
        text = (METHODS / page).read_text()
        headings = list(HEADING.finditer(text))
        for heading, after in zip(headings, [*headings[1:], None]):
            assert heading[1].startswith(prefix), f"{heading[1]} stands in {page}"
            assert heading[1] not in found, f"{heading[1]} is defined twice"
            found[heading[1]] = text[heading.end() : after.start() if after else len(text)]
    return found


def files(*folders: str, suffixes: set[str]) -> list[Path]:
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in suffixes)
    return sorted(path for path in paths if path.is_file() and path.resolve() != SELF)


def documents() -> list[Path]:
    return [*files("wm_nodes", "msgs_schema", "launch_scripts", "ros2_ws", suffixes={".md"}), ROOT / "README.md"]


def named(text: str) -> set[str]:
    """The equations that a text names, those inside of "RS-2 to RS-4" included."""
    inside = {
        number
        for prefix, first, last in (match.groups() for match in RANGE.finditer(text))
        for number in equations()
        if number.startswith(prefix) and int(first) <= _digits(number) <= int(last)
    }
    return {match[0] for match in NUMBER.finditer(text)} | inside


def _digits(number: str) -> int:
    return int(re.sub(r"\D", "", number))


def source_of(module: str) -> Path:
    folder = BENCHMARKS.parent if module.startswith("benchmarks.") else PACKAGE
    stem = folder.joinpath(*module.split("."))
    return stem / "__init__.py" if stem.is_dir() else stem.with_suffix(".py")


def defines(body: list[ast.stmt], names: list[str]) -> bool:
    """Whether a module or class body defines the function, class or constant `names`, outermost first."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and node.name == names[0]:
            return len(names) == 1 or defines(node.body, names[1:])
        targets: list[ast.expr] = []
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, ast.AnnAssign):
            targets = [node.target]
        if names in [[target.id] for target in targets if isinstance(target, ast.Name)]:
            return True
    return False


@pytest.mark.parametrize("page", PAGES.values())
def test_a_page_numbers_its_equations(page: str) -> None:
    assert len(HEADING.findall((METHODS / page).read_text())) >= 20


def test_the_pages_stay_short() -> None:
    words = sum(len((METHODS / page).read_text().split()) for page in PAGES.values())
    assert words <= MOST_WORDS


def test_every_number_in_the_code_and_in_the_documents_is_an_equation_of_a_page() -> None:
    unknown = [
        f"{path.relative_to(ROOT)}: {number}"
        for path in [*files(*CODE, suffixes=CODE_SUFFIXES), *documents()]
        for number in sorted(named(path.read_text()) - equations().keys())
    ]
    assert not unknown


def test_every_equation_names_functions_that_exist() -> None:
    wrong = []
    for number, text in equations().items():
        found = FUNCTION.findall(text)
        if not found:
            wrong.append(f"{number} names no function")
        for module, name in found:
            path = source_of(module)
            if not path.is_file() or not defines(ast.parse(path.read_text()).body, name.split(".")):
                wrong.append(f"{number}: {module}:{name} does not exist")
    assert not wrong


def test_every_named_module_names_the_equation_too() -> None:
    wrong = [
        f"{module} does not name {number}"
        for number, text in equations().items()
        for module in sorted({module for module, _ in FUNCTION.findall(text)})
        if number not in named(source_of(module).read_text())
    ]
    assert not wrong


@pytest.mark.parametrize("what", FORBIDDEN)
def test_nothing_refers_to(what: str) -> None:
    """Papers are cited by their titles, equations by the numbers of docs/methods."""
    texts = [*files(*CODE, suffixes=CODE_SUFFIXES), *([] if what in CODE_ONLY else documents())]
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text.strip()}"
        for path in texts
        for line, text in enumerate(path.read_text().splitlines(), 1)
        if FORBIDDEN[what].search(text)
    ]
    assert not found
