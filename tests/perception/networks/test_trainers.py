from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")

from touchcell.cell.cli.main import main
from touchcell.perception.networks import marker_training


def test_rings_and_networks_of_the_command_reach_the_marker_training(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: dict[str, Any] = {}
    monkeypatch.setattr(marker_training, "train_markers", lambda data, out, **named: seen.update(named))
    out = str(tmp_path / "m.safetensors")
    command = ["train", "--kind", "markers", "--rings", "7", "--networks", "1", "--data", str(tmp_path), "--out", out]
    assert main(command) == 0
    assert (seen["settings"].rings, seen["settings"].networks) == (7, 1)
