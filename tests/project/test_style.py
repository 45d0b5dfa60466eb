"""The project's English and the shape of its calls, read from the syntax tree."""

import ast
import gc
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("mrbokeh", "capture", "training", "viewfinder", "datasets_scripts")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
FIRST_WORDS_THAT_SAY_NOTHING = {"Of", "Where", "As", "By", "Those", "That", "What"}
MOST_POSITIONAL, MOST_PARAMETERS, MOST_OF_KERNELS = 4, 12, 10
COMMANDS = re.compile(r"^(main|\w+_command)$|\.(command|callback)\b")


@cache
def nodes() -> list[tuple[Path, ast.AST]]:
    """Return modules, statements and calls of all files, of nearly a million nodes: through these Python need not look for waste, now and
    after each test."""
    gc.disable()
    try:
        trees = ((path, ast.parse(path.read_text(encoding="utf-8"))) for path in FILES)
        found = [(path, node) for path, tree in trees for node in ast.walk(tree) if isinstance(node, (ast.mod, ast.stmt, ast.Call))]
        gc.freeze()
    finally:
        gc.enable()
    return found


def functions() -> Iterator[tuple[Path, ast.FunctionDef | ast.AsyncFunctionDef]]:
    yield from ((path, node) for path, node in nodes() if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def place(path: Path, node: ast.AST, what: str) -> str:
    return f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)} {what}"


def test_docstrings_begin_with_a_verb_or_a_noun() -> None:
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    firsts = ((path, node, (ast.get_docstring(node) or "").split()[:1]) for path, node in nodes() if isinstance(node, documented))
    assert not [place(path, node, first[0]) for path, node, first in firsts if set(first) & FIRST_WORDS_THAT_SAY_NOTHING]


def test_constructors_with_many_arguments_are_called_by_keyword() -> None:
    """Compiled kernels are left out: numba's named tuples are built in place there. `Table` is rich's, which lists its columns."""
    classes = {node.name for _, node in nodes() if isinstance(node, ast.ClassDef)} - {"Table"}
    calls = ((path, node) for path, node in nodes() if isinstance(node, ast.Call) and not path.stem.endswith("_numba"))
    named = ((path, node, node.func.id) for path, node in calls if isinstance(node.func, ast.Name))
    assert not [place(path, node, name) for path, node, name in named if name in classes and len(node.args) > MOST_POSITIONAL]


def test_functions_take_few_parameters() -> None:
    """Commands declare their options as parameters, and Triton's kernels take no tuples."""
    wrong = []
    for path, node in functions():
        by = " ".join(ast.unparse(each) for each in node.decorator_list)
        count = len([*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs])
        if "triton" not in by and not COMMANDS.search(by) and not COMMANDS.search(node.name):
            wrong += [place(path, node, node.name)] if count > (MOST_OF_KERNELS if "njit" in by else MOST_PARAMETERS) else []
    assert not wrong


PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]


def test_pages_name_files_and_modules_that_exist() -> None:
    """Paths in backquotes, with suffix or without: `mrbokeh/images/color.py`, `capture/merging/lights`. Dotted names, such as
    mrbokeh.layering.motion or `python -m tests.bench.bench_real`; the last word may be a name in the module."""
    packages, missing = "|".join((*PACKAGES, "tests")), list[str]()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        paths = re.findall(rf"`((?:{packages})/[\w/.]+)`", text)
        missing += [f"{page.name}: {each}" for each in paths if not (ROOT / each).exists() and not (ROOT / f"{each}.py").exists()]
        dotted = set(re.findall(rf"(?<![\w/.\[-])(?:{packages})(?:\.[A-Za-z_]\w*)+\b(?!<|_)", text))
        missing += [f"{page.name}: {each}" for each in dotted if not is_module(each) and not is_module(each.rpartition(".")[0])]
    assert not missing


def test_lists_of_packages_name_modules_that_exist() -> None:
    """Lines such as "lights, retouch   what they do" in the docstring of an `__init__.py` name modules or folders beside it."""
    missing = list[str]()
    for path in (path for path in FILES if path.name == "__init__.py"):
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        listed = re.findall(r"^ *([a-z][a-z0-9_./]*(?:, [a-z][a-z0-9_./]*)*)  +\S", text, re.MULTILINE)
        names = [name.strip("/").replace(".", "/") for line in listed for name in line.split(", ")]
        beside = [(path.parent / name, path.parent / f"{name}.py", path.parent / f"_{name}.py") for name in names]
        missing += [f"{path}: {each[0].name}" for each in beside if not any(file.exists() for file in each)]
    assert not missing


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or path.is_dir()
