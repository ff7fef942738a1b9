"""Whatever a cell file holds, it is read or refused by one message with file, line, key and remedy."""

from __future__ import annotations

import gzip
import os
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ConfigDict

from tests.fault_injection.fuzz_cells import try_mutants
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.yaml_file import InvalidCell, load
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

SHIPPED = (CONFIGS / "surface_follow_sim.yaml").read_text()


class Numbers(BaseModel):
    model_config = ConfigDict(extra="forbid")

    rate_hz: float = 1.0
    seed: int = 0
    go: bool = False
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    file: Path = Path()
    name: str = ""


def written(tmp_path: Path, content: str | bytes) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refused(path: Path) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        plan_cell(path)
    assert caught.value.file == str(path)
    return caught.value


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (bytes(range(256)), "binary"),
        (gzip.compress(SHIPPED.encode()), "gzip"),
        (SHIPPED.encode("utf-16"), "UTF-16"),
        (SHIPPED.encode("utf-16-le"), "UTF-16"),
        (SHIPPED.replace("ramp at", "rämp at").encode("latin-1"), "0xe4, 'ä' in Latin-1"),
        (b"#" * 300_000, "longer than 256 KiB"),
        ("name: a\x07b\n", "control character"),
    ],
)
def test_what_is_no_text_in_utf_8_is_named_as_what_it_is(tmp_path: Path, content: bytes | str, words: str) -> None:
    error = refused(written(tmp_path, content))
    assert words in error.reason
    assert error.line == 1
    assert error.hint


def test_the_line_of_a_byte_that_is_no_text(tmp_path: Path) -> None:
    assert refused(written(tmp_path, b"schema: 1\nname: r\xe4mp\n")).line == 2


def test_a_byte_order_mark_and_line_ends_of_other_systems_are_read(tmp_path: Path) -> None:
    content = b"\xef\xbb\xbf" + SHIPPED.replace("\n", "\r\n").encode()
    assert plan_cell(written(tmp_path, content)).cell.name == "surface_follow_sim"


