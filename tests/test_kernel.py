"""The compiled update is held to the reference, and to what torch keeps."""

import copy
import ctypes

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from learners import by_torch, distance, fill, make, same, train
from numba import njit
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_skillgraph.options import blas, kernel
from sb3_skillgraph.options.compiling import compiled
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3

pytestmark = pytest.mark.usefixtures("one_thread")


def twins(cls, net_arch, **kwargs):
    """The same model twice, one to be updated by the kernel and one by the reference."""
    return make(cls, net_arch, **kwargs), by_torch(make(cls, net_arch, **kwargs))


def moment_distance(a, b):
    pairs = zip(
        [*a.actor.optimizer.state.values(), *a.critic.optimizer.state.values()],
        [*b.actor.optimizer.state.values(), *b.critic.optimizer.state.values()],
        strict=True,
    )
    return max((s[key] - t[key]).abs().max().item() for s, t in pairs for key in ("step", "exp_avg", "exp_avg_sq"))


@pytest.mark.parametrize("penalty", [0.0, 0.02])
@pytest.mark.parametrize("cls", [OptionDDPG, OptionTD3])
def test_two_hundred_updates_are_the_references(cls, penalty):
    """
    Of three runs the one in the middle: a unit that is zero to the last digit may fall to either side, which Adam then
    amplifies. It happens to one run in eight or so, to another one on each kind of processor.
    """
    runs = []
    for seed in (1, 2, 3):
        a, b = twins(cls, [64, 64], saturation_penalty=penalty)
        start = copy.deepcopy(a)
        for model in (a, b):
            train(model, 200, seed=seed)
        assert a.update_path == "kernel"
        assert distance(a, start) > 1e-2
        runs.append((distance(a, b), a, b))
    difference, a, b = sorted(runs, key=lambda run: run[0])[1]
    assert difference <= 1e-5
    assert moment_distance(a, b) <= 1e-4
    assert a.logger.name_to_value.keys() == b.logger.name_to_value.keys()
    for name, value in b.logger.name_to_value.items():
        assert a.logger.name_to_value[name] == pytest.approx(value, rel=1e-4, abs=1e-5), name


@pytest.mark.parametrize("cls", [OptionDDPG, OptionTD3])
def test_large_networks_are_the_references(cls):
    """Fewer updates: a unit that is zero to the last digit may fall to either side, which Adam then amplifies."""
    a, b = twins(cls, [400, 300], n_obs=31, n_act=8, saturation_penalty=0.02)
    for model in (a, b):
        train(model, 20, batch_size=64)
    assert distance(a, b) <= 1e-5


@pytest.mark.parametrize("net_arch", [[], [24], [24, 16], {"pi": [24, 16, 12], "qf": [16]}])
def test_any_depth(net_arch):
    a, b = twins(OptionTD3, net_arch, saturation_penalty=0.02)
    for model in (a, b):
        train(model, 40)
    assert a.update_path == "kernel"
    assert distance(a, b) <= 1e-5


def test_noise_delay_and_tau_are_those_of_the_model():
    settings = {"policy_delay": 3, "target_policy_noise": 0.5, "target_noise_clip": 0.1, "tau": 0.2, "gamma": 0.5}
    a, b = twins(OptionTD3, [16], **settings)
    plain = make(OptionTD3, [16])
    for model in (a, b, plain):
        train(model, 40)
    assert distance(a, b) <= 1e-5
    assert distance(a, plain) > 1e-3


def test_targets_and_actor_wait_for_their_turn():
    model = make(OptionTD3, [16])
    before = copy.deepcopy(model.policy.state_dict())
    train(model, 1)
    moved = {name.split(".")[0] for name, value in model.policy.state_dict().items() if not th.equal(value, before[name])}
    assert moved == {"critic"}
    assert "train/actor_loss" not in model.logger.name_to_value
    train(model, 1)
    moved = {name.split(".")[0] for name, value in model.policy.state_dict().items() if not th.equal(value, before[name])}
    assert moved == {"actor", "actor_target", "critic", "critic_target"}


def test_batches_of_any_size():
    a, b = twins(OptionDDPG, [16])
    for batch_size in (1, 32, 7, 500, 32):
        for model in (a, b):
            train(model, 5, batch_size=batch_size)
    assert distance(a, b) <= 1e-5


def test_one_number_in_and_one_out():
    a, b = twins(OptionDDPG, [1], n_obs=1, n_act=1)
    for model in (a, b):
        train(model, 20)
    assert distance(a, b) <= 1e-5


def test_a_moment_that_is_turned_over_where_it_lies_is_refused():
    model = make(OptionTD3, [16, 16])
    train(model, 2)
    moment = model.actor.optimizer.state[model.actor.mu[2].weight]["exp_avg"]
    moment.data = moment.data.t()
    with pytest.raises(ValueError, match="not contiguous"):
        train(model, 1)


