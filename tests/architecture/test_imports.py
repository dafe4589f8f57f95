"""The house's one sentence, as a test: the runner knows no physics, the physics no hardware."""

import ast
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).parents[2]


def imported(package: str) -> set[str]:
    """Every module that a package's files import, written out."""
    found = set()
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module)
    return found


def test_the_loop_imports_no_physics():
    forbidden = ("holocal.optics", "holocal.hologram", "holocal.estimate")
    assert not [name for name in imported("holocal/loop") if name.startswith(forbidden)]


def test_holocal_imports_neither_rigs_nor_procedures():
    assert not [name for name in imported("holocal") if name.split(".")[0] in ("rigs", "procedures")]


def test_rigs_and_procedures_do_not_know_each_other_and_rigs_share_nothing_with_the_engine():
    assert not [name for name in imported("procedures") if name.split(".")[0] == "rigs"]
    forbidden = ("holocal.hologram", "holocal.estimate", "procedures")
    assert not [name for name in imported("rigs") if name.startswith(forbidden)]


def test_the_three_packages_come_from_one_distribution_and_their_tops_hold_no_code():
    for package in ("rigs", "procedures"):
        assert set(packages_distributions().get(package, ["holocal"])) == {"holocal"}
        assert (ROOT / package / "__init__.py").read_text() == ""


def test_no_file_is_over_400_lines():
    long = {
        str(path.relative_to(ROOT)): lines
        for package in ("holocal", "procedures", "rigs")
        for path in (ROOT / package).rglob("*.py")
        if (lines := len(path.read_text().splitlines())) > 400
    }
    assert not long
