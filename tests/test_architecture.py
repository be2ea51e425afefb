"""The package's structure: no circle of imports, no private names of other modules, no dead paths.

That no import runs upwards is import-linter's business (`make lint`).
"""

import ast
import re
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src"


def name_of(path):
    return ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__")


FILES = {name_of(path): path for path in sorted((SOURCE / "lag_envs").rglob("*.py"))}
OTHERS = [path for folder in ("agents", "tools") for path in sorted((ROOT / folder).rglob("*.py"))]


@cache
def tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(node):
    """Return what a node imports from the package: modules, and names of them, with their local names."""
    if isinstance(node, ast.Import):
        found = [(alias.name, None, alias.asname) for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        found = []
        for alias in node.names:
            whole = f"{node.module}.{alias.name}"
            if whole in FILES:
                found.append((whole, None, alias.asname or alias.name))
            else:
                found.append((node.module, alias.name, alias.asname))
    else:
        return []
    return [each for each in found if each[0] in FILES]


def for_types_only(node):
    return isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"


#: Classes whose methods call functions of their package, which in turn take such an object. The modules of
#: these functions import the class for its type only.
TAKEN = {("lag_envs.scenes.base", "Scene"), ("lag_envs.tasks.base", "Task")}


def modules_of(path):
    """Return the modules that a file imports, inside functions and for types too."""
    for_types = {node for block in ast.walk(tree(path)) if for_types_only(block) for node in ast.walk(block)}
    return {
        found[0]
        for node in ast.walk(tree(path))
        for found in imported(node)
        if node not in for_types or found[:2] not in TAKEN
    }


def test_there_is_no_circle():
    # Importing a package is not a dependency on everything that it offers.
    packages = {name for name, path in FILES.items() if path.stem == "__init__"}
    graph = {name: modules_of(path) - {name} - packages for name, path in FILES.items()}
    TopologicalSorter({name: found for name, found in graph.items() if name not in packages}).prepare()


def test_private_names_stay_in_their_module():
    for path in [*FILES.values(), *OTHERS]:
        modules = {}
        for node in ast.walk(tree(path)):
            for module, name, local in imported(node):
                assert not is_private(name or ""), (path, module, name)
                if name is None and local:
                    modules[local] = module
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Attribute) and is_private(node.attr):
                owner = node.value.id if isinstance(node.value, ast.Name) else None
                assert owner not in modules, f"{path}:{node.lineno}: {modules[owner]}.{node.attr}"


def is_private(name):
    return name.startswith("_") and not name.startswith("__")


#: Private names of other libraries, which offer no other way, or expect a subclass to use them.
OTHERS_PRIVATE = {
    "_SubParsersAction", "_actions",  # argparse: the parsers of subcommands
    "_add_info",  # Gymnasium's VectorEnv
    "_assumptions_orig",  # SymPy's symbols
    "_exit",  # os
    "_get_indices", "_options", "_reset_options", "_reset_seeds", "_seeds",  # Stable-Baselines3's VecEnv
    "_getvalue",  # Numba's arrays
    "_mpf_",  # mpmath's numbers
    "_pool_manager",  # Pebble's pool
    "_version",  # PyTorch's tensors: how often they were changed in place
    "_asdict", "_fields", "_replace",  # named tuples: public, the underscore avoids names of fields
}  # fmt: skip


def package_of(path):
    """Return the layer that a file belongs to: a folder, or the file itself."""
    return path.relative_to(SOURCE / "lag_envs" if SOURCE in path.parents else ROOT).parts[0]


def defined(whole):
    """Return the attributes that a file defines: methods, fields, what is assigned to an object."""
    for node in ast.walk(whole):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Attribute | ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.attr if isinstance(node, ast.Attribute) else node.id
        elif isinstance(node, ast.Constant):  # of `object.__setattr__`
            yield node.value


def test_private_attributes_stay_in_their_file_and_those_of_self_in_their_package():
    """A class may use what a base class in the same package keeps for itself; nobody else may."""
    files = {path: set(defined(tree(path))) for path in [*FILES.values(), *OTHERS]}
    packages = {}
    for path, names in files.items():
        packages.setdefault(package_of(path), set()).update(names)
    for path, own in files.items():
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Attribute) and is_private(node.attr):
                inside = ast.unparse(node.value) in ("self", "cls", "super()")
                known = packages[package_of(path)] if inside else own
                assert node.attr in known | OTHERS_PRIVATE, f"{path}:{node.lineno}: {ast.unparse(node)}"


def test_the_architectures_page_names_what_exists():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    package = SOURCE / "lag_envs"
    named = re.findall(r"`([a-z_]+(?:/[a-z_.]+)*/?(?:\.(?:py|js|json|toml))?)`", text)
    paths = {name for name in named if "/" in name}
    assert len(paths) > 20
    for name in paths:
        places = [ROOT / name, SOURCE / name, package / name, ROOT / f"{name}.py", package / f"{name}.py"]
        assert any(place.exists() for place in places), name
    layers = re.search(r"\| layer \|.*?\n\n", text, re.DOTALL)[0]
    rows = " ".join(line.split("|")[1] for line in layers.strip().splitlines()[2:])
    stated = iter(re.findall(r"`(\w+)`", rows))
    linter = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    for layer in reversed(linter["contracts"][0]["layers"][1:]):  # without __main__
        rooms = layer.split(" | ")
        assert {next(stated) for _ in rooms} == set(rooms)
    assert list(stated) == ["agents", "tools"]