def load_moments(a, b):
    for x, y in ((a.actor, b.actor), (a.critic, b.critic)):
        x.optimizer.load_state_dict(copy.deepcopy(y.optimizer.state_dict()))


def empty_moments(a, b):
    a.actor.optimizer.state.clear()
    b.actor.optimizer.state.clear()


def reset_steps(a, b):
    for model in (a, b):
        for state in model.critic.optimizer.state.values():
            state["step"] = th.tensor(0.0)


def swap_optimizers(a, b):
    for model in (a, b):
        model.actor.optimizer = th.optim.Adam(model.actor.parameters(), lr=1.0)
        model.critic.optimizer = th.optim.Adam(model.critic.parameters(), lr=1.0, betas=(0.5, 0.9))


def swap_parameters(a, b):
    for model in (a, b):
        for parameter in model.policy.parameters():
            parameter.data = parameter.data * 0.5


def load_parameters(a, b):
    other = make(OptionTD3, [16], seed=9)
    train(other, 7)
    for model in (a, b):
        model.set_parameters(copy.deepcopy(other.get_parameters()))


def transpose_a_parameter(a, b):
    for model in (a, b):
        weight = model.actor.mu[0].weight
        weight.data = weight.data.t().contiguous().t()


def move_a_moment(a, b):
    for model in (a, b):
        moment = next(iter(model.critic.optimizer.state.values()))["exp_avg"]
        moment.data = moment.data + 1


@pytest.mark.parametrize(
    "change",
    [
        load_moments,
        empty_moments,
        reset_steps,
        swap_optimizers,
        swap_parameters,
        load_parameters,
        move_a_moment,
        transpose_a_parameter,
    ],
)
@pytest.mark.filterwarnings("ignore:Options learn by torch")
def test_what_is_put_in_place_of_parameters_and_moments_is_used(change):
    a, b = twins(OptionTD3, [16])
    for model in (a, b):
        train(model, 5)
    change(a, b)
    before = copy.deepcopy(a.policy.state_dict())
    for model in (a, b):
        train(model, 6, seed=2)
    assert all(not th.equal(before[name], value) for name, value in a.policy.state_dict().items())
    assert a.update_path == ("reference" if change is transpose_a_parameter else "kernel")
    assert distance(a, b) <= 1e-5
    assert moment_distance(a, b) <= 1e-4


@pytest.mark.filterwarnings("ignore:Options learn by torch")
def test_a_frozen_layer_stays_as_it_is():
    model = make(OptionTD3, [16])
    layer = model.critic.q_networks[0][0].requires_grad_(False)
    before = layer.weight.clone()
    train(model, 4)
    assert model.update_path == "reference"
    assert th.equal(layer.weight, before)


def tensors_of(model):
    optimizers = (model.actor.optimizer, model.critic.optimizer)
    moments = [moment for adam in optimizers for state in adam.state.values() for moment in state.values()]
    return [*model.policy.state_dict().values(), *moments]


def short_moment(model):
    model.critic.optimizer.state[model.critic.q_networks[1][0].weight]["exp_avg_sq"] = th.zeros(3, 3)
    return r"exp_avg_sq of parameter 0 of critic 1 has the shape \(3, 3\), not \(16, 8\)"


def moment_of_another_layer(model):
    states = model.actor.optimizer.state
    states[model.actor.mu[0].weight]["exp_avg"] = states[model.actor.mu[2].weight]["exp_avg"]
    return r"exp_avg of parameter 0 of the actor has the shape \(2, 16\), not \(16, 6\)"


def transposed_moment(model):
    state = model.actor.optimizer.state[model.actor.mu[0].weight]
    state["exp_avg"] = state["exp_avg"].t().contiguous().t()
    return "exp_avg of parameter 0 of the actor is not contiguous float32"


def double_moment(model):
    state = model.actor.optimizer.state[model.actor.mu[0].bias]
    state["exp_avg"] = state["exp_avg"].double()
    return "exp_avg of parameter 1 of the actor is not contiguous float32"


def vector_of_steps(model):
    model.actor.optimizer.state[model.actor.mu[0].weight]["step"] = th.zeros(1)
    return r"step of parameter 0 of the actor has the shape \(1,\), not \(\)"


def short_parameter(model):
    model.actor.mu[0].bias.data = th.zeros(2)
    return r"value of parameter 1 of the actor has the shape \(2,\), not \(16,\)"


def short_target(model):
    model.critic_target.q_networks[0][2].weight.data = th.zeros(1, 15)
    return r"target of parameter 2 of critic 0 has the shape \(1, 15\), not \(1, 16\)"


def other_actions(model):
    model.replay_buffer = ReplayBuffer(500, model.observation_space, spaces.Box(-1, 1, (3,), np.float32))
    fill(model.replay_buffer)
    return "cannot reshape array of size 96"


