"""``touchcell new`` writes a package whose tests are red because it is not filled in, and green once it is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from touchcell.cell.cli.main import main
from touchcell.cell.cli.scaffold import REGISTRIES

REPOSITORY = Path(__file__).parents[3]

ARM_STATE = """
        now_ns = self._clock.now_ns()
        dt_s = (min(now_ns, self._until_ns) - self._t_ns) * 1e-9
        if dt_s > 0.0:
            turn = se3.exp(np.concatenate([np.zeros(3), self._twist[3:] * dt_s]))
            self._T[:3, :3] = turn[:3, :3] @ self._T[:3, :3]
            self._T[:3, 3] += self._twist[:3] * dt_s
        self._t_ns = now_ns
        if now_ns >= self._until_ns:
            self._twist = np.zeros(6)
        seq = now_ns // 10_000_000
        return Stamped(TcpState(self._T.copy(), self._twist.copy()), seq * 10_000_000, seq)
"""
FILLED = {
    "driver": {
        "open the connection": """
        self._T = se3.from_euler_mm_deg([0, 0, 300, 180, 0, 0])
        self._twist = np.zeros(6)
        self._t_ns = self._until_ns = self._clock.now_ns()
""",
        "energise": "pass",
        "return pose and twist": ARM_STATE,
        "measure whether it stands": "return not self._read_state().value.twist.any()",
        "send the twist": """
        self._read_state()
        self._twist = twist_base.copy()
        self._until_ns = now_ns + round(ttl_s * 1e9)
""",
        "begin to stop": """
        self._read_state()
        self._twist = np.zeros(6)
