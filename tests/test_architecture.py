"""Rules of the architecture, checked on the source: imports only go down, generic code names no world."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest

import envs
from experiments.__main__ import COMMANDS

ROOT = Path(__file__).parents[1]
FLOORS = ("envs", "mgpo_jax", "experiments")  # each may import itself and those before it
GENERIC = ("mgpo_jax", "experiments")
WORLD_FOLDERS = sorted(
    path.parent.name
    for path in (ROOT / "envs").glob("*/__init__.py")
    if path.parent.name != "drawing"
)
# Where a world may be named: the default of --env.
MAY_NAME = {"experiments.store.settings": {"maze15"}}
DEVICES = {"device_get", "device_put", "addressable_shards", "shard_map", "NamedSharding"}
STARTS_COMMANDS = "mgpo_jax.__main__"  # ``python -m mgpo_jax`` is the console script
MAY_MOVE = "mgpo_jax.sharding"
LONG, MAX_LONG = 60, 3  # lines of a long function, and how many of them there may be
COMMAND_LINES = 150


@cache
def sources() -> dict[str, ast.Module]:
    """The modules of the three packages by their dotted names."""
    found = {}
    for floor in FLOORS:
        for path in sorted((ROOT / floor).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            found[name] = ast.parse(path.read_text(), str(path))
    return found


def generic() -> Iterator[tuple[str, ast.Module]]:
    return ((name, tree) for name, tree in sources().items() if name.split(".")[0] in GENERIC)


def is_spec_name(node: ast.AST) -> bool:
    """``env.spec.name``, ``spec.name`` or ``world.name``."""
    if not (isinstance(node, ast.Attribute) and node.attr == "name"):
        return False
    owner = node.value
    return getattr(owner, "attr", getattr(owner, "id", "")) in ("spec", "world")


def texts(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Constants of text with their lines, but for docstrings and what follows ``help=``."""
    skipped = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg == "help":
            skipped.update(map(id, ast.walk(node.value)))
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in skipped
        ):
            yield node.lineno, node.value


def named_worlds(tree: ast.Module, module: str) -> Iterator[str]:
    """Names of worlds, and places in their folders, in constants of text."""
    allowed = MAY_NAME.get(module, set())
    name = re.compile(rf"(?<![\w-])({'|'.join(map(re.escape, envs.names()))})(?![\w-])")
    place = re.compile(rf"\benvs\.({'|'.join(WORLD_FOLDERS)})\b")
    for line, text in texts(tree):
        for found in set(name.findall(text)) - allowed:
            yield f"{module}:{line} names the world {found}"
        for found in place.findall(text):
            yield f"{module}:{line} names the place envs.{found}"


@cache
def world_classes() -> frozenset[str]:
    """The classes that the folders of worlds define."""
    return frozenset(
        node.name
        for module, tree in sources().items()
        if module.split(".")[:1] == ["envs"]
        and module.split(".")[1:2] in [[f] for f in WORLD_FOLDERS]
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    )


def identifiers(node: ast.AST) -> set[str]:
    return {
        getattr(part, "attr", getattr(part, "id", ""))
        for part in ast.walk(node)
        if isinstance(part, ast.Attribute | ast.Name)
    }


def asked_worlds(tree: ast.Module, module: str) -> Iterator[str]:
    """Questions which world it is, by its class or by its name."""
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        called = identifiers(node.func) if isinstance(node, ast.Call) else set()
        if isinstance(node, ast.Call) and called & {"isinstance", "issubclass"}:
            if found := identifiers(node.args[1]) & world_classes():
                yield f"{module}:{line} asks for the class {found.pop()}"
        elif isinstance(node, ast.Call) and called & {"get", "index", "startswith"}:
            if any(is_spec_name(part) for part in (*node.args, node.func, *called_on(node))):
                yield f"{module}:{line} looks up the name of a world"
        elif isinstance(node, ast.MatchClass):
            if found := identifiers(node.cls) & world_classes():
                yield f"{module}:{line} asks for the class {found.pop()}"
        elif isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            if any(is_spec_name(side) for side in sides):
                yield f"{module}:{line} compares the name of a world"
            if any("type" in identifiers(side) for side in sides) and any(
                identifiers(side) & world_classes() for side in sides
            ):
                yield f"{module}:{line} compares the class of a world"
        elif isinstance(node, ast.Subscript) and is_spec_name(node.slice):
            yield f"{module}:{line} looks up the name of a world"
        elif isinstance(node, ast.Match) and is_spec_name(node.subject):
            yield f"{module}:{line} compares the name of a world"


