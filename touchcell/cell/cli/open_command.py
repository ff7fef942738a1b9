"""``touchcell open``: a run in a viewer of one's choice."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

from touchcell.cell.analysis.foxglove_layout import foxglove_layout
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.cli.output import say
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import RECORDING, read
from touchcell.cell.recording.recorded_images import is_image
from touchcell.errors import ConfigError

LAYOUT: Final = "foxglove_layout.json"
_APPS: Final = ("foxglove-studio", "foxglove", "lichtblick")


def open_in_foxglove(folder: Path) -> None:
    """Write a layout beside a recording, and open it in Foxglove or Lichtblick where one is installed.

    Raises:
        RecordingError, ConfigError: the folder holds no run.
    """
    recording = folder / RECORDING
    topics = {message.topic.rpartition("/")[2] for message in read(recording) if is_image(message.topic)}
    layout = folder / LAYOUT
    try:
        layout.write_text(foxglove_layout(RunFolder(folder).plan, next(iter(topics), "video")))
    except OSError as error:
        raise RecordingError(layout, f"cannot be written: {error.strerror}") from None
    say(f"layout: {layout} (Foxglove: Layouts, Import from file)")
    app = next((found for name in _APPS if (found := shutil.which(name))), None)
    if app is None:
        say(f"recording: {recording.resolve()} (Foxglove or Lichtblick: Open local file; neither is installed here)")
        return
    subprocess.Popen([app, str(recording.resolve())], start_new_session=True)
    say(f"opened in {Path(app).name}")


def open_in_rerun(folder: Path, target: Path | None) -> None:
    """Open a run in Rerun, or write it for Rerun to ``target``.

    Raises:
        ConfigError: rerun-sdk is missing, or its viewer does not start.
        RecordingError: the folder holds no run.
    """
    try:
        from touchcell.cell.analysis.rerun_view import show_in_rerun
    except ModuleNotFoundError:
        raise ConfigError(
            "needs rerun-sdk, which is not installed",
            key="--rerun",
            hint="pip install 'touchcell[rerun]', or --foxglove",
        ) from None
    if target is None and not _has_display():
        raise _no_viewer("this machine has no display")
    try:
        show_in_rerun(folder, target)
    except RuntimeError as error:
        raise _no_viewer(str(error).partition("\n")[0]) from None
    if target is not None:
        say(f"written: {target} (`rerun {target}` shows it)")


def _has_display() -> bool:
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _no_viewer(reason: str) -> ConfigError:
    hint = "--to FILE.rrd, which `rerun FILE.rrd --web-viewer` shows in a browser, or --foxglove"
    return ConfigError(f"Rerun's viewer does not start: {reason}", key="--rerun", hint=hint)