""",
    },
    "camera": {
        "open the camera": "self._start_ns = self._clock.now_ns() - 1_000_000_000",
        "return the newest frame": """
        seq = (self._clock.now_ns() - self._start_ns) * 30 // 1_000_000_000
        image = np.random.default_rng(seq).integers(0, 256, (480, 640), np.uint8)
        return Stamped(Frame(image), self._start_ns + seq * 1_000_000_000 // 30, seq)
""",
        "wait for a frame": """
        due_ns = self._start_ns + -(-(after_seq + 1) * 1_000_000_000 // 30)
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if due_ns > deadline_ns:
            self._clock.sleep_until_ns(deadline_ns)
            raise TransportTimeout(self.name, f"frame after {after_seq}", timeout_s)
        self._clock.sleep_until_ns(due_ns)
        return self._newest()
""",
    },
    "task": {
        "say when the task is done": "return observation.arms['arm'].value.T_base_tcp[2, 3] <= 0.19",
        "say how the arm moves": "return np.array([0, 0, -0.01, 0, 0, 0])",
    },
    "interlock": {
        "compare each arm": """
        for role, arm in view.arms.items():
            z_m = float(arm.state.value.T_base_tcp[2, 3])
            if z_m > self.limit_m:
                return Violation(self.name, self.severity, role, "too high", view.now_ns, z_m, self.limit_m, "m")
        return None
""",
    },
    "estimator": {
        "estimate T_s_f": "return PoseGaussian(np.eye(4), 1e-6 * np.eye(6)) if frame.image.mean() > 5.0 else None",
    },
}
IMPORTS = """from __future__ import annotations

import numpy as np
from touchcell.drivers.core.errors import TransportTimeout
from touchcell.geometry import se3
"""
FOUND = {
    "driver": "test_the_driver_is_found_by_its_name",
    "camera": "test_the_driver_is_found_by_its_name",
    "task": "test_the_task_is_found_by_its_name",
    "interlock": "test_the_interlock_is_found_by_its_name",
    "estimator": "test_the_estimator_is_found_by_its_name",
}


def install(package: Path) -> Path:
    """What pip leaves of an editable install: the metadata of the generated project file, beside its source."""
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    site = package.parent / "site"
    info = site / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    points = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(points))
    return site


def run_tests(package: Path, site: Path) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join(map(str, (package, site, REPOSITORY)))
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rA", "--tb=line", "tests"],
        cwd=package,
        env=os.environ | {"PYTHONPATH": paths, "COLUMNS": "250"},
        capture_output=True,
        text=True,
    )


def fill_in(source: Path, filled: dict[str, str]) -> None:
    text = source.read_text()
    for begins, code in filled.items():
        stub = re.compile(rf'raise NotImplementedError\(\s*"{re.escape(begins)}[^"]*"\s*\)')
        text, count = stub.subn(lambda _, code=code: code.strip(), text)
        assert count == 1, begins
    assert "NotImplementedError(" not in text
    source.write_text(
        text.replace("from __future__ import annotations\n", f"from __future__ import annotations\n{IMPORTS}")
    )


@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", sorted(REGISTRIES))
def test_a_new_package_is_red_until_it_is_filled_in(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = f"my_{kind}"
    assert main(["new", kind, name, "--out", str(tmp_path)]) == EXIT_OK
    package = tmp_path / name
    assert f"pip install -e {package}" in capsys.readouterr().out
    site = install(package)

    red = run_tests(package, site)
    assert red.returncode == 1, red.stdout + red.stderr
    assert f"PASSED tests/test_{name}.py::{FOUND[kind]}" in red.stdout
    failures = re.findall(r"^(?:FAILED|ERROR) (.*)$", red.stdout, re.MULTILINE)
    assert failures
    assert all("NotImplementedError: " in failure for failure in failures), "\n".join(failures)

    fill_in(package / f"{name}.py", FILLED[kind])
    if kind in ("driver", "camera"):
        # So that the suite takes as long as its arithmetic.
        test = package / "tests" / f"test_{name}.py"
        test.write_text(test.read_text().replace("MonotonicClock", "VirtualClock"))
    green = run_tests(package, site)
    assert green.returncode == 0, green.stdout + green.stderr
    assert "NotImplementedError" not in green.stdout


@pytest.mark.parametrize("kind", sorted(REGISTRIES))
def test_generated_code_is_clean(kind: str, tmp_path: Path) -> None:
    pytest.importorskip("ruff")
    main(["new", kind, "my_thing", "--out", str(tmp_path)])
    for command in (["check", "--select", "E,F,W,I,UP,B"], ["format", "--check"]):
        arguments = [*command, "--isolated", "--line-length", "120", "--target-version", "py311", "."]
        ran = subprocess.run(
            [sys.executable, "-m", "ruff", *arguments], cwd=tmp_path / "my_thing", capture_output=True, text=True
        )
        assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["driver", "My-Arm"], "is no name of a module"),
        (["driver", "class"], "is no name of a module"),
        (["driver", "sim_arm"], "the driver 'sim_arm' is installed already"),
        (["interlock", "tilt"], "the interlock 'tilt' is installed already"),
        (["task", "there"], "cannot be made: File exists"),
    ],
)
def test_a_name_that_cannot_be_is_refused(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there" / "tests").mkdir(parents=True)
    assert main(["new", *words]) == EXIT_BAD_INPUT
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("shipped", ["surface_mesh_sim.yaml", "steps_bench.yaml"])
def test_a_copied_cell_is_as_valid_as_the_one_that_ships(
    shipped: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new", "cell", "mine", "--from", shipped, "--out", str(tmp_path)]) == EXIT_OK
    assert (tmp_path / "mine.yaml").read_bytes() == (REPOSITORY / "configs" / shipped).read_bytes()
    assert f"touchcell check {tmp_path / 'mine.yaml'}" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "mine.yaml"), "--on", "sim"]) == EXIT_OK


def test_no_file_is_overwritten_by_a_new_cell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.yaml").write_text("mine")
    assert main(["new", "cell", "mine.yaml", "--out", str(tmp_path)]) == EXIT_BAD_INPUT
    assert (tmp_path / "mine.yaml").read_text() == "mine"
    assert "is there already" in capsys.readouterr().err


def test_a_cell_that_does_not_ship_is_named_with_the_likely_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new", "cell", "mine", "--from", "colect_sim", "--out", str(tmp_path)]) == EXIT_BAD_INPUT
    assert "did you mean 'collect_sim.yaml'?" in capsys.readouterr().err
    assert main(["new", "task", "mine", "--from", "collect_sim.yaml", "--out", str(tmp_path)]) == EXIT_BAD_INPUT
    assert list(tmp_path.iterdir()) == []
