"""Every public object says what it is, and every example in a docstring works as a reader would run it."""

import ast
import doctest
import importlib
import inspect
import os
import pkgutil
import re
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from conftest import ROOT

import harness

MODULES = [
    "harness",
    "harness.environments",
    "harness.episodes",
    "harness.export",
    "harness.fitting",
    "harness.gymnasium",
    "harness.importing",
    "harness.networks",
    "harness.policies",
    "harness.prediction",
    "harness.tasks",
    "harness.torch",
]
"""The modules for users. Each lists its public names."""

PACKAGES = ("torch", "mlflow", "tensorboard", "lerobot")
"""Packages that a test environment may lack. An example says `# needs NAME`."""


def module(name: str) -> ModuleType:
    """Imports a module, unless a package that it needs is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(str(error))


def public(module: ModuleType) -> Iterator[tuple[str, Any]]:
    """A module's public objects, and the methods and properties of its own classes."""
    for name in module.__all__:
        found = getattr(module, name)
        yield f"{module.__name__}.{name}", found
        if inspect.isclass(found):
            for member, value in vars(found).items():
                if not member.startswith("_") and (callable(value) or isinstance(value, property)):
                    yield f"{module.__name__}.{name}.{member}", value


@pytest.fixture(scope="module")
def reader(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the smoke experiment is done, beside the published results."""
    folder = tmp_path_factory.mktemp("reader")
    shutil.copytree(results, folder / "results")
    shutil.copytree(ROOT / "results/reference", folder / "results/reference")
    return folder


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_in_docstrings_work(name: str, reader: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(reader)
    tests = doctest.DocTestFinder().find(module(name), name, globs={"harness": harness})
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE | doctest.FAIL_FAST)
    for test in tests:
        needed = [package for package in PACKAGES if f"# needs {package}" in (test.docstring or "")]
        if all(importlib.util.find_spec(package) for package in needed):
            said: list[str] = []
            failed = runner.run(test, out=said.append).failed
            assert not failed, "".join(said)


@pytest.mark.parametrize("name", MODULES)
def test_everything_public_has_a_docstring_led_by_a_sentence(name: str) -> None:
    found = module(name)
    for place, item in [(name, found), *public(found)]:
        if place in ("harness.tasks.TASKS", "harness.export.FORMATS", "harness.policies.Policy"):
            continue
        text = inspect.getdoc(item)
        assert text, place
        first = text.split("\n\n")[0]
        assert first[0].isupper() or first[0] == "`", (place, first)
        assert first.endswith((".", ":")), (place, first)


def attributes(kind: type) -> set[str]:
    """The public attributes that a class of the package adds to those of its bases."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    assigned = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self"
    }
    declared = {name for name, value in vars(kind).items() if not callable(value) and not hasattr(value, "__get__")}
    inherited = {name for base in kind.__mro__[1:] for name in [*vars(base), *inspect.get_annotations(base)]}
    own = assigned | declared | set(inspect.get_annotations(kind))
    return {name for name in own - inherited if not name.startswith("_")}


@pytest.mark.parametrize("name", MODULES)
def test_the_docstring_of_a_class_describes_its_attributes(name: str) -> None:
    """`help` shows no other description of them."""
    found = module(name)
    for kind in (getattr(found, public) for public in found.__all__):
        # Compiled classes have properties instead, and the fields of named tuples have descriptions of their own.
        if inspect.isclass(kind) and kind not in vars(harness._harness).values() and not hasattr(kind, "_fields"):
            described = set(re.findall(r"^ +(\w+): ", inspect.getdoc(kind) or "", re.MULTILINE))
            assert attributes(kind) <= described, kind


def test_every_function_of_the_package_has_an_example() -> None:
    for name in harness.__all__:
        found = getattr(harness, name)
        if inspect.isfunction(found) or name in ("Dataset", "Model", "SimulationBatch"):
            assert ">>> " in (inspect.getdoc(found) or ""), name


def test_the_package_lists_only_public_names() -> None:
    names = [name for name in dir(harness) if not name.startswith("__")]
    assert names == sorted(harness.__all__)
    own = {name for name, value in vars(harness).items() if getattr(value, "__module__", None) == "harness"}
    assert {name for name in own if not name.startswith("_")} == set(harness.__all__)


def test_every_module_for_users_is_tested_here() -> None:
    internal = {"recorded"}
    found = {module.name for module in pkgutil.iter_modules(harness.__path__) if not module.name.startswith("_")}
    assert {f"harness.{name}" for name in found - internal} | {"harness"} == set(MODULES)
