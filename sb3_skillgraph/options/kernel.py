"""
The update of DDPG and TD3 in one compiled function, for networks of Linear and ReLU layers on a CPU.

The numbers are those of ``OptionLearner._update_by_torch``, which is the one to read first. BLAS does the matrix
products, torch's own where it can be found, and loops do all else: what belongs to a layer is touched while it is in the
cache, and loops are compiled in less time than expressions of arrays. All of it stands in this file: numba keeps what it
has compiled until the file changes, not what that calls in others.
"""

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from sb3_skillgraph.options.blas import SGEMM
from sb3_skillgraph.options.compiling import compiled, inlined, inner

# Where arrays are in memory: address, rows and columns of each. Handed over as arrays each would have to be unpacked.
Network = np.ndarray  # of the weight (out, in) and the bias (1, out) of each layer, (parameters, 3) whole numbers
Learner = np.ndarray  # of a network, its target, both moments of Adam, its numbers of steps, (5, parameters, 3)
Rates = tuple[float, float, float, float, float]  # Adam's learning rate, betas and epsilon; tau, 0 for no target to move
# Observations, actions, next observations, noise on next actions, rewards, discounts (0 after an end): (batch, width).
Batch = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
#: Columns of a result up to which turning it pays: BLAS takes its columns for rows, and is slow where they are so short.
NARROW = 12
BYTE, FLOAT = ir.IntType(8), ir.FloatType()
#: Whether a matrix is transposed: as NumPy's, since numba compiles all anew for each of Python's own.
AS_IT_IS, TURNED = np.bool_(False), np.bool_(True)


@intrinsic
def pointer(typing_context: Any, address: Any) -> Any:
    """
    Compiled code calls this with an address: numba has no such function of its own.

    :param address: where a number is
    :return: the pointer to it
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float32)(address), code


@inner
def array_at(network: Network, k: int) -> np.ndarray:
    """
    :param network: where its arrays are; nothing in here looks whether they are
    :param k: which of them
    :return: the array, as it is
    """
    return carray(pointer(network[k, 0]), (network[k, 1], network[k, 2]))  # type: ignore[call-arg]


@intrinsic
def sgemm(typing_context: Any, left: Any, right: Any, left_turned: Any, right_turned: Any, result: Any) -> Any:
    """
    Compiled code calls this for BLAS to write a product: numba compiles it in a fifth of the time that Python's words take.

    Arguments as of ``product``, and the result, (m, n).
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        arrays = [make_array(signature.args[i])(context, builder, arguments[i]) for i in (0, 1, 4)]
        sizes = [cgutils.unpack_tuple(builder, array.shape) for array in arrays]
        (left, right, result), ((left_rows, left_columns), (_, right_columns), (m, n)) = arrays, sizes
        left_letter, right_letter = (builder.select(turned, BYTE(ord("T")), BYTE(ord("N"))) for turned in arguments[2:4])
        k = builder.select(arguments[2], left_rows, left_columns)
        # BLAS goes by columns, and sees every matrix transposed: the right one comes first
        given = [right_letter, left_letter, n, m, k, FLOAT(1.0), right.data, right_columns, left.data, left_columns]
        given += [FLOAT(0.0), result.data, n]
        # It reads all of them where they are; whole numbers of 64 bits also if it expects 32, where the low ones come first
        places = [x if isinstance(x.type, ir.PointerType) else cgutils.alloca_once_value(builder, x) for x in given]
        function = ir.FunctionType(ir.VoidType(), [place.type for place in places])
        builder.call(cgutils.get_or_insert_function(builder.module, function, SGEMM), places)
        return context.get_dummy_value()

    return types.void(left, right, types.boolean, types.boolean, result), code


@inner
def multiply(left: np.ndarray, right: np.ndarray, left_turned: bool, right_turned: bool) -> np.ndarray:
    """Return the product by one call of BLAS; arguments as of ``product``."""
    m = left.shape[1] if left_turned else left.shape[0]
    n = right.shape[0] if right_turned else right.shape[1]
    result = np.empty((m, n), np.float32)
    sgemm(left, right, left_turned, right_turned, result)  # type: ignore[call-arg]
    return result


@inner
def product(left: np.ndarray, right: np.ndarray, left_turned: bool, right_turned: bool) -> np.ndarray:
    """
    :param left: (m, k), or (k, m) if it is to be transposed
    :param right: (k, n), or (n, k) if it is to be transposed
    :param left_turned: whether it is
    :param right_turned: whether it is
    :return: (m, n)
    """
    m = left.shape[1] if left_turned else left.shape[0]
    n = right.shape[0] if right_turned else right.shape[1]
    if not 1 < n <= NARROW < m:
        return multiply(left, right, left_turned, right_turned)
    # The same the other way round, from an eighth to a half of the time
    turned = multiply(right, left, not right_turned, not left_turned)
    result = np.empty((m, n), np.float32)
    for i in range(m):
        for j in range(n):
            result[i, j] = turned[j, i]
    return result


