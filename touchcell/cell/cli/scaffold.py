"""``touchcell new``: a package for a plug-in, whose tests are red until it is filled in."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from string import Template
from typing import Any, Final

from touchcell.control.interlocks.spec import INTERLOCKS
from touchcell.drivers.core.spec import DRIVERS
from touchcell.errors import ConfigError
from touchcell.perception.runtime.estimator_spec import ESTIMATORS
from touchcell.registry import Registry
from touchcell.tasks.interface import TASKS

REGISTRIES: Final[Mapping[str, Registry[Any]]] = {
    "driver": DRIVERS,
    "camera": DRIVERS,
    "task": TASKS,
    "interlock": INTERLOCKS,
    "estimator": ESTIMATORS,
}
"""What can be made, and where it is registered; a driver is that of an arm."""

_TEMPLATES = Path(__file__).parent / "templates"
_NAME = re.compile(r"[a-z][a-z0-9_]*")


def new(kind: str, name: str, folder: Path) -> list[Path]:
    """Write the package ``name`` into ``folder / name`` and return its files: project file, source, tests.

    Raises:
        ConfigError: the name is no module name or taken, or the folder exists.
    """
    if not _NAME.fullmatch(name) or keyword.iskeyword(name):
        raise ConfigError(
            "is no name of a module", key="NAME", value=name, hint="small letters, digits and _, such as my_arm"
        )
    registry = REGISTRIES[kind]
    if name in registry.names():
        raise ConfigError(f"the {registry.noun} {name!r} is installed already", key="NAME", value=name)
    package = folder / name
    words = {
        "name": name,
        "title": name.title().replace("_", ""),
        "group": registry.group,
        "version": version("touchcell"),
    }
    files = {
        package / "pyproject.toml": "pyproject.toml.txt",
        package / f"{name}.py": f"{kind}.py.txt",
        package / "tests" / f"test_{name}.py": f"{kind}_test.py.txt",
    }
    try:
        (package / "tests").mkdir(parents=True)
        for file, template in files.items():
            file.write_text(Template((_TEMPLATES / template).read_text()).substitute(words))
    except OSError as error:
        raise ConfigError(
            f"{package} cannot be made: {error.strerror}", hint="choose another name or --out DIR"
        ) from None
    return list(files)
