"""A package outside the tree adds one of each kind by one file and one entry point, and its mistakes are like ours."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.tactile_samples import write_split
from touchcell.cell.recording.mcap import read
from touchcell.paths import CHECKOUT
from touchcell.perception.errors import ModelError
from touchcell.perception.runtime.estimators import load_estimator

ACME = Path(__file__).parent / "acme"

MISTAKES = {
    "arm: key": (
        "payload_kg: 1.5",
        "paylod_kg: 1.5",
        "arms.arm.paylod_kg: unknown key (did you mean 'payload_kg'?)",
    ),
    "arm: wrong type": (
        "payload_kg: 1.5",
        "payload_kg: heavy",
        "arms.arm.payload_kg: must be a valid number, not 'heavy'",
    ),
    "arm: name": (
        "driver: acme_arm",
        "driver: acme_amr",
        "arms.arm.driver: unknown driver 'acme_amr' (did you mean 'acme_arm'?)",
    ),
    "camera: name": (
        "driver: acme_camera",
        "driver: acme_camra",
        "sensors.sensor.driver: unknown driver 'acme_camra' (did you mean 'acme_camera'?)",
    ),
    "camera: key": (
        "driver: acme_camera",
        "driver: acme_camera\n    gray: 3",
        "sensors.sensor.gray: unknown key (did you mean 'grey'?)",
    ),
    "device: key": (
        "stiffness_n_mm: 2",
        "stifness_n_mm: 2",
        "devices.wrist.stifness_n_mm: unknown key (did you mean 'stiffness_n_mm'?)",
    ),
    "device: mount": (
        "acme_scale\n    mounted_on: arm",
        "acme_scale\n    mounted_on: am",
        "devices.wrist.mounted_on: there is no arm 'am' (did you mean 'arm'?)",
    ),
    "device: lacks a protocol": (
        "driver: acme_scale\n    mounted_on: arm\n    stiffness_n_mm: 2\n    free_height_mm: 20",
        "driver: acme_camera\n    mounted_on: arm",
        "devices.wrist.driver: acme_camera does not provide ReadingSource, SettingSink, which acme_press needs",
    ),
    "device: an arm": (
        "driver: acme_scale",
        "driver: sim_arm",
        "devices.wrist.driver: sim_arm drives an arm (list it under `arms:`)",
    ),
    "device: role": (
        "{scale: wrist}",
        "{scale: wirst}",
        "task.devices.scale: the role 'scale' needs one of `devices:`, and 'wirst' is not there "
        "(did you mean 'wrist'?)",
    ),
    "task: key": (
        "force_n: 4",
        "forse_n: 4",
        "task.forse_n: unknown key (did you mean 'force_n'?)",
    ),
    "task: name": (
        "name: acme_press",
        "name: acme_pres",
        "task.name: unknown task 'acme_pres' (did you mean 'acme_press'?)",
    ),
    "interlock: kind": (
        "kind: acme_force",
        "kind: acme_forse",
        "interlocks.force.kind: unknown interlock 'acme_forse' (did you mean 'acme_force'?)",
    ),
    "interlock: key": (
        "device: scale",
        "devise: scale",
        "interlocks.force.devise: unknown key (did you mean 'device'?)",
    ),
    "interlock: type": (
        "limit_n: 5",
        "limit_n: five",
        "interlocks.force.limit_n: must be a valid number, not 'five'",
    ),
    "interlock: missing": (
        "  readings: {kind: reading_age, limit_ms: 50}\n",
        "",
        "interlocks: no interlock of kind 'reading_age' that stops",
    ),
    "estimator: kind": (
        "kind: acme_shifted",
        "kind: acme_shfted",
        "sensors.sensor.estimator.kind: unknown estimator 'acme_shfted' (did you mean 'acme_shifted'?)",
    ),
    "estimator: key": (
        "shift_mm: 0.1",
        "shft_mm: 0.1",
        "sensors.sensor.estimator.shft_mm: unknown key (did you mean 'shift_mm'?)",
    ),
    "filter: model": (
        "model: acme_average",
        "model: acme_averge",
        "sensors.sensor.estimator.filter.model: unknown filter 'acme_averge' (did you mean 'acme_average'?)",
    ),
    "filter: key": (
        "share: 0.5",
        "shre: 0.5",
        "sensors.sensor.estimator.filter.shre: unknown key (did you mean 'share'?)",
    ),
    "filter: range": (
        "share: 0.5",
        "share: 1.5",
        "sensors.sensor.estimator.filter.share: must be less than or equal to 1, not 1.5",
    ),
    "surface: kind": (
        "kind: acme_slope",
        "kind: acme_slop",
        "scene.surfaces.slope.kind: unknown surface 'acme_slop' (did you mean 'acme_slope'?)",
    ),
    "surface: key": (
        "rise_deg: 5",
        "rise_dg: 5",
        "scene.surfaces.slope.rise_dg: unknown key (did you mean 'rise_deg'?)",
    ),
}
"""What is changed in the cell file, and what is reported."""

SPECS = {
    "drivers": ("arms.arm.driver", "DriverSpec", "driver: acme_arm", "driver: {name}"),
    "tasks": ("task.name", "TaskSpec", "name: acme_press", "name: {name}"),
    "interlocks": ("interlocks.force.kind", "InterlockSpec", "kind: acme_force", "kind: {name}"),
    "estimators": ("sensors.sensor.estimator.kind", "EstimatorSpec", "kind: acme_shifted", "kind: {name}"),
    "filters": ("sensors.sensor.estimator.filter.model", "FilterSpec", "model: acme_average", "model: {name}"),
    "surfaces": ("scene.surfaces.slope.kind", "SurfaceSpec", "kind: acme_slope", "kind: {name}"),
}
"""By group: the key that names a plug-in, the type of its spec, and how the cell file is changed to name another."""

CHECK = """
import json, sys
from touchcell.cell.config.schema import plan_cell
from touchcell.errors import ConfigError
found = []
for path in sys.argv[1:]:
    try:
        plan_cell(path)
        found.append("")
    except ConfigError as error:
        found.append(str(error))
