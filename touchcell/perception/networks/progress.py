"""Terminal display of a training."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from touchcell.progress import ProgressLines

if TYPE_CHECKING:
    from touchcell.perception.networks.checkpoint import EpochRecord


class Observer(Protocol):
    """Receives the progress of a training."""

    def images(self, split: str, done: int, total: int) -> None:
        """``done`` of ``total`` images of a split are decoded."""
        ...

    def batch(self, epoch: int, epochs: int, done: int, total: int, loss: float) -> None:
        """``done`` of ``total`` batches of an epoch are done; ``loss`` is their mean."""
        ...

    def epoch(self, record: EpochRecord, *, best: bool) -> None:
        """An epoch has been completed and validated."""
        ...


class Display:
    """Show a bar with the remaining time, and one line per epoch; into a file the lines alone, and now and then one to
    standard error."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[loss]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=False),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._lines = None if self._console.is_terminal else ProgressLines()
        self._task: TaskID | None = None
        self._task_name = ""

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
        if kind is KeyboardInterrupt:
            self._console.print("Interrupted. The same command continues from the last complete epoch.")

    def images(self, split: str, done: int, total: int) -> None:
        self._show(f"images {split}", f"images {split}", done, total)

    def batch(self, epoch: int, epochs: int, done: int, total: int, loss: float) -> None:
        finished = (epoch - 1) * total + done
        self._show("training", f"epoch {epoch}/{epochs}", finished, epochs * total, f"loss {loss:.3f}")

    def epoch(self, record: EpochRecord, *, best: bool) -> None:
        if record.epoch == 1:
            self._console.print(
                "epoch   train     val  " + " ".join(f"{name:>9}" for name in record.mae), soft_wrap=True
            )
        errors = " ".join(f"{error:9.3f}" for error in record.mae.values())
        mark = " *" if best else ""
        self._console.print(
            f"{record.epoch:5d} {record.train_loss:7.3f} {record.validation_loss:7.3f}  {errors}{mark}",
            highlight=False,
            soft_wrap=True,
        )

    def _show(self, name: str, description: str, done: int, total: int, loss: str = "") -> None:
        if self._lines is not None:
            self._lines(description, done, total, loss)
            return
        if self._task is None or self._task_name != name:
            if self._task is not None:
                self._bar.remove_task(self._task)
            # Epochs done before a resume took no time now, and must not shorten the estimated remaining time.
            self._task = self._bar.add_task(description, total=total, completed=done - 1, loss=loss)
            self._task_name = name
        self._bar.update(self._task, description=description, completed=done, loss=loss)
