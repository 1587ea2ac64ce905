"""Points that a survey reports through `poolpart.trace`, for checkers and fault injection.

Every point has the fields ``run`` (the survey's id) and ``scans`` (a list of the scans concerned,
which can be empty). Points of stages also have ``stage`` and ``attempt``, which is the number of
tasks of long stages that were started before. The driver's points have ``stage`` if they concern a
stage.

================== ======================================================================
point              when
================== ======================================================================
generate.start     the task runs; ``first``: the scan that it begins with
generate.put       before an item is put into the pipe
generate.sent      after that
intersect.start    the task runs, nothing was cast
intersect.cast     the rays were cast, the result has not left the task
intersect.end      the result is about to be returned
sort.start         the task runs, nothing is in its memory
sort.get           summaries were taken
sort.put           before summaries, in order, are put
sort.sent          after that
collect.start      the task runs
collect.get        a batch was fetched
collect.part       its part was made and is in memory only
collect.stored     the part is in storage, and nobody knows of it
collect.sent       its receipt was put
driver.take        descriptions were taken from stage 1; `scans` are those that are new
driver.submit      a batch was offered to a GPU worker
driver.handon      a collector was told of a batch, or the sorter of summaries
driver.points      the part of a batch was committed
driver.frame       a frame was handed out
driver.release     a scan was committed and handed out; nothing holds it any more
driver.replay      a batch is about to be offered or handed on once more; `reason` says why
================== ======================================================================
"""

from __future__ import annotations

WORKER_POINTS = (
    "generate.start",
    "generate.put",
    "generate.sent",
    "intersect.start",
    "intersect.cast",
    "intersect.end",
    "sort.start",
    "sort.get",
    "sort.put",
    "sort.sent",
    "collect.start",
    "collect.get",
    "collect.part",
    "collect.stored",
    "collect.sent",
)

DRIVER_POINTS = (
    "driver.take",
    "driver.submit",
    "driver.handon",
    "driver.points",
    "driver.frame",
    "driver.release",
)

# Points that many a run does not come to: what is to happen there waits for one that does.
RARE_POINTS = ("driver.replay",)