def called_on(node: ast.Call) -> list[ast.AST]:
    """What the method of a call belongs to."""
    return [node.func.value] if isinstance(node.func, ast.Attribute) else []


def imported(tree: ast.AST, module: str, is_package: bool = False) -> Iterator[tuple[int, str]]:
    """Everything imported in a tree, with its line: modules, or ``module.name`` for parts of them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".")
                parts = parts[: len(parts) - node.level + is_package]
                base = ".".join([*parts, base] if base else parts)
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and identifiers(node.func) & {
            "import_module",
            "__import__",
        }:
            yield from (
                (node.lineno, arg.value)
                for arg in node.args[:1]
                if isinstance(arg, ast.Constant) and isinstance(arg.value, str)
            )


def is_within(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


def wrong_imports(tree: ast.Module, module: str, is_package: bool = False) -> Iterator[str]:
    """Imports of a higher floor, and of a world by generic code, wherever they stand."""
    if module == STARTS_COMMANDS:
        return
    floor = module.split(".")[0]
    above = FLOORS[FLOORS.index(floor) + 1 :]
    worlds = [f"envs.{folder}" for folder in WORLD_FOLDERS] if floor in GENERIC else []
    for line, name in imported(tree, module, is_package):
        for forbidden in (*above, *worlds):
            if is_within(name, forbidden):
                yield f"{module}:{line} imports {forbidden}"


def at_module_level(tree: ast.Module) -> ast.Module:
    """What runs when the module is imported: no functions, and nothing for type checkers."""

    class Strip(ast.NodeTransformer):
        def visit_FunctionDef(self, node: ast.FunctionDef) -> None: ...

        def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> None: ...

        def visit_Lambda(self, node: ast.Lambda) -> ast.expr:
            return ast.copy_location(ast.Constant(None), node)

        def visit_If(self, node: ast.If) -> ast.AST:
            if "TYPE_CHECKING" in identifiers(node.test):
                return ast.copy_location(ast.Module(node.orelse, []), node)
            return self.generic_visit(node)

    return Strip().visit(ast.parse(ast.unparse(tree)))


def circles(modules: Mapping[str, ast.Module], packages: set[str]) -> list[list[str]]:
    """Circles of modules that import each other while they are imported."""
    graph: dict[str, set[str]] = {}
    for module, tree in modules.items():
        names = [n for _, n in imported(at_module_level(tree), module, module in packages)]
        # ``from package import part`` is of the part where that is a module.
        found = {name if name in modules else name.rpartition(".")[0] for name in names}
        graph[module] = found & modules.keys()
    done: set[str] = set()
    found_circles: list[list[str]] = []

    def visit(module: str, path: list[str]) -> None:
        if module in path:
            found_circles.append([*path[path.index(module) :], module])
        elif module not in done:
            for other in sorted(graph[module]):
                visit(other, [*path, module])
            done.add(module)

    for module in graph:
        visit(module, [])
    return found_circles


def package_names() -> set[str]:
    return {
        ".".join(path.parent.relative_to(ROOT).parts)
        for floor in FLOORS
        for path in (ROOT / floor).rglob("__init__.py")
    }


def long_functions(tree: ast.Module, module: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > LONG:
                yield f"{module}.{node.name} has {lines} lines"


def moved_arrays(tree: ast.Module, module: str) -> Iterator[str]:
    """Uses of what moves arrays between devices."""
    if module == MAY_MOVE:
        return
    for node in ast.walk(tree):
        names = {getattr(node, "attr", ""), getattr(node, "id", "")}
        names |= {node.name} if isinstance(node, ast.alias) else set()
        if found := names & DEVICES:
            yield f"{module}:{getattr(node, 'lineno', 0)} uses {found.pop()}"


def test_generic_code_names_no_world() -> None:
    assert set(WORLD_FOLDERS) >= {"gridworld", "kitchen", "maze"}
    assert [fault for name, tree in generic() for fault in named_worlds(tree, name)] == []


def test_generic_code_does_not_ask_which_world_it_has() -> None:
    assert {"MazeRunner", "GridWorld", "Kitchen"} <= world_classes()
    assert [fault for name, tree in generic() for fault in asked_worlds(tree, name)] == []


def test_imports_only_go_down() -> None:
    packages = package_names()
    faults = [
        fault
        for name, tree in sources().items()
        for fault in wrong_imports(tree, name, name in packages)
    ]
    assert faults == []


def test_no_imports_close_a_circle() -> None:
    assert circles(sources(), package_names()) == []


def test_functions_are_short() -> None:
    faults = [fault for name, tree in sources().items() for fault in long_functions(tree, name)]
    assert len(faults) <= MAX_LONG, faults


def test_every_name_is_defined() -> None:
    """jaxtyping's axes look like undefined names, for which ruff and mypy leave all of these out."""
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F821"]
    places = [ROOT / place for place in (*FLOORS, "tests", "examples")]
    done = subprocess.run(
        [*command, "--output-format", "json", *places], capture_output=True, text=True, check=False
    )
    undefined = [found["message"].split("`")[1] for found in json.loads(done.stdout)]
    assert [name for name in undefined if not re.fullmatch(r"[A-Z]|batch|lanes", name)] == []


