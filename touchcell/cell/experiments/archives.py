"""Files and folders as bytes, to travel to workers that share no files with this machine."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path


def archive_of(path: Path, name: str = ".") -> bytes:
    """Return a tar archive of a file or folder, which is called ``name`` in it."""
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as archive:
        archive.add(path, name)
    return content.getvalue()


def extract(content: bytes, folder: Path) -> None:
    """Extract an archive into a folder; names that lead out of it are refused (PEP 706)."""
    folder.mkdir(parents=True, exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        archive.extractall(folder, filter="data")
