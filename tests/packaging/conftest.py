"""One source distribution and one wheel per session; everything here builds or installs, so it is slow."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.packaging.environments import Environment, run, tracked_tree

_HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.is_relative_to(_HERE) and "distributions" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
            item.add_marker(pytest.mark.timeout(1800))


@dataclass(frozen=True)
class Distributions:
    tree: Path
    sdist: Path
    wheel: Path
    log: str


@pytest.fixture(scope="session")
def package_index(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Skip where pip reaches no package index, as without a network."""
    asked = subprocess.run(
        [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--retries", "0", "wheel"],
        cwd=tmp_path_factory.mktemp("index"),
        capture_output=True,
        text=True,
        check=False,
    )
    if asked.returncode:
        pytest.skip(f"pip cannot download here: {asked.stderr.strip().splitlines()[-1]}")


@pytest.fixture(scope="session")
def distributions(package_index: None, tmp_path_factory: pytest.TempPathFactory) -> Distributions:
    """What a release consists of: the sdist of the tracked tree, and the wheel built from that sdist."""
    pytest.importorskip("build", reason="the build front end is not installed (extra `dev`)")
    root = tmp_path_factory.mktemp("release")
    tree = tracked_tree(root / "tree")
    log = run(sys.executable, "-m", "build", "--outdir", root / "dist", tree, cwd=root).stdout
    (sdist,) = (root / "dist").glob("*.tar.gz")
    (wheel,) = (root / "dist").glob("*.whl")
    return Distributions(tree, sdist, wheel, log)


@pytest.fixture(scope="session")
def installed(distributions: Distributions, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """The wheel with its dependencies in an environment of its own, beside pytest."""
    environment = Environment.create(Path(sys.executable), tmp_path_factory.mktemp("installed"))
    environment.install(distributions.wheel, "pytest")
    return environment
