"""SB3 callbacks for skill graphs."""

from typing import Any

from rich.progress import BarColumn, TimeElapsedColumn, TimeRemainingColumn
from stable_baselines3.common.callbacks import ProgressBarCallback
from tqdm.rich import tqdm

#: Environment steps between two looks at the graph.
REFRESH_STEPS = 500


class SkillGraphProgressBarCallback(ProgressBarCallback):
    """SB3's progress bar that also shows the graph: its events and edges, and how often walks succeed.

    :param until: total number of steps at which the bar is full, over several calls of ``learn``; None for the end of one
    """

    model: Any  # a SkillGraphAgent: SB3 declares its own base class, which has no graph

    def __init__(self, until: int | None = None) -> None:
        super().__init__()
        self.until = until

    def _on_training_start(self) -> None:
        if self.until is not None and hasattr(self, "pbar"):
            return
        # Fewer columns than tqdm's own, so that everything fits on a line of 80 characters.
        columns = ("{task.percentage:>3.0f}%", BarColumn(None), TimeElapsedColumn(), "<", TimeRemainingColumn())
        total = (self.until or self.locals["total_timesteps"]) - self.model.num_timesteps
        self.pbar = tqdm(total=total, progress=("{task.description}", *columns))
        self._next_refresh = self.num_timesteps
        self._describe()

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next_refresh:
            self._next_refresh = self.num_timesteps + REFRESH_STEPS
            self._describe()
        return super()._on_step()

    def _describe(self) -> None:
        summary = self.model.graph_summary()
        counts = "  ".join(f"{name} {summary[name]}" for name in ("events", "edges"))
        # The description is the only text that tqdm's rich bar shows; it has no postfix.
        self.pbar.set_description(f"{counts}  success {summary['success_rate']:.2f}", refresh=False)

    def _on_training_end(self) -> None:
        self._describe()
        if self.until is None or self.num_timesteps >= self.until:
            super()._on_training_end()

    def close(self) -> None:
        """Give the terminal back when learning was interrupted: SB3 then does not end its callbacks."""
        if hasattr(self, "pbar"):
            self.pbar.close()
