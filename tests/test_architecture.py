"""The house stands as the architecture page draws it."""

import ast
import functools
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from polcap import errors

ROOT = Path(__file__).parents[1]


def test_layers_and_strangers() -> None:
    pytest.importorskip("importlinter")
    done = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stdout


def test_the_page_draws_the_layers_that_are_held() -> None:
    held = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"][0]
    page = (ROOT / "docs" / "explanations" / "architecture.md").read_text(encoding="utf-8")
    drawn: list[list[str]] = []
    for line in page.partition("## Who may import whom")[2].split("```")[1].strip("\n").splitlines():
        names = re.findall(r"\w+", line.strip().partition("   ")[0])
        drawn += [] if line.startswith(" ") else [[]]  # a layer may take two lines
        drawn[-1] += names
    assert drawn == [layer.split(" | ") for layer in held["layers"]]


MODULES = {  # dotted name → file
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted((ROOT / "polcap").rglob("*.py"))
}


@functools.cache
def tree(name: str) -> ast.Module:
    """The syntax tree of a module."""
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


def imported(name: str) -> set[str]:
    """The house's modules that one of them names, wherever in the file."""
    found = set()
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            deeper = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= (deeper & MODULES.keys()) or {node.module}
    return (found & MODULES.keys()) - {name}


@functools.cache
def uses() -> dict[str, set[str]]:
    """What each module imports."""
    return {name: imported(name) for name in MODULES}


UNIX_ONLY = {"fcntl", "resource", "termios", "tty", "pty", "pwd", "grp"}


@pytest.mark.parametrize("name", MODULES)
def test_a_module_loads_where_there_is_no_unix(name: str) -> None:
    """What Windows lacks is imported where it is used, and only there."""
    top = tree(name).body
    named = {alias.name for node in top if isinstance(node, ast.Import) for alias in node.names}
    named |= {node.module for node in top if isinstance(node, ast.ImportFrom) and node.module}
    assert not named & UNIX_ONLY


def test_the_path_is_imported_without_unix_modules() -> None:
    rooms = "polcap.cli, polcap.api, polcap.pipeline.check, polcap.batch, polcap.synth.shooting"
    code = f"import sys; sys.modules.update(dict.fromkeys({sorted(UNIX_ONLY)})); import {rooms}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_imports_form_no_circle() -> None:
    """Also those inside functions; a package and its own modules count as one another's house, not as a circle."""
    left = {name: {used for used in named if not name.startswith(f"{used}.")} for name, named in uses().items()}
    while free := [name for name, named in left.items() if not named & left.keys()]:
        for name in free:
            del left[name]
    assert left == {}


def test_what_one_room_uses_stands_in_that_room() -> None:
    """A module of optics is used by two rooms or more; rooms are stages, and the folders beside them."""
    single = {}
    for module in (name for name in MODULES if re.fullmatch(r"polcap\.optics\.\w+", name)):
        rooms = {_room(name) for name, named in uses().items() if module in named and _room(name) != "polcap.optics"}
        inside = any(module in named for name, named in uses().items() if _room(name) == "polcap.optics")
        if len(rooms) < 2 and not inside:
            single[module] = rooms
    assert single == {}


def _room(name: str) -> str:
    parts = name.split(".")
    return ".".join(parts[: 3 if parts[1:2] == ["stages"] else 2])


def test_a_files_name_is_unique_in_the_house() -> None:
    names = [file.name for file in MODULES.values() if file.name != "__init__.py"]
    assert sorted(names) == sorted(set(names))


def test_a_class_name_is_unique_in_the_house() -> None:
    homes: dict[str, list[str]] = {}
    for name in MODULES:
        for node in ast.walk(tree(name)):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(name)
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}


def test_a_stage_folder_has_at_most_seven_files() -> None:
    folders = {file.parent for name, file in MODULES.items() if name.startswith("polcap.stages.")}
    counts = {folder.name: len([*folder.glob("*.py")]) - 1 for folder in folders}
    assert {name: count for name, count in counts.items() if count > 7} == {}


MOST_LINES, MOST_PARAMETERS = 60, 7  # of a function, its docstring not counted
LARGE = {  # functions beyond that, and why
    "polcap.api.process": "the options of `polcap process`, by keyword",
    "polcap.api.export": "the options of `polcap export`, by keyword",
    "polcap.api.fuse": "the options of `polcap fuse`, by keyword",
    "polcap.formats.dng_writer.write": "the tags of a DNG, by keyword",
    "polcap.optics.shade.stokes": "geometry, material and light of each pixel; training calls it with tensors",
    "polcap.quality.gate_values.at_most": "the fields of a gate",
}


def test_functions_are_of_human_size() -> None:
    """Commands declare an option per parameter, so they are not counted."""
    large = {}
    for name in MODULES:
        for node in ast.walk(tree(name)):
            if not isinstance(node, ast.FunctionDef) or name.startswith("polcap.cli."):
                continue
            doc = ast.get_docstring(node, clean=False)
            lines = node.end_lineno - node.lineno + 1 - (doc.count("\n") + 1 if doc else 0)
            if lines > MOST_LINES or len(parameters(node)) > MOST_PARAMETERS:
                large[f"{name}.{node.name}"] = (lines, len(parameters(node)))
    assert large.keys() == LARGE.keys(), large


