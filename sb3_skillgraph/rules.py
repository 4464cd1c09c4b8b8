"""The paper's own numbers (Table 1, sections A.1.2, A.6)."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PaperRules:
    """What makes a :class:`~sb3_skillgraph.SkillGraphAgent` do as the paper does, and not as its own default.

    :param salient_event_freq: K, episodes after which new salient events are looked for, whatever became of the last
    :param retry_after: R, episodes after which they are looked for again where both of a pair were rejected
    :param gestation_period: successes that an option needs to mature
    :param timeout: environment steps an option may run
    :raises ValueError: if a number is not whole, or below 1
    """

    salient_event_freq: int = 30
    retry_after: int = 10
    gestation_period: int = 3
    timeout: int = 200

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"PaperRules: {name} must be a whole number from 1 on, not {value!r}.")


#: The paper as written: ``SkillGraphAgent("MultiInputPolicy", env, **PAPER)``. With ``salience="dco"`` it is DSG-DCO.
PAPER: dict[str, Any] = dict(
    rules=PaperRules(),
    salience="rrt",
    train_freq=1,
    batch_size=64,
    tau=0.01,
    gamma=0.99,
    policy_kwargs=dict(net_arch=[400, 300]),
    option_kwargs=dict(actor_learning_rate=1e-4, critic_learning_rate=1e-3, saturation_penalty=0.0),
    hindsight=0.0,
    goal_tolerance=1.0,
)
