"""Points that a survey passes, told through `poolpart.trace`: for checkers and fault injection.

Every point carries ``run`` (the survey's id), ``stage`` and ``attempt`` where a stage tells of
it (how many tasks of long stages had been started before), and ``scans``, a list of the scans
that it is about, possibly empty. The driver's points carry ``stage`` too where they are about
one.

================== ======================================================================
point              when
================== ======================================================================
generate.start     the task runs; ``first``: the scan that it begins with
generate.put       before an item is put into the pipe
generate.sent      after that
intersect.start    the task runs, nothing was cast
intersect.cast     the rays were cast, the result has not left the task
intersect.end      the result is about to be returned
sort.hello         before the task says hello
sort.get           results were fetched
sort.put           before frames, in order, are put
sort.sent          after that
collect.hello      before the task says hello
collect.get        results were fetched
collect.part       points were made and are in memory only
collect.sent       they were put
driver.take        descriptions were taken from stage 1; `scans` are those that are new
driver.submit      a batch was submitted to stage 2
driver.handon      results were put into the pipe of `stage`
driver.frame       a frame was handed out
driver.points      points were entered into the cloud
driver.duplicate   something came that is here already, from `stage`, and was dropped
driver.stale       something came from an attempt that was replaced, and was dropped
driver.release     scans have arrived both ways and nothing holds them any more
driver.replay      scans that `stage` was given before are about to be put once more
driver.recast      a batch is about to be submitted to stage 2 once more; `reason` says why
================== ======================================================================
"""

from __future__ import annotations

from .stage_names import COLLECT, GENERATE, INTERSECT, SORT

# {stage: its points, in the order in which it passes them}
STAGE_POINTS = {
    GENERATE: ("generate.start", "generate.put", "generate.sent"),
    INTERSECT: ("intersect.start", "intersect.cast", "intersect.end"),
    SORT: ("sort.hello", "sort.get", "sort.put", "sort.sent"),
    COLLECT: ("collect.hello", "collect.get", "collect.part", "collect.sent"),
}

DRIVER_POINTS = (
    "driver.take",
    "driver.submit",
    "driver.handon",
    "driver.frame",
    "driver.points",
    "driver.duplicate",
    "driver.stale",
    "driver.release",
    "driver.replay",
    "driver.recast",
)
