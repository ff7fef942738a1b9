"""Every command has help, every mistake is one message with an exit code, and no traceback reaches a user."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import touchcell as tc
from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT, EXIT_DEVICE_LOST, EXIT_OK, MEANING
from touchcell.cell.cli.main import build_parser, main
from touchcell.cell.cli.run_commands import latest_run


def parsers() -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for action in build_parser()._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.items()


COMMANDS = dict(parsers())


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_argument_has_a_help_text(command: str) -> None:
    assert COMMANDS[command].description
    for action in COMMANDS[command]._actions:
        assert action.help, f"{command} {action.dest}"
        assert action.help is not argparse.SUPPRESS


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_prints_its_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == EXIT_OK
    assert f"usage: touchcell {command}" in capsys.readouterr().out


def test_help_names_the_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    printed = capsys.readouterr().out
    assert all(f"  {code}  {meaning}\n" in printed for code, meaning in MEANING.items())


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == EXIT_OK
    assert capsys.readouterr().out == f"touchcell {tc.__version__}\n"


@pytest.mark.parametrize("words", [["rnu", "x.yaml"], ["-v", "rnu"]])
def test_an_unknown_command_gets_a_suggestion(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == EXIT_BAD_INPUT
    assert capsys.readouterr().err == "touchcell: unknown command 'rnu' (did you mean 'run'?)\n"


MISTAKES = {
    "emulate cell nofile.yaml": "nofile.yaml: cannot be read",
    "emulate cell configs/surface_follow_sim.yaml": "emulated_scene: there is nothing to touch",
    "emulate urr": "unknown emulator 'urr' (did you mean 'ur'?)",
    "emulate ur --host 8.8.8.8": "the emulator 'ur' cannot open its wire: ",
    "ui runs --port 80000": "argument --port: must be 0 or from 1024 to 65535, not '80000'",
    "ui runs --port -5": "argument --port: ",
    "ui nofolder": "nofolder",
    "experiment robustness --jobs -3": "argument --jobs: must be a whole number of 1 or more, not '-3'",
    "experiment robustness --trials -1": "argument --trials: must be a whole number of 1 or more, not '-1'",
    "experiment robustnes": "did you mean 'robustness'?",
    "bench cylce": "did you mean 'cycle'?",
    "train --data . --out m.safetensors --epochs 0": "argument --epochs: must be a whole number of 1 or more, not '0'",
    "why": "there is no run below runs/",
    "report": "there is no run below runs/",
    "stop": "no run is in progress here",
    "reset": "no run waits for a reset here",
    "why nofolder": "nofolder",
    "run configs/surface_follow_sim.yaml --data /nonexist": "--data: no driver of this cell replays a data set",
    "check configs/replay_real.yaml --data /nonexist": "--data: /nonexist: there is no such folder",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_one_message(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code: int | str | None = main(line.split())
    except SystemExit as stopped:
        code = stopped.code
    assert code == EXIT_BAD_INPUT
    printed = capfd.readouterr().err
    assert MISTAKES[line] in printed
    assert "Traceback" not in printed


def test_an_emulator_started_as_a_module_prints_no_traceback_either() -> None:
    command = [sys.executable, "-m", "touchcell.testing.emulation", "ur", "--host", "8.8.8.8"]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 1
    assert ran.stderr.startswith("touchcell emulate: the emulator 'ur' cannot open its wire: ")
    assert len(ran.stderr.splitlines()) == 1


def test_a_device_that_does_not_answer_has_an_exit_code_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tc.load_cell("surface_follow_sim").text()
    text = text.replace("time: simulated", "time: real").replace(
        "driver: sim_tactip\n    mounted_on: arm\n    rate_hz: 30\n    latency_ms: 10\n",
        "driver: v4l2\n    device: /dev/nothing\n    mounted_on: arm\n",
    )
    (tmp_path / "cell.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    assert main(["probe", "cell.yaml"]) == EXIT_DEVICE_LOST
    assert "sensor (v4l2): DOES NOT ANSWER" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("module", "line", "remedy"),
    [
        ("torch", "train --data . --out m.safetensors", "`train` needs torch, which is not installed (pip install "),
        ("shtab", "completion bash", "`completion` needs shtab, which is not installed (pip install "),
    ],
)
def test_a_missing_extra_says_what_to_install(module: str, line: str, remedy: str) -> None:
    # In a process of its own: modules that are imported again have classes that are not the ones imported before.
    program = f"import sys; sys.modules[{module!r}] = None; from touchcell.cell.cli.main import main; sys.exit(main())"
    done = subprocess.run([sys.executable, "-c", program, *line.split()], capture_output=True, text=True, check=False)
    assert done.returncode == EXIT_BAD_INPUT
    assert remedy in done.stderr


def test_commands_about_runs_take_the_newest(tmp_path: Path) -> None:
    for age, name in enumerate(("new", "old", "older")):
        recording = tmp_path / name / "run.mcap"
        recording.parent.mkdir()
        recording.touch()
        os.utime(recording, ns=(10**18 - age * 10**9,) * 2)
    (tmp_path / "no-recording").mkdir()
    assert latest_run(tmp_path) == tmp_path / "new"


@pytest.mark.parametrize(("words", "shown"), [(["probe"], False), (["probe", "-v"], True), (["-v", "probe"], True)])
def test_verbose_shows_the_log_and_the_default_does_not(
    words: list[str], shown: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "surface_follow_sim.yaml"]) == EXIT_OK
    assert ("touchcell.drivers.core.device: arm: connected" in capsys.readouterr().err) is shown


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_completion_knows_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("shtab")
    assert main(["completion", shell]) == EXIT_OK
    script = capsys.readouterr().out
    assert all(command in script for command in COMMANDS)
