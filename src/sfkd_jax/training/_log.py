"""Logging of training metrics: JSON lines, TensorBoard, and a progress bar."""

from __future__ import annotations

import json
import math
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue] made by protobuf
from tensorboardX.summary import scalar

from sfkd_jax.store import truncate_jsonl

RESUME_HINT = "the same command goes on from the last checkpoint"


def _step(line: dict[str, Any]) -> int | float:
    """The step of a line; a line without a number belongs to no step."""
    step = line["step"]
    return step if isinstance(step, int | float) else math.inf


class TrainingLog:
    """A context that records the metrics of a run, new or resumed."""

    def __init__(self, directory: Path, *, steps: int, resumed_at: int) -> None:
        """Open the log of a run.

        Args:
            directory: of the run.
            steps: of the whole run.
            resumed_at: step at which the run is resumed; later lines are dropped.
        """
        self._steps = steps
        self._path = directory / "metrics.jsonl"
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._path.touch()
        truncate_jsonl(
            self._path,
            lambda line: _step(line) <= resumed_at,
            keys=("step",),
        )
        board = directory / "tensorboard" / "events"
        board.parent.mkdir(exist_ok=True)
        # Not SummaryWriter: its thread reports a full disk only at the end of the
        # process, with a traceback.
        self._board = EventsWriter(str(board), f".{resumed_at}")
        if resumed_at:
            self._board.write_event(
                Event(step=resumed_at, session_log=SessionLog(status=SessionLog.START))
            )
        columns = (
            TextColumn("training"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        console = Console(stderr=True)
        self._bar = Progress(
            *columns, TextColumn("{task.fields[note]}"), console=console
        )
        self._task = self._bar.add_task(
            "training", total=steps, completed=resumed_at, note=""
        )
        self._shows_bar = console.is_terminal

    def __enter__(self) -> TrainingLog:
        """Start the progress bar, on a terminal only."""
        if self._shows_bar:
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the bar and close the files."""
        if self._shows_bar:
            self._bar.stop()
        with suppress(OSError):  # a full disk has been reported before
            self._board.close()

    def write(self, record: dict[str, float]) -> None:
        """Append one record, which must have `step`; entries not finite are omitted."""
        clean = {name: value for name, value in record.items() if math.isfinite(value)}
        step = int(clean["step"])
        try:
            with self._path.open("a") as file:
                file.write(json.dumps(clean) + "\n")
            for name, value in clean.items():
                if name != "step":
                    self._board.write_event(
                        Event(
                            wall_time=time.time(),
                            step=step,
                            summary=scalar(name, value),
                        )
                    )
            self._board.flush()
        except OSError as reason:
            raise OSError(
                f"{self._path.parent}: step {step} was not logged "
                f"({reason.strerror}); {RESUME_HINT}"
            ) from reason
        note = " ".join(
            f"{name} {clean[name]:.3g}"
            for name in ("loss", "validation_loss")
            if name in clean
        )
        if self._shows_bar:
            self._bar.update(self._task, completed=int(clean["step"]), note=note)
        elif "validation_loss" in clean:
            print(
                f"training {clean['step']:.0f} / {self._steps}  {note}",
                file=sys.stderr,
                flush=True,
            )