def test_one_module_moves_arrays() -> None:
    assert [fault for name, tree in sources().items() for fault in moved_arrays(tree, name)] == []


def test_commands_are_short() -> None:
    for name in COMMANDS:
        path = ROOT / "experiments" / f"{name}.py"
        functions = {
            node.name
            for node in ast.parse(path.read_text()).body
            if isinstance(node, ast.FunctionDef)
        }
        assert {"main", "command"} <= functions, name
        assert len(path.read_text().splitlines()) < COMMAND_LINES, name


def test_no_command_imports_another() -> None:
    """What commands share is in the modules beside them."""
    commands = {f"experiments.{name}" for name in COMMANDS}
    faults = [
        f"{module}:{line} imports {name}"
        for module in sorted(commands)
        for line, name in imported(sources()[module], module, False)
        if any(is_within(name, other) for other in commands - {module})
    ]
    assert faults == []


WITHOUT_JAX = """
import contextlib, io, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("jax", "jaxlib", "flax", "optax", "matplotlib"):
            raise RuntimeError(f"{name} was imported")

sys.meta_path.insert(0, Refuse())
import importlib
for line in sys.argv[1:]:
    name, *words = line.split()
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            importlib.import_module(f"experiments.{name}").command(words)
        except SystemExit as stop:
            code = stop.code
    last = (err.getvalue().strip().splitlines() or [""])[0]
    print(code, "usage" in out.getvalue(), last, sep="|")
"""


def call_without_jax(lines: list[str]) -> list[str]:
    """Exit code, whether the usage was printed, and the first line of stderr, for each command line."""
    script = [sys.executable, "-c", WITHOUT_JAX, *lines]
    done = subprocess.run(script, check=False, cwd=ROOT, capture_output=True, text=True)
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_help_and_usage_errors_need_no_jax() -> None:
    wrong = {
        "adapt --nonsense 1": "",
        "adapt --episodes 0": "--episodes must be at least 1",
        "adapt --method ubc": "unknown method 'ubc'; did you mean 'ucb'?",
        "adapt --method bpe --c 2": "--c is not a setting of bpe",
        "adapt --env maze51": "did you mean 'maze15'?",
        "pretrain --env maze51": "did you mean 'maze15'?",
        "pretrain --preset papr": "did you mean 'paper'?",
        "bench --env maze51": "did you mean 'maze15'?",
        "evaluate": "no result folder given",
        "check": "no result folder given",
        "plot": "no result folder given",
        "report": "no result folder given",
        "report result --out report.txt": "must end in .html",
        "playground --env maze51": "did you mean 'maze15'?",
        "table": "no result folder given",
        "reproduce tabel5": "did you mean 'table5'?",
        "release nowhere": "nowhere has no finished policy",
    }
    helps = [f"{name} --help" for name in COMMANDS]
    found = call_without_jax([*helps, *wrong])
    assert found[: len(helps)] == ["0|True|"] * len(helps)
    for call, line in zip(wrong, found[len(helps) :], strict=True):
        assert line.startswith("2|"), (call, line)
        assert wrong[call] in line, (call, line)


