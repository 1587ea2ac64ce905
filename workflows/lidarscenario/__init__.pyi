from .job import Job as Job
from .plan import Plan as Plan
from .plan import Planning as Planning

__all__ = [
    "Job",
    "Plan",
    "Planning",
]
