"""Stage 1: a long-running task that describes the scans of surveys."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain

from distributed import secede

from lidarsim.survey.survey import Survey
from poolpart import Pipe, PipeClosed, PipeFailed
from poolpart.pipe import get_advice
from poolpart.task_context import translate_leaving_errors

from .failures import ScanError, naming_scans
from .message_sender import MessageSender
from .stage_messages import Description, Failed, ScanRange, StageStart
from .stage_names import GENERATE, LIDAR
from .task_records import Recorder, TaskRecord


@translate_leaving_errors()
def generate(start: StageStart, inlet: Pipe, outlet: Pipe) -> TaskRecord:
    """Describe the scans of all surveys in order (stage 1).

    The driver sends lists of `Description`, and receives `ScanRange` messages with the advised
    number of scans. The scans themselves are not sent, because workers can derive them from the
    survey. If a scan cannot be described, the driver receives `Failed`.
    """
    secede()
    recorder = Recorder(start.stage, LIDAR)
    sender = MessageSender(start, outlet, max_items=outlet.capacity)
    start.trace("start")
    with suppress(PipeClosed, PipeFailed):
        while True:
            descriptions = chain.from_iterable(inlet.get_all())
            sender.send(_describe_scans(start, descriptions, outlet))
    return recorder.finish(sender.scan_count)


def _describe_scans(
    start: StageStart, descriptions: Iterable[Description], outlet: Pipe
) -> Iterator[ScanRange | Failed]:
    for description in descriptions:
        first = description.first
        try:
            with naming_scans(first, first + 1):
                survey: Survey = pickle.loads(description.survey)  # noqa: S301 - from the run's driver
            while first < description.stop:
                item = ScanRange(
                    description.job, first, min(first + get_advice(outlet), description.stop)
                )
                with naming_scans(item.first, item.stop):
                    survey.scan(item.stop - 1)  # raises an error if the scan cannot be described
                start.trace("put", item.scans)
                yield item
                first = item.stop
        except ScanError as error:  # must not affect other surveys
            yield Failed(description.job, GENERATE, str(error))