def other_observations(model):
    model.replay_buffer = ReplayBuffer(500, spaces.Box(-1, 1, (5,), np.float32), model.action_space)
    fill(model.replay_buffer)
    return "cannot reshape array of size 160"


@pytest.mark.parametrize(
    "spoil",
    [
        short_moment,
        moment_of_another_layer,
        transposed_moment,
        double_moment,
        vector_of_steps,
        short_parameter,
        short_target,
        other_actions,
        other_observations,
    ],
)
def test_a_wrong_shape_is_refused_before_anything_is_written(spoil):
    model = make(OptionTD3, [16])
    train(model, 2)
    message = spoil(model)
    before = [tensor.clone() for tensor in tensors_of(model)]
    with pytest.raises(ValueError, match=message):
        train(model, 2)
    assert all(map(th.equal, tensors_of(model), before))


def test_the_same_bits_however_often_it_is_copied():
    whole, copied = make(OptionTD3, [16]), make(OptionTD3, [16])
    train(whole, 4)
    train(copied, 4)
    copied = copy.deepcopy(copied)
    assert copied._compiled is None
    for model in (whole, copied):
        train(model, 4, seed=2)
    assert same(whole, copied)


def test_what_has_no_place_on_disk_is_compiled_all_the_same():
    namespace = {}
    exec("def twice(x): return 2 * x", namespace)  # numba finds no file to keep the result beside
    assert compiled(namespace["twice"])(4) == 8


def test_what_changes_at_the_networks_after_an_update_is_followed():
    """Parameters that learn no more, Adam's options and layouts are those of the update that comes."""
    changes = {
        "frozen": lambda model: model.actor.mu[0].requires_grad_(False),
        "decayed": lambda model: model.critic.optimizer.param_groups[0].update(weight_decay=0.5),
        "transposed": lambda model: setattr(model.actor.mu[2].weight, "data", model.actor.mu[2].weight.data.t()),
    }
    for name, change in changes.items():
        a, b = twins(OptionDDPG, [32, 32])
        for model in (a, b):
            train(model, 3)
            change(model)
            train(model, 3)
        assert a.update_path == "reference", name
        assert distance(a, b) < 1e-6, name


def test_asking_for_the_path_or_saving_builds_nothing(tmp_path):
    model = make(OptionDDPG, [16])
    assert model.update_path == "kernel"
    assert model._compiled is None
    assert not model.actor.optimizer.state


def test_a_moment_that_is_missing_is_named():
    model = make(OptionDDPG, [16])
    train(model, 1)
    del model.critic.optimizer.state[model.critic.q_networks[0][0].weight]["exp_avg_sq"]
    model._compiled = None
    with pytest.raises(ValueError, match="critic 0 has a parameter without one of exp_avg"):
        train(model, 1)


@njit  # and nothing kept on disk: it would be the product that was compiled with it
def multiply(left, right, left_turned, right_turned):
    return kernel.product(left, right, left_turned, right_turned)


@pytest.mark.parametrize("left_turned", [False, True])
@pytest.mark.parametrize("right_turned", [False, True])
def test_products(left_turned, right_turned):
    rng = np.random.default_rng(0)
    for m, k, n in ((1, 1, 1), (2, 3, 4), (64, 27, 1), (64, 27, 12), (7, 130, 33)):
        left, right = rng.normal(size=(m, k)).astype(np.float32), rng.normal(size=(k, n)).astype(np.float32)
        given = [np.ascontiguousarray(x.T) if turned else x for x, turned in ((left, left_turned), (right, right_turned))]
        result = multiply(*given, left_turned, right_turned)
        assert result.dtype == np.float32
        np.testing.assert_allclose(result, left @ right, rtol=1e-4, atol=1e-5)


def test_a_product_is_compiled_once_whatever_is_transposed():
    train(make(OptionTD3, [16]), 2)
    assert len(kernel.product.signatures) <= 1  # none where the update was found on disk
    assert len(kernel.multiply.signatures) <= 1


@pytest.mark.parametrize("whose", ["torch", "scipy"])
def test_whoever_multiplies(whose, monkeypatch):
    def none_such(path):
        raise OSError(path)

    if whose == "scipy":
        monkeypatch.setattr(blas.ctypes, "CDLL", none_such)
    pointer = ctypes.c_void_p
    sgemm = ctypes.CFUNCTYPE(None, *[pointer] * 13)(blas.find_sgemm())
    left, right, result = np.array([[1, 2], [3, 4]], "f"), np.array([[5, 6], [7, 8]], "f"), np.zeros((2, 2), "f")
    letters, size, factors = np.frombuffer(b"NN", np.uint8), np.array([2], np.int64), np.array([1, 0], "f")
    at = [x.ctypes.data for x in (letters, size, factors, right, left, result)]
    sgemm(at[0], at[0], at[1], at[1], at[1], at[2], at[3], at[1], at[4], at[1], at[2] + 4, at[5], at[1])
    np.testing.assert_array_equal(result, left @ right)
