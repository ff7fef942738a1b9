"""Which code computes a result: a changed gain, model or package is another."""

from __future__ import annotations

import pytest

from touchcell.cell.analysis import code_identity as module


def identity_of(package, monkeypatch):
    monkeypatch.setattr(module, "PACKAGE", package)
    return module.code_identity.__wrapped__()


@pytest.fixture
def package(tmp_path):
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "following.py").write_text("GAIN = 8\n")
    (tmp_path / "model.safetensors").write_bytes(bytes(8))
    return tmp_path


def test_the_same_files_are_the_same_code(package, monkeypatch):
    assert identity_of(package, monkeypatch) == identity_of(package, monkeypatch)


def test_byte_code_beside_the_sources_does_not_count(package, monkeypatch):
    before = identity_of(package, monkeypatch)
    (package / "__pycache__").mkdir()
    (package / "__pycache__" / "following.pyc").write_bytes(b"1")
    assert identity_of(package, monkeypatch).digest == before.digest


@pytest.mark.parametrize(
    ("name", "content"),
    [("tasks/following.py", b"GAIN = 2\n"), ("model.safetensors", bytes(7) + b"1"), ("new.py", b"")],
)
def test_a_changed_gain_model_or_file_is_other_code(name, content, package, monkeypatch):
    before = identity_of(package, monkeypatch)
    (package / name).write_bytes(content)
    assert identity_of(package, monkeypatch).digest != before.digest


@pytest.mark.parametrize(
    "distribution", ["numpy", "mujoco", "onnxruntime", "opencv-contrib-python-headless", "touchcell"]
)
def test_another_version_of_what_computes_is_other_code(distribution, package, monkeypatch):
    before = identity_of(package, monkeypatch)
    known = module.version
    monkeypatch.setattr(module, "version", lambda name: "0.0" if name == distribution else known(name))
    after = identity_of(package, monkeypatch)
    assert after.digest != before.digest
    assert after.versions[distribution] == "0.0"
