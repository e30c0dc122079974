"""What the package imports is what it declares: a fresh environment has all that it needs."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def normal(name: str) -> str:
    """A distribution's name as PEP 503 normalises it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def declared() -> set[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [lines for name, lines in project["optional-dependencies"].items() if name != "dev"]
    lines = sum(extras, project["dependencies"])
    return {normal(re.split(r"[\[<>=!~; ]", line)[0]) for line in lines}


def imported(file: Path) -> set[str]:
    """Top-level modules that a file imports, those of its functions included, those for type checks left out."""
    found, tree = set(), ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {a.name.split(".")[0] for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
    return found - set(sys.stdlib_module_names) - {"ema_pipeline"}


@pytest.mark.parametrize("folder", ["ema_pipeline", "pipelines"])
def test_every_imported_package_is_declared(folder: str) -> None:
    known, owners = declared(), packages_distributions()
    missing = {
        f"{file.relative_to(ROOT)}: {module}"
        for file in (ROOT / folder).rglob("*.py")
        for module in imported(file)
        if not known & {normal(d) for d in owners.get(module, ())}
    }
    assert not missing


def test_every_dependency_is_explained() -> None:
    page = normal((ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8"))
    assert {d for d in declared() if d not in page} == set()
