"""Logging helpers. The library logs to loggers named after its modules and configures none; programs do."""

from __future__ import annotations

import copy
import logging
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path

LOGGER = "touchcell"
"""The logger above all of this library's."""

_FORMAT = "%(asctime)s %(levelname)-7s %(name)s: %(message)s"


class OncePerCause:
    """Warns of each cause once; repetitions are logged at DEBUG level, until ``forget``.

    Args:
        logger: where to.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._seen: set[Hashable] = set()

    def warning(self, cause: Hashable, message: str, *arguments: object) -> None:
        """Log ``message`` as a warning if ``cause`` is new."""
        self._logger.log(logging.DEBUG if cause in self._seen else logging.WARNING, message, *arguments)
        self._seen.add(cause)

    def forget(self) -> None:
        """Warn of every cause again: what was wrong has ended."""
        if self._seen:
            self._seen.clear()


class _QuietFileHandler(logging.FileHandler):
    """Ends with the first write that fails: a full disk is reported by what records, not by a traceback per line."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  logging's own name
        logging.getLogger(LOGGER).removeHandler(self)


class _Passing(logging.Handler):
    """Passes on what would have been logged without the log file."""

    def __init__(self, level: int) -> None:
        super().__init__(level)

    def emit(self, record: logging.LogRecord) -> None:
        logging.getLogger().callHandlers(record)


@contextmanager
def log_to_file(path: Path) -> Iterator[None]:
    """While inside, also write what touchcell logs at INFO and above to ``path``; other handlers see what they did.

    A file that cannot be opened is a warning, not an error.
    """
    logger = logging.getLogger(LOGGER)
    try:
        file = _QuietFileHandler(path, encoding="utf-8")
    except OSError as error:
        logger.warning("%s cannot be written: %s", path, error.strerror)
        yield
        return
    file.setFormatter(logging.Formatter(_FORMAT))
    file.setLevel(logging.INFO)
    before, before_propagate = logger.level, logger.propagate
    passing = _Passing(logger.getEffectiveLevel())
    logger.setLevel(min(logger.getEffectiveLevel(), logging.INFO))
    logger.addHandler(file)
    if before_propagate:
        logger.propagate = False
        logger.addHandler(passing)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.propagate = before_propagate
        logger.removeHandler(passing)
        logger.removeHandler(file)
        file.close()


class _OneLine(logging.Formatter):
    """Leaves the traceback of an exception out: it is in the run folder's log file, and on the terminal with -v."""

    def format(self, record: logging.LogRecord) -> str:
        shown = copy.copy(record)
        shown.exc_info = shown.exc_text = shown.stack_info = None
        return super().format(shown)


@contextmanager
def log_to_terminal(verbosity: int) -> Iterator[None]:
    """For a command line: warnings on standard error, with 1 also INFO, with 2 also DEBUG, and nowhere else."""
    logger = logging.getLogger(LOGGER)
    levels = (logging.WARNING, logging.INFO, logging.DEBUG)
    level = levels[min(verbosity, len(levels) - 1)]
    handler = logging.StreamHandler()
    handler.setLevel(level)
    shown = "%(levelname)s %(name)s: %(message)s" if verbosity else "touchcell: %(levelname)s: %(message)s"
    handler.setFormatter(logging.Formatter(shown) if verbosity else _OneLine(shown))
    before, before_propagate = logger.level, logger.propagate
    logger.setLevel(level)
    logger.propagate = False
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
        logger.propagate = before_propagate
