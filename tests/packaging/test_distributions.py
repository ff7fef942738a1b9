"""What the wheel and the sdist hold, and that the sdist is enough to install from on every supported Python."""

from __future__ import annotations

import subprocess
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from tests.helpers.sampling import sampled
from tests.packaging.conftest import Distributions
from tests.packaging.environments import Environment, interpreter
from touchcell.paths import CHECKOUT

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
DATA = (
    "touchcell/py.typed",
    "touchcell/drivers/kinematics/chains/ur5e.yaml",
    "touchcell/drivers/v4l2/shim.c",
    "touchcell/perception/models/sim_gdn.safetensors",
    "touchcell/simulation/tips/franka_tactip_1.yaml",
    *(f"touchcell/configs/{cell.name}" for cell in sorted((CHECKOUT / "configs").glob("*.yaml"))),
)
SOURCES = (
    "touchcell/control/interlocks/_distances.c",
    "touchcell/geometry/_se3c.c",
    "touchcell/geometry/_se3_kernels.h",
    "touchcell/geometry/_gaussian_kernels.h",
    "touchcell/perception/_kernelsc.c",
    "touchcell/perception/_image_kernels.h",
    "touchcell/perception/_matching_kernels.h",
    "touchcell/simulation/_paint.c",
    "setup.py",
    "LICENSE",
)


def _wheel(distributions: Distributions) -> zipfile.ZipFile:
    return zipfile.ZipFile(distributions.wheel)


def test_the_wheels_top_level_is_touchcell_alone(distributions: Distributions) -> None:
    with _wheel(distributions) as wheel:
        top = {name.split("/")[0] for name in wheel.namelist()}
    (metadata,) = (name for name in top if name.endswith(".dist-info"))
    assert top == {"touchcell", metadata}


@pytest.mark.parametrize("name", DATA)
def test_the_wheel_carries_the_file_itself(distributions: Distributions, name: str) -> None:
    with _wheel(distributions) as wheel:
        assert wheel.read(name) == (distributions.tree / name).read_bytes()


def test_the_wheel_carries_no_tests_and_no_benchmarks_of_the_checkout(distributions: Distributions) -> None:
    with _wheel(distributions) as wheel:
        names = wheel.namelist()
    assert not [name for name in names if "/test_" in name or name.startswith(("tests/", "benchmarks/"))]


def test_every_module_of_the_checkout_is_in_the_wheel(distributions: Distributions) -> None:
    tree = distributions.tree
    tracked = {str(path.relative_to(tree)) for path in (tree / "touchcell").rglob("*.py")}
    with _wheel(distributions) as wheel:
        assert tracked <= set(wheel.namelist())


def test_the_wheels_metadata_is_complete(distributions: Distributions) -> None:
    with _wheel(distributions) as wheel:
        (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = Parser().parsestr(wheel.read(name).decode())
    assert metadata["Author"] == "touchcell contributors"
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Keywords"]
    assert "Typing :: Typed" in metadata.get_all("Classifier", [])
    declared = {c.rpartition(" ")[2] for c in metadata.get_all("Classifier", []) if "Python :: 3." in c}
    assert declared == set(PYTHONS)


@pytest.mark.parametrize("name", [*DATA, *SOURCES])
def test_the_sdist_carries_the_file_and_not_a_link_to_it(distributions: Distributions, name: str) -> None:
    with tarfile.open(distributions.sdist) as sdist:
        root = sdist.getnames()[0].split("/")[0]
        member = sdist.getmember(f"{root}/{name}")
        assert member.isfile()
        file = sdist.extractfile(member)
        assert file is not None
        assert file.read() == (distributions.tree / name).read_bytes()


def test_the_build_warns_of_no_package_that_it_leaves_out(distributions: Distributions) -> None:
    assert "is absent from the `packages` configuration" not in distributions.log


@pytest.mark.parametrize("version", sampled(PYTHONS, 1))
def test_the_sdist_builds_and_checks_a_cell_on(version: str, distributions: Distributions, tmp_path: Path) -> None:
    python = interpreter(version)
    if python is None:
        pytest.skip(f"no Python {version} is installed here")
    environment = Environment.create(python, tmp_path)
    environment.install(distributions.sdist)
    assert "surface_follow_sim is valid" in environment.touchcell("check", "configs/surface_follow_sim.yaml")
    compiled = "import touchcell.geometry._se3c, touchcell.perception._kernelsc, touchcell.simulation._paint"
    environment.python("-c", compiled)


def test_no_stale_metadata_lies_in_the_checkout() -> None:
    """An egg-info folder there shadows the entry points of what is installed."""
    listed = subprocess.run(["git", "ls-files"], cwd=CHECKOUT, capture_output=True, text=True, check=False).stdout
    assert not [path.name for path in CHECKOUT.glob("*.egg-info")]
    assert ".egg-info" not in listed