print(json.dumps(found))
"""

PREDICT = """
import sys
from pathlib import Path
sys.modules["torch"] = None
import numpy as np
from touchcell.cell.cli.main import main
import touchcell as tc
from touchcell.drivers.replay.dataset import read_split
data, out = sys.argv[1:]
arguments = ["train", "--kind", "acme_linear", "--set", "side_px=20", "--data", data, "--out", out]
assert main(arguments) == 0
estimator, split = tc.load_estimator(out), read_split(Path(data), "val")
predicted = np.stack([estimator.predict(image).pose_mm_deg for image in split.read()])
errors, labels = np.abs(predicted - split.contact_mm_deg)[:, :2], split.contact_mm_deg[:, :2]
print(type(estimator).__name__, *errors.mean(axis=0), *labels.std(axis=0))
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which the package, and a broken one, have been installed from their sources."""
    folder = tmp_path_factory.mktemp("plugins")
    broken = folder / "broken"
    (broken / "broken").mkdir(parents=True)
    (broken / "broken" / "__init__.py").write_text("SPEC = 'no spec'\n")
    points = "".join(
        f'[project.entry-points."touchcell.{group}"]\nbroken = "broken:SPEC"\nmissing = "broken.nowhere:SPEC"\n'
        for group in (*SPECS, "architectures", "trainers")
    )
    head = '[build-system]\nrequires = ["setuptools"]\nbuild-backend = "setuptools.build_meta"\n'
    (broken / "pyproject.toml").write_text(
        f'{head}[project]\nname = "broken"\nversion = "0.1"\n{points}[tool.setuptools]\npackages = ["broken"]\n'
    )
    shutil.copytree(ACME, folder / "acme")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    target = ["--target", str(folder / "site"), "--disable-pip-version-check"]
    subprocess.run([*install, *target, str(folder / "acme"), str(broken)], check=True, cwd=folder)
    return folder / "site"


def python(site: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *sys.path])}
    return subprocess.run(
        [sys.executable, *map(str, arguments)], env=environment, cwd=site, capture_output=True, text=True, check=False
    )


def messages(site: Path, files: Sequence[Path]) -> list[str]:
    done = python(site, "-c", CHECK, *files)
    assert done.returncode == 0, done.stderr
    found: list[str] = json.loads(done.stdout)
    return found


def test_the_package_has_one_module_and_one_entry_point_for_each(site: Path) -> None:
    modules = {path.stem for path in (site / "acme").glob("*.py")} - {"__init__"}
    points = re.findall(r'"acme\.(\w+):SPEC"', (ACME / "pyproject.toml").read_text())
    assert sorted(points) == sorted(modules)
    assert not list(site.glob("touchcell*"))


def test_a_cell_of_foreign_parts_is_checked_and_run(site: Path, tmp_path: Path) -> None:
    cell = ACME / "cell.yaml"
    done = python(site, "-m", "touchcell", "check", cell)
    assert done.returncode == 0, done.stderr
    for line in ("arm: acme_arm", "sensor: acme_camera", "wrist: acme_scale"):
        assert line in done.stdout
    (proof,) = [line.split("  ") for line in done.stdout.splitlines() if "acme_force" in line]
    assert [cell.strip() for cell in proof if cell][:5] == ["force", "acme_force", "scale", "5 N", "pressed too hard"]
    done = python(site, "-m", "touchcell", "run", cell, "--out", tmp_path / "run", "--quiet")
    assert done.returncode == 0, done.stdout + done.stderr
    recorded: dict[str, list[Any]] = {}
    for message in read(tmp_path / "run" / "run.mcap"):
        recorded.setdefault(message.topic, []).append(message.data)
    force_n = [each["force_n"] for each in recorded["/devices/scale/reading"]]
    assert force_n[0] == 0.0
    assert 4.0 <= max(force_n) < 5.0
    assert recorded["/devices/scale/setting"] == [{"zero_n": 0.0}]
    assert len(recorded["/sensors/sensor/contact"]) > 10


def test_a_foreign_interlock_trips_on_a_foreign_device(site: Path, tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text((ACME / "cell.yaml").read_text().replace("limit_n: 5", "limit_n: 2"))
    done = python(site, "-m", "touchcell", "run", cell, "--out", tmp_path / "run", "--quiet")
    assert done.returncode == 3, done.stdout + done.stderr
    assert "force: scale: force is 2." in done.stdout + done.stderr


def test_mistakes_in_their_sections_are_reported_like_ours(site: Path, tmp_path: Path) -> None:
    text = (ACME / "cell.yaml").read_text()
    files = []
    for number, (old, new, _) in enumerate(MISTAKES.values()):
        assert old in text
        files.append(tmp_path / f"{number}.yaml")
        files[-1].write_text(text.replace(old, new, 1))
    for (title, (_, _, wanted)), file, found in zip(MISTAKES.items(), files, messages(site, files), strict=True):
        lines = [line for line in found.splitlines() if wanted in line]
        assert lines, f"{title}: {found}"
        assert re.match(re.escape(str(file)) + r":\d+: ", lines[0]), title


def test_a_broken_plugin_is_reported_with_file_line_distribution_and_remedy(site: Path, tmp_path: Path) -> None:
    text = (ACME / "cell.yaml").read_text()
    files = []
    for group, (_, _, old, new) in SPECS.items():
        for name in ("broken", "missing"):
            assert old in text
            files.append(tmp_path / f"{group}_{name}.yaml")
            files[-1].write_text(text.replace(old, new.format(name=name), 1))
    found = iter(messages(site, files))
    for group, (key, spec, _, _) in SPECS.items():
        broken, missing = next(found), next(found)
        at = rf"{re.escape(str(tmp_path / group))}_\w+\.yaml:\d+: {re.escape(key)}: entry point "
        assert re.search(at + rf"broken = 'broken:SPEC' of broken 0\.1 leads to a str, not to a {spec}", broken), broken
        assert re.search(at + r"missing = 'broken\.nowhere:SPEC' of broken 0\.1 cannot be imported", missing), missing
        assert f"point it at the {spec}" in broken
        assert "repair or uninstall broken 0.1" in missing


def test_the_list_shows_them_and_names_what_is_broken(site: Path) -> None:
    done = python(site, "-m", "touchcell", "list")
    assert done.returncode == 0, done.stderr
    for summary in ("arm of another package", "no force on a device exceeds a limit", "a plane that rises along x"):
        assert summary in done.stdout
    assert "of broken 0.1 cannot be imported" in done.stdout


def test_a_foreign_trainer_writes_a_model_that_the_foreign_architecture_predicts_with(
    site: Path, tmp_path: Path
) -> None:
    write_split(tmp_path, "train", n=150, seed=1)
    write_split(tmp_path, "val", n=40, seed=2)
    done = python(site, "-c", PREDICT, tmp_path, tmp_path / "m.safetensors")
    assert done.returncode == 0, done.stderr
    name, *figures = done.stdout.split()
    error_x, error_y, spread_x, spread_y = map(float, figures)
    assert name == "Linear"
    assert error_x < 0.5 * spread_x
    assert error_y < 0.5 * spread_y


def test_foreign_trainers_and_architectures_are_described_and_their_mistakes_reported(
    site: Path, tmp_path: Path
) -> None:
    done = python(site, "-m", "touchcell", "describe", "trainer", "acme_linear")
    assert "side_px" in done.stdout
    assert "side of the square image that the model sees" in done.stdout
    done = python(site, "-m", "touchcell", "describe", "architecture", "acme_linear")
    assert "input_size" in done.stdout
    train = ("-m", "touchcell", "train", "--data", tmp_path, "--out", tmp_path / "m.safetensors", "--kind")
    done = python(site, *train, "acme_liner")
    assert (done.returncode, "did you mean 'acme_linear'?" in done.stderr) == (2, True), done.stderr
    done = python(site, *train, "acme_linear", "--set", "sid_px=8")
    assert done.returncode != 0
    assert "kind acme_linear has no setting sid_px (did you mean 'side_px'?)" in done.stderr
    done = python(site, *train, "acme_linear", "--set", "side_px=0")
    assert "side_px 0: Input should be greater than 0" in done.stderr
    done = python(site, *train, "broken")
    assert "entry point broken = 'broken:SPEC' of broken 0.1 leads to a str, not to a TrainerSpec" in done.stderr


def test_a_model_file_whose_architecture_is_not_installed_names_it(site: Path, tmp_path: Path) -> None:
    write_split(tmp_path, "train", n=150, seed=1)
    file = tmp_path / "m.safetensors"
    done = python(site, "-m", "touchcell", "train", "--kind", "acme_linear", "--data", tmp_path, "--out", file)
    assert done.returncode == 0, done.stderr
    with pytest.raises(ModelError, match="unknown architecture 'acme_linear'") as caught:
        load_estimator(file)
    assert caught.value.key == "architecture.kind"


def test_the_page_shows_the_package_as_it_is() -> None:
    page = (CHECKOUT / "docs" / "how-to" / "plugins.md").read_text()
    blocks = re.findall(r"^```(\w+)\n(.*?)^```$", page, re.M | re.S)
    assert {language for language, _ in blocks} == {"python", "toml", "yaml"}
    for language, block in blocks:
        if language == "python":
            first, _, rest = block.partition("\n")
            assert (ACME / first.removeprefix("# ")).read_text() == rest
        else:
            file = ACME / ("pyproject.toml" if language == "toml" else "cell.yaml")
            assert block in file.read_text()