@pytest.mark.parametrize("kind", ["folder", "pipe"])
def test_what_is_no_regular_file_is_refused_and_does_not_block(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "cell.yaml"
    path.mkdir() if kind == "folder" else os.mkfifo(path)
    assert refused(path).reason


def test_aliases_of_aliases_are_bounded(tmp_path: Path) -> None:
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    lines += [f"{name}: &{name} [{', '.join([f'*{chr(ord(name) - 1)}'] * 9)}]" for name in "bcdefghij"]
    assert "aliases expanded" in refused(written(tmp_path, "\n".join(lines))).reason


def test_one_long_text_many_times_is_bounded(tmp_path: Path) -> None:
    content = f"a: &a {'x' * 100_000}\nb: [{', '.join(['*a'] * 50)}]\n"
    assert "aliases expanded" in refused(written(tmp_path, content)).reason


@pytest.mark.parametrize("content", ["a: &a [*a]\n", "a: &a {b: {c: *a}}\n", "a: &a\n  <<: *a\n"])
def test_what_refers_to_itself_is_refused(tmp_path: Path, content: str) -> None:
    error = refused(written(tmp_path, content))
    assert error.reason == "refers to itself"
    assert error.key.startswith("a")


@pytest.mark.parametrize("content", ["a: " + "[" * 60 + "]" * 60, "a: " + "[" * 50_000, "- " * 50_000])
def test_deep_nesting_is_refused(tmp_path: Path, content: str) -> None:
    assert "levels deep" in refused(written(tmp_path, content)).reason


@pytest.mark.parametrize("key", ["1", "true", "~", "1.5", "? [a, b]\n", "? {a: b}\n"])
def test_a_key_that_is_no_text_is_refused(tmp_path: Path, key: str) -> None:
    error = refused(written(tmp_path, f"schema: 1\n{key}: x\n"))
    assert "key" in error.reason
    assert error.line == 2


def test_a_tab_is_named(tmp_path: Path) -> None:
    error = refused(written(tmp_path, SHIPPED.replace("    driver: sim_arm", "\tdriver: sim_arm")))
    assert error.reason == "is indented by a tab"
    assert error.hint == "use spaces"
    assert "\t" in (tmp_path / "cell.yaml").read_text().splitlines()[error.line - 1]


@pytest.mark.parametrize("tag", ["!!python/name:os.system", "!!set", "!!binary", "!mine", "!!timestamp", "!!int"])
def test_tags_are_refused(tmp_path: Path, tag: str) -> None:
    assert "has the tag" in refused(written(tmp_path, f"a: {tag} abc\n")).reason


@pytest.mark.parametrize("text", ["yes", "on", "off", "no", "1:30", "012", "0b1", "1_000", "2026-11-28", "9" * 5000])
def test_yaml_1_1_reads_them_as_something_else_and_here_they_are_text(tmp_path: Path, text: str) -> None:
    file = load(written(tmp_path, f"name: {text}\nrate_hz: {text}\nseed: {text}\ngo: {text}\n"))
    assert file.data["name"] == text
    assert file.validate(Numbers, {"name": text}).name == text
    for key, wanted in (("rate_hz", "number"), ("seed", "integer"), ("go", "boolean")):
        with pytest.raises(InvalidCell) as caught:
            file.validate(Numbers, {key: file.data[key]})
        (problem,) = caught.value.problems
        assert problem.key == key
        assert wanted in problem.reason or text == "9" * 5000
        assert len(problem.reason) < 120


@pytest.mark.parametrize(("text", "value"), [("1e3", 1e3), ("-.5", -0.5), ("5", 5.0), ("0x10", 16.0), ("+2.", 2.0)])
def test_numbers_of_yaml_1_2(tmp_path: Path, text: str, value: float) -> None:
    file = load(written(tmp_path, f"rate_hz: {text}\n"))
    assert file.validate(Numbers, file.data).rate_hz == value


@pytest.mark.parametrize(("key", "text"), [("rate_hz", "true"), ("seed", "true"), ("seed", "2.5"), ("name", "5")])
def test_true_is_no_number_and_a_number_no_text(tmp_path: Path, key: str, text: str) -> None:
    file = load(written(tmp_path, f"{key}: {text}\n"))
    with pytest.raises(InvalidCell):
        file.validate(Numbers, file.data)


@pytest.mark.parametrize("found", [0, 2, 4])
def test_a_list_of_the_wrong_length_is_one_problem_with_both_lengths(tmp_path: Path, found: int) -> None:
    file = load(written(tmp_path, f"at: {list(range(found))}\n"))
    with pytest.raises(InvalidCell) as caught:
        file.validate(Numbers, file.data)
    (problem,) = caught.value.problems
    assert problem.reason == f"needs three numbers, found {found}"


def message(tmp_path: Path, old: str, new: str) -> str:
    assert old in SHIPPED
    return str(refused(written(tmp_path, SHIPPED.replace(old, new, 1))))


def test_messages_name_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    assert message(tmp_path, "schema: 1\n", "") == f"{path}:1: schema: is missing (add `schema: 1`)"
    pose = "needs six numbers [x y z mm, rx ry rz deg], found 5"
    assert message(tmp_path, "25, 180, 0, 0]", "25, 180, 0]").endswith(f"arms.arm.start_pose_mm_deg: {pose}")
    assert "unknown surface 'rampp' (did you mean 'ramp'?)" in message(tmp_path, "kind: ramp", "kind: rampp")
    assert "sim_tactip drives a camera, not an arm" in message(tmp_path, "driver: sim_arm", "driver: sim_tactip")
    assert "schema_" not in message(tmp_path, "seed: 1", "shema: 1")
    assert "rate_hz: must be a valid number, not 'yes'" in message(tmp_path, "rate_hz: 100", "rate_hz: yes")
    turned = message(tmp_path, "min_mm: [-150, -50, 10]", "min_mm: [-150, -50, 200]")
    assert ": interlocks.workspace: min_mm" in turned
    assert "has no value" in message(tmp_path, "    deactivate: hold", "    deactivate:")


def test_a_model_of_the_command_line_does_not_meet_what_is_no_section(tmp_path: Path) -> None:
    for sensors in ("[1]", "{a: 1}", "{a: {estimator: 5}}"):
        path = written(tmp_path, f"schema: 1\nsensors: {sensors}\n")
        with pytest.raises(ConfigError):
            plan_cell(path, model="x.safetensors")


def test_mutated_cells_are_valid_or_refused_by_a_typed_error() -> None:
    wrong: list[tuple[str, Any]] = [
        (tried.verdict, tried.content)
        for tried in try_mutants(250, seed=20)
        if tried.verdict not in ("valid", "refused")
    ]
    assert wrong == []


@pytest.mark.parametrize("text", ["1e30", "-1e30", "1.1e9", "1e400"])
def test_a_number_that_no_unit_explains_is_refused_wherever_it_stands(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(f"a:\n  b: [0, {text}]\n")
    with pytest.raises(ConfigError, match="larger than any length") as caught:
        load(path)
    assert (caught.value.line, caught.value.key) == (2, "a.b.1")
    path.write_text("a: 1e9\nseed: 123456789012345678\n")
    assert load(path).data == {"a": 1e9, "seed": 123456789012345678}
