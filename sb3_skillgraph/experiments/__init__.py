"""Many runs on disk: methods times environments times seeds, resumable, by several workers."""

from sb3_skillgraph.experiments.plan import RunSpec, load_plan
from sb3_skillgraph.experiments.runner import compare, run
from sb3_skillgraph.experiments.status import RunStatus, status

__all__ = ["RunSpec", "RunStatus", "compare", "load_plan", "run", "status"]
