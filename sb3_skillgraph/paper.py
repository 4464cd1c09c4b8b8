"""The paper's own settings."""

from typing import Any

#: The paper as written: one DDPG per option learned from its own experience, strict sets, uniform targets (Table 1, A).
PAPER: dict[str, Any] = dict(
    train_freq=1,
    batch_size=64,
    tau=0.01,
    gamma=0.99,
    policy_kwargs=dict(net_arch=[400, 300]),
    option_kwargs=dict(actor_learning_rate=1e-4, critic_learning_rate=1e-3),
    salience="rrt",
    salient_event_freq=30,
    retry_after=10,
    events_per_attempt=2,
    event_tries=1,
    max_unconnected=None,
    gestation_period=3,
    practice_runs=0,
    target_choice="uniform",
    max_failures=None,
    link_reach=0,
    prune_after=None,
    practise="random",
    off_policy_runs=False,
    containment=1.0,
    evidence_edges=False,
    rate_prior=(0.0, 0.0),
    min_success_rate=0.0,
    failure_cost=1.0,
    nearest="euclidean",
    hindsight=0.0,
    goal_tolerance=1.0,
    shared_experience=0.0,
    warm_start=False,
    stall_steps=None,
    global_update_fraction=0.0,
)