def faults_in(source: str, module: str = "mgpo_jax.new") -> list[str]:
    """What all rules but those of whole packages say of a module."""
    tree = ast.parse(source)
    rules = (named_worlds, asked_worlds, wrong_imports, long_functions, moved_arrays)
    return [fault for rule in rules for fault in rule(tree, module)]


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("DEFAULT = 'maze15'", "names the world maze15"),
        ("if name == 'kitchen-mjx': pass", "names the world kitchen-mjx"),
        ("text = f'of gridworld, {number}'", "names the world gridworld"),
        ("text = f'{maze30} {x:kitchen}'", "names the world kitchen"),
        ("TABLE = {'maze30': 1}", "names the world maze30"),
        ("arg(aliases=('kitchen',), help='of maze15')", "names the world kitchen"),
        ("PLACE = 'envs.maze.pictures:draw'", "names the place envs.maze"),
        ("isinstance(env, MazeRunner)", "asks for the class MazeRunner"),
        ("isinstance(env, (int, env_module.GridWorld))", "asks for the class GridWorld"),
        ("issubclass(type(env), Kitchen)", "asks for the class Kitchen"),
        ("type(env) is MazeRunner", "compares the class of a world"),
        ("match env:\n  case Kitchen(): pass", "asks for the class Kitchen"),
        ("x = env.spec.name == other", "compares the name"),
        ("x = spec.name in TABLE", "compares the name"),
        ("x = TABLE[env.spec.name]", "looks up the name"),
        ("x = TABLE.get(world.name, 3)", "looks up the name"),
        ("x = env.spec.name.startswith(prefix)", "looks up the name"),
        ("match env.spec.name:\n  case other: pass", "compares the name"),
        ("import envs.kitchen.env", "imports envs.kitchen"),
        ("from envs import gridworld", "imports envs.gridworld"),
        ("from envs.maze import MAZE15", "imports envs.maze"),
        ("def f():\n  from envs.maze.env import MazeRunner", "imports envs.maze"),
        ("importlib.import_module('envs.maze')", "imports envs.maze"),
        ("from experiments.store import settings", "imports experiments"),
        ("def f():\n  import experiments.adapt", "imports experiments"),
        ("from ..experiments import adapt", "imports experiments"),
        ("def f():\n" + "  x = 1\n" * 60, "new.f has 61 lines"),
        ("jax.device_get(x)", "uses device_get"),
        ("from jax import device_put", "uses device_put"),
        ("x.addressable_shards[0]", "uses addressable_shards"),
    ],
)
def test_faults_are_found(source: str, says: str) -> None:
    assert any(says in fault for fault in faults_in(source)), faults_in(source)


@pytest.mark.parametrize(
    "source",
    [
        "'''Of maze15 and kitchen.'''\nX: int = 1\n'''As in gridworld.'''",
        "arg(help='such as maze15')",
        "text = 'a kitchenette, my-maze15, mazes'",
        "isinstance(env, Environment)",
        "print(env.spec.name, f'{env.spec.name}')",
        "x = method.name == other.name",
        "from envs.base import Environment",
        "def f():\n" + "  x = 1\n" * 59,
    ],
)
def test_what_is_allowed_is_no_fault(source: str) -> None:
    assert faults_in(source) == []


@pytest.mark.parametrize("source", ["import mgpo_jax.runner", "from experiments import adapt"])
def test_worlds_import_nothing_above_them(source: str) -> None:
    assert faults_in(f"def f():\n  {source}", "envs.maze.env")
    assert not faults_in("from envs.maze.env import MazeRunner", "envs.maze.pictures")


def test_only_the_default_may_name_a_world() -> None:
    assert faults_in("DEFAULT_WORLD = 'maze15'", "experiments.store.settings") == []
    assert faults_in("DEFAULT_WORLD = 'maze30'", "experiments.store.settings") != []


@pytest.mark.parametrize(
    ("modules", "closed"),
    [
        ({"a": "import b", "b": "import a"}, True),
        ({"a": "from b import x", "b": "import c", "c": "from a import y"}, True),
        ({"a": "try:\n  import b\nexcept ImportError: pass", "b": "class C:\n  import a"}, True),
        ({"a": "from a.b import x", "a.b": "from a import x"}, True),
        ({"a": "from .b import x", "a.b": "from . import x"}, True),
        ({"a": "if x:\n  import b", "b": "if x: pass\nelse:\n  import a"}, True),
        ({"a": "import b", "b": "def f():\n  import a"}, False),
        ({"a": "import b", "b": "if TYPE_CHECKING:\n  import a"}, False),
        ({"a": "from a.b import x", "a.b": "from a import c", "a.c": ""}, False),
        ({"a": "import b, c", "b": "import c", "c": ""}, False),
    ],
)
def test_circles_are_found(modules: dict[str, str], closed: bool) -> None:
    trees = {name: ast.parse(source) for name, source in modules.items()}
    assert bool(circles(trees, {"a"})) == closed
