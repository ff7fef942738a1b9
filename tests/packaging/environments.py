"""Build touchcell as a user's installer would, and keep virtual environments to install it into."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from touchcell.paths import CHECKOUT

_TIMEOUT_S = 900


def clean_environment(**extra: str) -> dict[str, str]:
    """The environment of a fresh shell: nothing that leads Python to the checkout."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "TOUCHCELL", "PYTEST"))}
    return {**kept, "PIP_DISABLE_PIP_VERSION_CHECK": "1", **extra}


def run(
    *command: str | Path, cwd: Path, check: bool = True, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command; a failure that is not expected fails the test with all its output."""
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=clean_environment(**(env or {})),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=_TIMEOUT_S,
    )
    if check and done.returncode:
        pytest.fail(f"{' '.join(map(str, command))} ended with {done.returncode}:\n{done.stdout[-4000:]}")
    return done


@dataclass(frozen=True)
class Environment:
    """A virtual environment of its own, and a folder with nothing in it to work in."""

    root: Path

    @classmethod
    def create(cls, python: Path, root: Path) -> Environment:
        (root / "work").mkdir(parents=True)
        run(python, "-m", "venv", root / "venv", cwd=root)
        return cls(root)

    @property
    def work(self) -> Path:
        return self.root / "work"

    def program(self, name: str) -> Path:
        return self.root / "venv" / "bin" / name

    def python(self, *arguments: str | Path, cwd: Path | None = None, check: bool = True, **env: str) -> str:
        return run(self.program("python"), *arguments, cwd=cwd or self.work, check=check, env=env).stdout

    def touchcell(self, *arguments: str | Path, cwd: Path | None = None, **env: str) -> str:
        return run(self.program("touchcell"), *arguments, cwd=cwd or self.work, env=env).stdout

    def install(self, *arguments: str | Path) -> None:
        self.python("-m", "pip", "install", "--quiet", *arguments)

    def uninstall(self, name: str) -> None:
        self.python("-m", "pip", "uninstall", "--quiet", "--yes", name)


def tracked_tree(folder: Path) -> Path:
    """A copy of the checkout that holds what git tracks and no more, links as links."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode:
        pytest.skip("the checkout is no git repository, so what belongs to it is unknown")
    for name in filter(None, listed.stdout.split("\0")):
        source, target = CHECKOUT / name, folder / name
        if source.is_symlink() or source.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target, follow_symlinks=False)
    return folder


@cache
def interpreter(version: str) -> Path | None:
    """The interpreter of a version like ``3.12``: the running one, on the path, or one that pyenv keeps."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    found = shutil.which(f"python{version}")
    candidates = [
        Path(sys.executable),
        *([Path(found)] if found else []),
        *sorted(pyenv.glob(f"versions/*/bin/python{version}")),
    ]
    for candidate in candidates:
        asked = subprocess.run(
            [candidate, "-c", "import sys, ensurepip, venv; print('%d.%d' % sys.version_info[:2])"],
            capture_output=True,
            text=True,
            check=False,
        )
        if asked.stdout.strip() == version:
            return candidate
    return None
