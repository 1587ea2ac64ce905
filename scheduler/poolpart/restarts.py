"""Keeping a worker in its partition when its nanny restarts it."""

from __future__ import annotations

from typing import Any

from distributed.diagnostics.plugin import NannyPlugin


class KeepResources(NannyPlugin):
    """Makes nannies start their workers with a resource from now on.

    Resources set on a running worker are lost when its nanny restarts it. Setting them once
    more from a plugin inside the new worker comes too late for tasks that found no worker
    meanwhile: nothing wakes those. A resource in what the nanny starts the worker with is
    there when the worker registers, and that does wake them.
    """

    def __init__(self, resource: str, slots: dict[str, int]) -> None:
        self.name = f"poolpart-{resource}"
        self.resource, self.slots = resource, slots

    def setup(self, nanny: Any) -> None:
        """Change what the nanny starts its worker with; called on each, now and when one joins."""
        # A worker that was given no name goes by its address, which its nanny knows.
        slots = self.slots.get(str(nanny.name), self.slots.get(nanny.worker_address))
        if slots is not None:
            nanny.resources = {**(nanny.resources or {}), self.resource: slots}
            # A nanny that has started a worker keeps what it started it with, and uses that.
            if nanny.process is not None:
                nanny.process.worker_kwargs["resources"] = nanny.resources
