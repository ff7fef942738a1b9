"""Which code computes a result: the digest of what is installed, the commit, and versions of what it computes with."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distributions, version
from pathlib import Path
from typing import Final

from touchcell.cell.analysis.provenance import commit
from touchcell.paths import PACKAGE

_COMPUTES: Final = ("numpy", "opencv-contrib-python-headless", "onnxruntime", "mujoco", "touchcell")


@dataclass(frozen=True, slots=True)
class CodeIdentity:
    """What a result depends on besides its settings.

    Attributes:
        digest: of every source, library and model of the installed package, of plug-ins, and of ``versions``.
        commit: short hash, with "+" if the tree has uncommitted changes; "unknown" outside a checkout.
        versions: by distribution; "-" for one that is not installed.
    """

    digest: str
    commit: str
    versions: Mapping[str, str]


@cache
def code_identity() -> CodeIdentity:
    """Return the identity of the code that this process runs. Reads every file of the package once: some 30 ms."""
    versions = {"python": platform.python_version(), **{name: _version(name) for name in _COMPUTES}}
    content = hashlib.sha256(repr(sorted(versions.items())).encode())
    for root in (PACKAGE, *_plugin_folders()):
        for path in _files(root):
            content.update(os.fsencode(path.relative_to(root)))
            content.update(hashlib.sha256(path.read_bytes()).digest())
    return CodeIdentity(content.hexdigest()[:16], commit(), versions)


def digest_of(path: Path) -> str:
    """Return the digest of a file's bytes, or of all files below a folder."""
    content = hashlib.sha256()
    for each in _files(path):
        content.update(os.fsencode(each.name))
        content.update(each.read_bytes())
    return content.hexdigest()[:16]


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "-"


def _files(root: Path) -> Iterator[Path]:
    if root.is_file():
        yield root
    for folder, folders, names in os.walk(root):
        folders[:] = sorted(name for name in folders if name != "__pycache__")
        for name in sorted(names):
            yield Path(folder, name)


def _plugin_folders() -> list[Path]:
    """Return the folders of other packages with entry points of touchcell, which may take part in a run."""
    roots: set[str] = set()
    for distribution in distributions():
        if distribution.name == "touchcell":
            continue
        for point in distribution.entry_points:
            if point.group.startswith("touchcell."):
                roots.add(point.module.partition(".")[0])
    found = []
    for root in sorted(roots):
        spec = importlib.util.find_spec(root)
        if spec is not None and spec.origin is not None:
            origin = Path(spec.origin)
            found.append(origin.parent if spec.submodule_search_locations else origin)
    return found