def test_the_architecture_page_lists_the_stages_in_their_order() -> None:
    from polcap.results import STAGES

    page = (ROOT / "docs" / "explanations" / "architecture.md").read_text(encoding="utf-8")
    listed = re.findall(r"^  (\w+) {2,}", page.partition("```")[2].partition("```")[0], re.M)
    assert tuple(listed) == STAGES


@pytest.mark.parametrize("page", [*sorted(ROOT.glob("docs/**/*.md")), ROOT / "README.md"], ids=lambda p: p.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


def test_constants_of_the_page_exist() -> None:
    page = (ROOT / "docs" / "explanations" / "constants.md").read_text(encoding="utf-8")
    for module, name in re.findall(r"`(\w+)\.(_?[A-Z]\w+)`", page):
        files = [*ROOT.glob(f"polcap/**/{module}.py"), *ROOT.glob(f"polcap/**/{module}/__init__.py")]
        found = any(re.search(rf"^(\w+, )*{name}\b", file.read_text("utf-8"), re.M) for file in files)
        assert found or module == "module", f"{module}.{name}"  # `module._NAME` stands for all of them


def test_benchmark_pages_are_short_enough_to_read() -> None:
    """Results of today; history is in the repository. A word has a letter or a digit, so marks of tables are none."""
    pages = {page.name: page.read_text(encoding="utf-8").split() for page in ROOT.glob("docs/benchmarks/*.md")}
    words = {name: sum(any(map(str.isalnum, word)) for word in text) for name, text in pages.items()}
    assert {name: count for name, count in words.items() if count > 1500} == {}
    assert sum(words.values()) <= 15_000


def test_one_licence() -> None:
    assert (
        "Apache License" in (ROOT / "LICENSE").read_text()
        and 'license = "Apache-2.0"' in (ROOT / "pyproject.toml").read_text()
    )


def test_reference_pages_are_the_generated_ones() -> None:
    from importlib.util import module_from_spec, spec_from_file_location

    from typer.main import get_command

    from polcap.cli import app

    spec = spec_from_file_location("make_reference", ROOT / "docs" / "make_reference.py")
    assert spec and spec.loader
    reference = module_from_spec(spec)
    spec.loader.exec_module(reference)
    stale = [page.name for page, text in reference.pages().items() if page.read_text(encoding="utf-8") != text]
    assert stale == [], "run `python docs/make_reference.py`"
    page = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    commands = get_command(app).commands  # type: ignore[attr-defined]
    assert sorted(re.findall(r"<!-- options of (\w+) -->", page)) == sorted(commands)
    assert all(f"## polcap {name}" in page for name in commands)


PUBLIC = re.compile(r"polcap\.((stages|optics|formats|quality)(\..*)?|api|config)")  # rooms that others call
ARRAY = re.compile(r"Floats|NDArray|Bools|Bits")
SHAPE = re.compile(r"\((\w+|…|\.\.\.),[^()]*\)|any shape")


def public(body: list[ast.stmt]) -> Iterator[ast.FunctionDef]:
    """Functions and methods of public classes; properties say it by name and type."""
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public(node.body)
        properties = [one for one in getattr(node, "decorator_list", []) if "property" in ast.unparse(one)]
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_") and not properties:
            yield node


def parameters(function: ast.FunctionDef) -> list[ast.arg]:
    every = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return [one for one in every if one.arg not in ("self", "cls")]


def explained(doc: str) -> list[str]:
    """The names in the section Parameters."""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[^\n]*\n-+$|\Z)", doc, re.S | re.M)
    lines = re.findall(r"^(\w[^\n]*)$", section[1], re.M) if section else []
    return [name for line in lines for name in re.split(r",\s*", line.partition(" :")[0])]


@pytest.mark.parametrize("name", [name for name in MODULES if PUBLIC.fullmatch(name)])
def test_docstrings_name_shapes_and_errors(name: str) -> None:
    """Arrays have shapes, our errors are named, and no parameter is explained that does not exist."""
    faults = []
    for function in public(tree(name).body):
        doc = ast.get_docstring(function) or ""
        where = f"{function.name} (line {function.lineno})"
        names = [one.arg for one in parameters(function)]
        gone = set(explained(doc)) - {*names, getattr(function.args.kwarg, "arg", None)}
        if gone:
            faults.append(f"{where}: Parameters explains {', '.join(sorted(gone))}, which it does not take")
        types = [ast.unparse(one.annotation) for one in parameters(function) if one.annotation]
        types.append(ast.unparse(function.returns) if function.returns else "")
        if any(ARRAY.search(one) for one in types) and not SHAPE.search(doc):
            faults.append(f"{where}: says no shape, as (H, W) or (N, 3), of its arrays")
        calls = [one.exc for one in ast.walk(function) if isinstance(one, ast.Raise)]
        raised = {ast.unparse(call.func).rpartition(".")[2] for call in calls if isinstance(call, ast.Call)}
        for error in sorted(raised):
            if hasattr(errors, error) and error not in doc:
                faults.append(f"{where}: does not say that it raises {error}")
    assert faults == []
