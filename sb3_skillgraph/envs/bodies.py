"""What robots of MuJoCo see from their bodies."""

import numpy as np

BODY_NUMBERS = 11  # of what the body views take, beside two for each joint: height, quaternion, velocities
DISTANCE_UNIT = 0.2  # scale of the body views' distances, which are otherwise up to tens of event radii


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
