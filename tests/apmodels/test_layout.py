"""What holds for the text of the packages: who imports whom, who knows which model, and how long a file is."""

import ast
import importlib
import pkgutil
from pathlib import Path

import pytest

import apmodels
from apmodels import Model

ROOT = Path(__file__).parents[2]
ALLOWED = {
    "apmodels": {"apmodels"},
    "inference": {"apmodels", "inference"},
    "controllers": {"apmodels", "inference", "controllers"},
    "hardware": {"apmodels", "hardware"},
    "experiments": {"apmodels", "inference", "controllers", "hardware", "experiments", "conf"},
}
PACKAGES = {*ALLOWED, "conf"}


def files(*packages):
    found = [path for package in packages for path in sorted((ROOT / package).rglob("*.py"))]
    assert found
    return pytest.mark.parametrize("path", found, ids=lambda path: str(path.relative_to(ROOT)))


def imports(text, package):
    """The project's packages that a file imports, wherever in it: ``import a.b``, ``from a import b``, by a name."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(package if node.level else node.module)
        elif isinstance(node, ast.Call) and "import" in ast.unparse(node.func):
            found |= {argument.value for argument in node.args if isinstance(getattr(argument, "value", None), str)}
    return {name.split(".")[0] for name in found} & PACKAGES


def names_in(text):
    """Every identifier, attribute and string of a file that could name a class."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.alias(name=name):
                found.add(name)
            case ast.Constant(value=str(words)):
                found |= set(words.replace(".", " ").split())
    return found


def models():
    for module in pkgutil.iter_modules(apmodels.__path__):
        importlib.import_module(f"apmodels.{module.name}")

    def below(cls):
        return {cls}.union(*(below(sub) for sub in cls.__subclasses__()))

    return {cls.__name__ for cls in below(Model) - {Model} if cls.__module__.split(".")[0] == "apmodels"}


@files(*ALLOWED)
def test_imports_run_one_way(path):
    package = path.relative_to(ROOT).parts[0]
    assert imports(path.read_text(), package) <= ALLOWED[package]


@files("inference", "controllers")
def test_engines_and_controllers_know_no_model(path):
    assert not names_in(path.read_text()) & models()


@files("apmodels", "inference", "controllers")
def test_no_core_file_is_long(path):
    assert len(path.read_text().splitlines()) <= 300


def test_these_tests_see_what_they_look_for():
    text = "import torch\ndef f():\n    from inference.exact import Exact\n    import hardware.body\n"
    assert imports(text, "apmodels") == {"inference", "hardware"}
    assert imports("from . import a\nimportlib.import_module('controllers.x')", "hardware") == {
        "hardware",
        "controllers",
    }
    assert {"VisualSearch", "DetectorSearch"} <= models()
    assert "VisualSearch" in names_in("from apmodels import VisualSearch") & names_in("x = 'a VisualSearch.'")
    assert "VisualSearch" in names_in("apmodels.VisualSearch()")
