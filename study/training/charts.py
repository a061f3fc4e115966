"""TensorBoard's file of scalars, written at once: a full disk shows itself where it is met, not in another thread."""

import itertools
import os
import socket
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from ppo.files import naming

COUNT = itertools.count()  # files of this process: TensorBoard reads them in the order of their names


class Charts:
    """The scalars of a session in a directory.

    A series begins where it first differs from zero, so that what never happens has no chart.

    Attributes:
        begun: the tags of the series so far.
    """

    def __init__(self, directory: Path, begun: Iterable[str] = ()) -> None:
        self.begun = set(begun)
        parts = f"{int(time.time()):010}", socket.gethostname(), os.getpid(), f"{next(COUNT):06}"
        self.path = directory / ".".join(map(str, ("events.out.tfevents", *parts)))

    def open(self, interactions: int) -> None:
        """Begins the file; what an earlier session drew after so many interactions is forgotten."""
        start = SessionLog(status=SessionLog.START)
        self.write(Event(file_version="brain.Event:2"), Event(step=interactions + 1, session_log=start))

    def add(self, scalars: Mapping[str, float], interactions: int) -> None:
        """Adds a point to each chart."""
        self.begun |= {tag for tag, value in scalars.items() if value != 0.0}
        values = [
            Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items() if tag in self.begun
        ]
        if values:
            self.write(Event(step=interactions, summary=Summary(value=values)))

    def write(self, *events: Event) -> None:
        """Appends events; raises an OSError that names the file, also where its directory is gone."""
        with naming(self.path), open(self.path, "ab") as file:
            writer = RecordWriter(file)
            for event in events:
                event.wall_time = time.time()
                writer.write(event.SerializeToString())
