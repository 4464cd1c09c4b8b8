"""What an option's policy sees: one function of (observation, achieved goal, goal)."""

from collections.abc import Callable

import numpy as np

from sb3_skillgraph.metric import Metric

View = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

BODY_NUMBERS = 11  # of what the body views take, beside two for each joint: height, quaternion, velocities
DISTANCE_UNIT = 0.2  # scale of the body views' distances, which are otherwise up to tens of event radii


def relative_view(observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """See everything, and the goal from where the agent stands.

    :param observation: shape ``(n, observation_dim)``
    :param achieved_goal: shape ``(n, goal_dim)``
    :param goal: shape ``(n, goal_dim)``
    :return: shape ``(n, observation_dim + 2 * goal_dim)``
    """
    return np.concatenate([observation, achieved_goal, goal - achieved_goal], axis=1)


def egocentric_view(observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Leave absolute position out: for tasks whose ``observation`` begins with the achieved goal.

    A skill that does not know where it is works wherever it is put; it needs far fewer steps to learn.

    :param observation: shape ``(n, observation_dim)``, its first ``goal_dim`` entries the achieved goal
    :param achieved_goal: shape ``(n, goal_dim)``
    :param goal: shape ``(n, goal_dim)``
    :return: shape ``(n, observation_dim)``
    """
    return np.concatenate([observation[:, achieved_goal.shape[1] :], goal - achieved_goal], axis=1)


def body_view(observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """See everything from the body: for robots of MuJoCo that move freely, such as Gymnasium's ant.

    Neither position nor heading is seen, and velocity and goal are turned by the heading: what has been learned in one
    place and direction holds in all. The observation must be what such a robot's positions and velocities are without x
    and y: height, quaternion, n joint angles, 3 velocities, 3 angular velocities, n joint velocities (for
    gymnasium-robotics' ant: made with ``include_cfrc_ext_in_observation=False``).

    :param observation: shape ``(m, 11 + 2 * n)``
    :param achieved_goal: shape ``(m, 2)``
    :param goal: shape ``(m, 2)``
    :return: shape ``(m, 13 + 2 * n)``: height, which way is up, joint angles, velocities, direction of the goal and
        distance from it
    :raises ValueError: if observation or goals have other lengths
    """
    return _seen_from_body(observation, achieved_goal, goal)[0]


def placed_body_view(observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """See everything from the body, as :func:`body_view` shows it, and where the body is and which way it faces.

    What has been learned in one place need not hold in another: there may be a wall.

    :param observation: shape ``(m, 11 + 2 * n)``
    :param achieved_goal: shape ``(m, 2)``
    :param goal: shape ``(m, 2)``
    :return: shape ``(m, 17 + 2 * n)``: what :func:`body_view` returns, position and heading
    :raises ValueError: if observation or goals have other lengths
    """
    seen, heading = _seen_from_body(observation, achieved_goal, goal)
    return np.concatenate([seen, DISTANCE_UNIT * achieved_goal, heading], axis=1)


def _seen_from_body(observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what :func:`body_view` returns, and the direction on the floor that the body faces, shape ``(m, 2)``."""
    n_joints, odd = divmod(observation.shape[1] - BODY_NUMBERS, 2)
    if odd or n_joints < 0 or goal.shape[1] != 2:
        raise ValueError(
            "The body views are for free bodies of MuJoCo: goals are positions (x, y), the observation is height, "
            "quaternion, joint angles and all velocities. Here an observation has "
            f"{observation.shape[1]} numbers and a goal {goal.shape[1]}."
        )
    # Column by column: all of this is done for every minibatch, and arrays of two columns are slow to compute with.
    w, x, y, z = observation[:, 1:5].T.copy()
    cosine, sine, _ = _unit(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z))
    ahead, aside, distance = _unit(*(goal - achieved_goal).T)
    vx, vy = observation[:, 5 + n_joints : 7 + n_joints].T
    seen = np.empty((len(observation), 13 + 2 * n_joints), np.result_type(observation, ahead))
    seen[:, 0] = observation[:, 0]
    seen[:, 1], seen[:, 2], seen[:, 3] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    seen[:, 4 : 4 + n_joints] = observation[:, 5 : 5 + n_joints]
    seen[:, 4 + n_joints], seen[:, 5 + n_joints] = _turned(vx, vy, cosine, sine)
    seen[:, 6 + n_joints : -3] = observation[:, 7 + n_joints :]
    seen[:, -3], seen[:, -2] = _turned(ahead, aside, cosine, sine)
    seen[:, -1] = DISTANCE_UNIT * distance
    return seen, np.stack([cosine, sine], axis=1)


def _unit(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vectors of length 1, and the length they had."""
    length = np.sqrt(x * x + y * y)
    divisor = np.maximum(length, 1e-6)
    return x / divisor, y / divisor, length


def _turned(x: np.ndarray, y: np.ndarray, cosine: np.ndarray, sine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what vectors are seen from a heading."""
    return cosine * x + sine * y, cosine * y - sine * x


VIEWS: dict[str, View] = {
    "relative": relative_view,
    "egocentric": egocentric_view,
    "body": body_view,
    "placed_body": placed_body_view,
}


def as_view(view: str | View | None) -> View:
    """Return the view that an environment or an argument names.

    :param view: name, function, or None for ``"relative"``
    :raises ValueError: if there is no view of that name
    """
    if callable(view):
        return view
    name = "relative" if view is None else view
    if name not in VIEWS:
        raise ValueError(f"Unknown option_view {name!r}: use one of {sorted(VIEWS)} or a function.")
    return VIEWS[name]


class ScaledView:
    """A view whose goal space is measured in event radii, so that networks see numbers of order one.

    Positions and offsets of 0.05 m (an arm) and of 4 m (an ant) then look alike to a policy. The function it wraps
    still gets what it expects: ``achieved_goal`` and ``goal``, both as the metric shows them to networks.

    :param function: the view
    :param metric: of goal space
    """

    def __init__(self, function: View, metric: Metric) -> None:
        self.function = function
        self.metric = metric

    def __call__(self, observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return what the policy sees, float32 of shape ``(n, dim)``."""
        seen = self.function(observation, self.metric.embed(achieved_goal), self.metric.embed(goal))
        return np.ascontiguousarray(seen, dtype=np.float32)

    def dim(self, observation_dim: int, goal_dim: int) -> int:
        """Return the length of what the policy sees."""
        zeros = np.zeros((1, goal_dim), dtype=np.float32)
        return self(np.zeros((1, observation_dim), dtype=np.float32), zeros, zeros).shape[1]
