"""Many runs on disk: methods times environments times seeds, resumable, by several workers."""

from sb3_skillgraph.experiments.plan import RunSpec, load_plan
from sb3_skillgraph.experiments.runner import RunStatus, compare, run, status

__all__ = ["RunSpec", "RunStatus", "compare", "load_plan", "run", "status"]