@inner
def forward(network: Network, inputs: np.ndarray) -> list[np.ndarray]:
    """
    :param network: its layers, with a ReLU between one and the next
    :param inputs: (batch, in)
    :return: what every layer was given, and last what the network returns: (batch, out)
    """
    values = [inputs]
    for k in range(0, len(network), 2):
        weight, bias = array_at(network, k), array_at(network, k + 1)
        is_last = k == len(network) - 2
        outputs = product(values[-1], weight, AS_IT_IS, TURNED)
        for i in range(outputs.shape[0]):
            for j in range(outputs.shape[1]):
                outputs[i, j] += bias[0, j]
                if outputs[i, j] < 0 and not is_last:
                    outputs[i, j] = 0
        values.append(outputs)
    return values


@inner
def back_to_relu(gradient: np.ndarray, weight: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """
    :param gradient: (batch, out), of the loss by what a layer returned
    :param weight: (out, in), the layer's
    :param inputs: (batch, in), what a ReLU gave the layer
    :return: (batch, in), of the loss by what the ReLU was given
    """
    result = product(gradient, weight, AS_IT_IS, AS_IT_IS)
    for i in range(result.shape[0]):
        for j in range(result.shape[1]):
            if inputs[i, j] <= 0:
                result[i, j] = 0
    return result


@inner
def column_sums(gradient: np.ndarray) -> np.ndarray:
    """
    :param gradient: (batch, out)
    :return: (1, out)
    """
    sums = np.empty((1, gradient.shape[1]), np.float32)
    for j in range(gradient.shape[1]):
        sums[0, j] = 0
    for i in range(gradient.shape[0]):
        for j in range(gradient.shape[1]):
            sums[0, j] += gradient[i, j]
    return sums


@inner
def side_by_side(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """
    :param left: (batch, m)
    :param right: (batch, n)
    :return: (batch, m + n)
    """
    rows = np.empty((left.shape[0], left.shape[1] + right.shape[1]), np.float32)
    for i in range(rows.shape[0]):
        for j in range(left.shape[1]):
            rows[i, j] = left[i, j]
        for j in range(right.shape[1]):
            rows[i, left.shape[1] + j] = right[i, j]
    return rows


@inner
def step(learner: Learner, k: int, gradient: np.ndarray, rates: Rates) -> None:
    """
    Take one step of Adam, then move the target.

    :param learner: all of its arrays
    :param k: which parameter learns
    :param gradient: of the loss by the parameter, of its shape
    :param rates: of Adam and of the target
    """
    parameter, target, average = array_at(learner[0], k), array_at(learner[1], k), array_at(learner[2], k)
    square, count = array_at(learner[3], k), array_at(learner[4], k)
    learning_rate, beta1, beta2, epsilon, tau = rates
    count[0, 0] += 1
    # All of these in double before they are rounded: 1 - beta2 would have three digits in single precision.
    new_average, old_square, new_square = np.float32(1 - beta1), np.float32(beta2), np.float32(1 - beta2)
    rate = np.float32(learning_rate / (1 - beta1 ** count[0, 0]))
    correction = np.float32(1 / math.sqrt(1 - beta2 ** count[0, 0]))
    small, new_target, old_target = np.float32(epsilon), np.float32(tau), np.float32(1 - tau)
    for i in range(parameter.shape[0]):
        for j in range(parameter.shape[1]):
            average[i, j] += new_average * (gradient[i, j] - average[i, j])
            square[i, j] = old_square * square[i, j] + new_square * gradient[i, j] * gradient[i, j]
            parameter[i, j] -= rate * average[i, j] / (np.sqrt(square[i, j]) * correction + small)
        if tau > 0:
            for j in range(parameter.shape[1]):
                target[i, j] = old_target * target[i, j] + new_target * parameter[i, j]


@inner
def backward(learner: Learner, values: list[np.ndarray], gradient: np.ndarray, rates: Rates) -> None:
    """
    Teach a network, its last layer first.

    :param learner: the network and what belongs to it
    :param values: what ``forward`` returned
    :param gradient: (batch, out), of the loss by what the network returned
    :param rates: of Adam and of the target
    """
    for layer in range(len(values) - 2, -1, -1):
        weight_gradient = product(gradient, values[layer], TURNED, AS_IT_IS)
        bias_gradient = column_sums(gradient)
        if layer > 0:
            # Before the weight learns: the gradient is that of the weight in use.
            gradient = back_to_relu(gradient, array_at(learner[0], 2 * layer), values[layer])
        step(learner, 2 * layer, weight_gradient, rates)
        step(learner, 2 * layer + 1, bias_gradient, rates)


@inlined
def update_critics(batch: Batch, actor_target: Network, critics: np.ndarray, noise_clip: float, rates: Rates) -> float:
    """
    Teach all critics the same values.

    :param batch: what they learn from
    :param actor_target: the target of the actor
    :param critics: one or more learners, (critics, 5, parameters, 3)
    :param noise_clip: the most that noise changes a next action by
    :param rates: of the critics
    :return: the mean squared error, summed over critics
    """
    observations, actions, next_observations, noise, rewards, discounts = batch
    n = len(rewards)
    most = np.float32(noise_clip)
    # Select actions by the target of the actor, and add noise.
    next_actions = forward(actor_target, next_observations)[-1]
    for i in range(n):
        for j in range(next_actions.shape[1]):
            next_action = math.tanh(next_actions[i, j]) + max(-most, min(noise[i, j], most))
            if next_action < -1:
                next_action = np.float32(-1)
            if next_action > 1:
                next_action = np.float32(1)
            next_actions[i, j] = next_action
    next_inputs = side_by_side(next_observations, next_actions)
    # The next values are the smallest that a critic's target gives.
    next_values = forward(critics[0][1], next_inputs)[-1]
    for k in range(1, len(critics)):
        others = forward(critics[k][1], next_inputs)[-1]
        for i in range(n):
            if others[i, 0] < next_values[i, 0] or np.isnan(others[i, 0]):
                next_values[i, 0] = others[i, 0]
    # Move each critic towards them.
    inputs = side_by_side(observations, actions)
    loss = 0.0
    for k in range(len(critics)):
        values = forward(critics[k][0], inputs)
        gradient = values[-1]
        for i in range(n):
            error = gradient[i, 0] - (rewards[i, 0] + discounts[i, 0] * next_values[i, 0])
            loss += error * error / n
            gradient[i, 0] = np.float32(2 / n) * error
        backward(critics[k], values, gradient, rates)
    return loss


@inlined
def update_actor(observations: np.ndarray, actor: Learner, critic: Network, penalty: float, rates: Rates) -> float:
    """
    Teach the actor to climb a critic.

    :param observations: (batch, observation)
    :param actor: the actor
    :param critic: the critic
    :param penalty: weight, in the loss, of the mean squared norm of what the actor's tanh is given
    :param rates: of the actor
    :return: the loss
    """
    n, n_observations = observations.shape
    values = forward(actor[0], observations)
    before_tanh = values[-1]
    actions = np.empty(before_tanh.shape, np.float32)
    loss = 0.0
    for i in range(n):
        for j in range(actions.shape[1]):
            actions[i, j] = math.tanh(before_tanh[i, j])
            loss += penalty * before_tanh[i, j] * before_tanh[i, j] / n
    critic_values = forward(critic, side_by_side(observations, actions))
    # Go back through the critic, which does not learn, to the actions among its inputs.
    gradient = critic_values[-1]
    for i in range(n):
        loss -= gradient[i, 0] / n
        gradient[i, 0] = np.float32(-1 / n)
    for layer in range(len(critic_values) - 2, 0, -1):
        gradient = back_to_relu(gradient, array_at(critic, 2 * layer), critic_values[layer])
    by_inputs = product(gradient, array_at(critic, 0), AS_IT_IS, AS_IT_IS)
    # Go back through the tanh, before which the penalty comes in.
    by_actions = np.empty(actions.shape, np.float32)
    for i in range(n):
        for j in range(actions.shape[1]):
            slope = np.float32(1) - actions[i, j] * actions[i, j]
            by_actions[i, j] = by_inputs[i, n_observations + j] * slope + np.float32(2 * penalty / n) * before_tanh[i, j]
    backward(actor, values, by_actions, rates)
    return loss


@compiled
def update(
    batch: Batch,
    actor: Learner,
    critics: np.ndarray,
    actor_rates: Rates,
    critic_rates: Rates,
    noise_clip: float,
    penalty: float,
    with_actor: bool,
) -> tuple[float, float]:
    """
    Do one update.

    :param batch: what they learn from
    :param actor: the actor
    :param critics: one or more learners, (critics, 5, parameters, 3)
    :param actor_rates: of the actor
    :param critic_rates: of the critics
    :param noise_clip: see ``update_critics``
    :param penalty: see ``update_actor``
    :param with_actor: whether the actor learns, too
    :return: the critics' loss and the actor's (NaN without the actor)
    """
    critic_loss = update_critics(batch, actor[1], critics, noise_clip, critic_rates)
    if not with_actor:
        return critic_loss, math.nan
    return critic_loss, update_actor(batch[0], actor, critics[0][0], penalty, actor_rates)
