import copy
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from learners import ACTOR_LR, CRITIC_LR, by_torch, distance, fill, make, same, train
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.logger import Logger

from sb3_skillgraph.options import learner as learner_module
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3
from sb3_skillgraph.options.numpy_actor import NumpyActor, is_vector_space

pytestmark = pytest.mark.usefixtures("one_thread")


def stock_twin(model, cls):
    """SB3's own model with the same weights, buffer and learning rates."""
    twin = make(cls, model.policy_kwargs["net_arch"], obs_shape=model.observation_space.shape)
    twin.__dict__.update({name: getattr(model, name) for name in ("tau", "gamma", "policy_delay", "replay_buffer")})
    twin.policy.load_state_dict(model.policy.state_dict())
    twin.policy.actor.optimizer.load_state_dict(copy.deepcopy(model.policy.actor.optimizer.state_dict()))
    twin.policy.critic.optimizer.load_state_dict(copy.deepcopy(model.policy.critic.optimizer.state_dict()))

    def update_learning_rate(optimizers):
        for optimizer, learning_rate in zip(optimizers, (ACTOR_LR, CRITIC_LR), strict=True):
            optimizer.param_groups[0]["lr"] = learning_rate
        twin.logger.record("train/learning_rate", CRITIC_LR)

    twin._update_learning_rate = update_learning_rate
    return twin


@pytest.mark.parametrize(
    "ours, stock, net_arch",
    [
        (OptionDDPG, DDPG, [64, 64]),
        (OptionDDPG, DDPG, [32]),
        (OptionDDPG, DDPG, {"pi": [24, 16, 8], "qf": [40, 24]}),
        (OptionDDPG, DDPG, []),
        (OptionTD3, TD3, [64, 64]),
        (OptionTD3, TD3, {"pi": [16], "qf": [32, 24, 16]}),
    ],
)
@pytest.mark.parametrize("path", ["kernel", "reference"])
def test_two_hundred_updates_are_sb3s(ours, stock, net_arch, path):
    a = make(ours, net_arch)
    b = stock_twin(a, stock)
    if path == "reference":
        by_torch(a)
    for seed in range(20):
        for model in (a, b):
            train(model, 10, seed=seed)
    assert a.update_path == path
    assert a._n_updates == b._n_updates == 200
    if path == "reference":
        assert same(a, b)
    else:
        assert distance(a, b) <= 1e-5
    assert a.logger.name_to_value.keys() == b.logger.name_to_value.keys()
    for name, value in b.logger.name_to_value.items():
        assert a.logger.name_to_value[name] == pytest.approx(value, rel=1e-4, abs=1e-5), name


@pytest.mark.parametrize("ours, stock", [(OptionDDPG, DDPG), (OptionTD3, TD3)])
def test_large_networks_are_sb3s(ours, stock):
    """Fewer updates: a unit that is zero to the last digit may fall to either side, which Adam then amplifies."""
    a = make(ours, [400, 300], n_obs=31, n_act=8)
    b = make(stock, [400, 300], n_obs=31, n_act=8)
    b.policy.load_state_dict(a.policy.state_dict())
    b._update_learning_rate = lambda optimizers: [
        optimizer.param_groups[0].update(lr=rate) for optimizer, rate in zip(optimizers, (ACTOR_LR, CRITIC_LR), strict=True)
    ]
    for model in (a, b):
        train(model, 20, batch_size=64)
    assert distance(a, b) <= 1e-5


@pytest.mark.parametrize("ours, stock", [(OptionDDPG, DDPG), (OptionTD3, TD3)])
def test_random_generators_end_where_sb3_leaves_them(ours, stock):
    a = make(ours, [8])
    ends = []
    for model in (a, by_torch(make(ours, [8])), stock_twin(a, stock)):
        train(model, 3)
        ends.append((th.rand(1).item(), np.random.rand()))  # noqa: NPY002
    assert ends[0] == ends[1] == ends[2]


@pytest.mark.parametrize("ours, stock", [(OptionDDPG, DDPG), (OptionTD3, TD3)])
def test_discounts_in_the_samples(ours, stock):
    a = make(ours, [32, 32])
    a.replay_buffer = NStepReplayBuffer(500, a.observation_space, a.action_space, n_steps=3, gamma=0.9)
    fill(a.replay_buffer)
    b = stock_twin(a, stock)
    for model in (a, b):
        train(model, 30)
    assert distance(a, b) <= 1e-5


def test_observations_of_two_dimensions_and_three_critics():
    a = make(OptionTD3, [16, 16], obs_shape=(2, 3), policy_kwargs={"n_critics": 3}, policy_delay=3)
    b = make(TD3, [16, 16], obs_shape=(2, 3), policy_kwargs={"n_critics": 3}, policy_delay=3)
    b.policy.load_state_dict(a.policy.state_dict())
    a.actor_learning_rate = a.critic_learning_rate = b.learning_rate
    for model in (a, b):
        train(model, 30)
    assert distance(a, b) <= 1e-5


def test_optimizer_settings_are_respected():
    settings = {"optimizer_kwargs": {"betas": (0.8, 0.99), "eps": 1e-5}}
    a, b = make(OptionDDPG, [16], policy_kwargs=settings), make(DDPG, [16], policy_kwargs=settings)
    a.actor_learning_rate = a.critic_learning_rate = b.learning_rate
    for model in (a, b):
        train(model, 30)
    assert a.update_path == "kernel"
    assert distance(a, b) <= 1e-5


@pytest.mark.parametrize("cls", [OptionDDPG, OptionTD3])
def test_the_same_seed_gives_the_same_bits(cls):
    a, b = make(cls, [400, 300]), make(cls, [400, 300])
    for model in (a, b):
        train(model, 10)
    assert same(a, b)


@pytest.mark.parametrize("cls", [OptionDDPG, OptionTD3])
def test_a_saved_model_goes_on_as_if_never_saved(cls, tmp_path):
    whole = make(cls, [48, 32])
    train(whole, 15)
    whole.save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model")
    assert (loaded.actor_learning_rate, loaded.critic_learning_rate) == (ACTOR_LR, CRITIC_LR)
    loaded.set_logger(Logger(None, []))
    fill(loaded.replay_buffer)
    for model in (whole, loaded):
        train(model, 15, seed=2)
    assert same(whole, loaded)


def test_loading_into_a_model_that_has_trained():
    a, b = make(OptionTD3, [16]), make(OptionTD3, [16], seed=5)
    train(a, 7)
    train(b, 4)
    b.set_parameters(copy.deepcopy(a.get_parameters()))
    b._n_updates = a._n_updates
    for model in (a, b):
        train(model, 7, seed=2)
    assert same(a, b)


def test_sb3_goes_on_from_our_optimizer_and_we_from_sb3s():
    a = make(OptionDDPG, [16])
    train(a, 10)
    b = stock_twin(a, DDPG)
    for model in (a, b):
        train(model, 10, seed=2)
    assert distance(a, b) <= 1e-6
    assert [s["step"].item() for s in b.actor.optimizer.state.values()] == [20] * 4
    a.set_parameters(copy.deepcopy(b.get_parameters()))
    for model in (a, b):
        train(model, 10, seed=3)
    assert distance(a, b) <= 1e-6


def test_state_dicts_are_live():
    model = make(OptionDDPG, [16])
    train(model, 1)
    policy, optimizer = model.policy.state_dict(), model.critic.optimizer.state_dict()["state"]
    before = copy.deepcopy((policy, optimizer))
    train(model, 1)
    assert all(not th.equal(policy[name], before[0][name]) for name in policy)
    assert optimizer[0]["step"] == 2 and before[1][0]["step"] == 1
    assert not th.equal(optimizer[0]["exp_avg"], before[1][0]["exp_avg"])
    with th.no_grad():
        for value in policy.values():
            value.zero_()
    assert not any(parameter.any() for parameter in model.policy.parameters())


def test_an_optimizer_emptied_by_hand_starts_again():
    model = make(OptionDDPG, [16])
    train(model, 3)
    model.actor.optimizer.state.clear()
    train(model, 2)
    assert [state["step"].item() for state in model.actor.optimizer.state.values()] == [2] * 4


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))])
def test_copies_are_independent_and_learn_alike(duplicate):
    model = make(OptionTD3, [16])
    train(model, 5)
    copied = duplicate(model)
    before = copy.deepcopy(model.policy.state_dict())
    train(copied, 5, seed=2)
    assert all(th.equal(before[name], value) for name, value in model.policy.state_dict().items())
    train(model, 5, seed=2)
    assert same(model, copied)
    assert [state["step"].item() for state in copied.critic.optimizer.state.values()] == [10] * 8


def test_each_optimizer_keeps_its_learning_rate():
    model = make(OptionDDPG, [16])
    rates = lambda: (model.actor.optimizer.param_groups[0]["lr"], model.critic.optimizer.param_groups[0]["lr"])  # noqa: E731
    assert rates() == (ACTOR_LR, CRITIC_LR)
    train(model, 1)
    assert rates() == (ACTOR_LR, CRITIC_LR)
    model.actor_learning_rate = 0.0
    before = copy.deepcopy(model.actor.state_dict())
    train(model, 1)
    assert all(th.equal(before[name], value) for name, value in model.actor.state_dict().items())


def test_default_learning_rates_are_the_papers_and_replace_sb3s():
    model = OptionDDPG("MlpPolicy", "Pendulum-v1", buffer_size=10)
    assert (model.actor_learning_rate, model.critic_learning_rate) == (1e-4, 1e-3)
    with pytest.raises(TypeError, match="learning_rate"):
        OptionDDPG("MlpPolicy", "Pendulum-v1", learning_rate=1e-3)


@pytest.mark.parametrize("cls", [OptionDDPG, OptionTD3])
def test_learns_by_itself_and_round_trips(cls, tmp_path):
    model = cls("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [16]}, buffer_size=500, seed=0).learn(300)
    assert model.update_path == "kernel"
    model.save(tmp_path / "model.zip")
    loaded = cls.load(tmp_path / "model.zip", env=model.get_env())
    observation = np.ones((4, 3), np.float32)
    assert np.array_equal(model.predict(observation)[0], loaded.predict(observation)[0])
    loaded.learn(120, reset_num_timesteps=False)
    assert loaded._n_updates > model._n_updates


@pytest.mark.parametrize(
    "policy_kwargs, reason",
    [
        ({"activation_fn": th.nn.Tanh}, "Linear and ReLU"),
        ({"optimizer_class": th.optim.SGD}, "not Adam"),
        ({"optimizer_kwargs": {"amsgrad": True}}, "amsgrad"),
        ({"optimizer_kwargs": {"weight_decay": 1e-2}}, "weight_decay"),
    ],
)
def test_what_is_not_covered_falls_back_with_one_warning(policy_kwargs, reason):
    learner_module._warn_once.cache_clear()
    a = make(OptionDDPG, [8], policy_kwargs=policy_kwargs)
    b = make(DDPG, [8], policy_kwargs=policy_kwargs)
    a.actor_learning_rate = a.critic_learning_rate = b.learning_rate
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for model in (a, make(OptionDDPG, [8], policy_kwargs=policy_kwargs), b):
            train(model, 5)
            train(model, 5)
    ours = [str(warning.message) for warning in caught if "slower update" in str(warning.message)]
    assert len(ours) == 1 and reason in ours[0]
    assert a.update_path == "reference"
    assert distance(a, b) == 0


@pytest.mark.parametrize(
    "space",
    [spaces.MultiDiscrete([3, 3]), spaces.Box(0, 255, (8, 8, 1), np.uint8), spaces.Dict({"a": spaces.Box(-1, 1)})],
)
def test_observations_that_sb3_rewrites_are_left_to_it(space):
    assert not is_vector_space(space)


def test_the_buffer_may_hold_float64():
    a, b = make(OptionDDPG, [16]), make(OptionDDPG, [16])
    space = spaces.Box(-np.inf, np.inf, (6,), np.float64)
    a.replay_buffer, b.replay_buffer = (
        ReplayBuffer(500, space, a.action_space),
        ReplayBuffer(500, space, a.action_space),
    )
    fill(a.replay_buffer)
    fill(b.replay_buffer)
    b.replay_buffer.observations = b.replay_buffer.observations.astype(np.float32)
    b.replay_buffer.next_observations = b.replay_buffer.next_observations.astype(np.float32)
    for model in (a, b):
        train(model, 5)
    assert same(a, b)


@pytest.mark.parametrize("cls, kwargs", [(OptionDDPG, {}), (TD3, {}), (SAC, {"target_entropy": -2.0})])
def test_numpy_actor_acts_as_predict_does(cls, kwargs):
    model = make(cls, [64, 48], **kwargs)
    actor = NumpyActor(model.policy.actor)
    assert actor._layers
    observations = np.random.default_rng(0).normal(size=(7, 6)).astype(np.float32)
    for _ in range(2):
        for batch in (observations, observations[:1], observations.astype(np.float64)):
            actions = actor.act(batch)
            expected = model.policy.scale_action(model.predict(batch.astype(np.float32), deterministic=True)[0])
            assert actions.dtype == np.float32 and actions.shape == (len(batch), 2)
            assert np.abs(actions - expected).max() <= 1e-6
        train(model, 20)


def test_numpy_actor_follows_weights_that_move():
    model, other = make(OptionDDPG, [16]), make(OptionDDPG, [16], seed=3)
    actor, observation = NumpyActor(model.policy.actor), np.ones((1, 6), np.float32)
    copied = copy.deepcopy(actor)
    first = actor.act(observation)
    for parameter, new in zip(model.actor.parameters(), other.actor.parameters(), strict=True):
        parameter.data = new.data.clone()
    assert np.array_equal(actor.act(observation), NumpyActor(other.policy.actor).act(observation))
    assert np.array_equal(copied.act(observation), first)


def test_numpy_actor_asks_torch_about_other_networks():
    tanh = make(OptionDDPG, [16], policy_kwargs={"activation_fn": th.nn.Tanh})
    for model in (tanh, make(SAC, [16], use_sde=True, target_entropy=-2.0)):
        actor, observations = NumpyActor(model.policy.actor), np.ones((3, 6), np.float32)
        assert not actor._layers
        assert np.allclose(actor.act(observations), model.predict(observations, deterministic=True)[0], atol=1e-6)


@pytest.mark.parametrize("path", ["kernel", "reference"])
@pytest.mark.parametrize("ours", [OptionDDPG, OptionTD3])
def test_the_saturation_penalty_is_the_mean_squared_norm_before_the_tanh(ours, path):
    """The first moments of Adam after one update are a tenth of the gradient."""
    model = make(ours, [64, 64], saturation_penalty=0.1, critic_learning_rate=0.0)
    model.policy_delay = 1
    if path == "reference":
        by_torch(model)
    with th.no_grad():
        model.actor.mu[-2].bias.fill_(2.0)
    np.random.seed(1)  # noqa: NPY002
    data = model.replay_buffer.sample(32)
    before_tanh = model.actor.mu[:-1](data.observations)
    value = model.critic.q1_forward(data.observations, before_tanh.tanh()).mean()
    loss = -value + 0.1 * before_tanh.pow(2).sum(dim=1).mean()
    expected = th.autograd.grad(loss, list(model.actor.mu.parameters()))
    train(model, 1, seed=1)
    assert model.update_path == path
    assert model.logger.name_to_value["train/actor_loss"] == pytest.approx(loss.item(), rel=1e-5)
    for state, gradient in zip(model.actor.optimizer.state.values(), expected, strict=True):
        np.testing.assert_allclose(10 * state["exp_avg"].numpy(), gradient.numpy(), atol=1e-6)


def test_a_saturation_penalty_needs_a_tanh_that_can_be_told_from_the_rest():
    model = by_torch(make(OptionDDPG, [8], saturation_penalty=0.1))
    model.actor.mu = model.actor.mu[:-1]
    with pytest.raises(ValueError, match="saturation_penalty"):
        train(model, 1)
    model.saturation_penalty = 0.0
    train(model, 1)


@pytest.mark.parametrize("path", ["kernel", "reference"])
def test_denormal_numbers_are_flushed_and_the_flag_restored(path):
    model = make(OptionDDPG, [16, 16])
    if path == "reference":
        by_torch(model)
    train(model, 1)
    with th.no_grad():
        model.critic.q_networks[0][0].bias.fill_(-1e6)  # no unit of the first layer lives: no gradient for its weights
    moment = model.critic.optimizer.state[model.critic.q_networks[0][0].weight]["exp_avg"]
    moment.fill_(1e-40)
    assert moment.view(th.int32).all()
    train(model, 1)
    assert not moment.view(th.int32).any()
    assert (th.tensor(1e-38) * 0.01).view(th.int32).item() != 0


def test_without_numba_the_reference_learns_and_says_so_once(monkeypatch):
    learner_module._warn_once.cache_clear()
    monkeypatch.delitem(sys.modules, "sb3_skillgraph.options.compiled_update", raising=False)
    monkeypatch.delitem(sys.modules, "sb3_skillgraph.options.kernel", raising=False)
    monkeypatch.delattr("sb3_skillgraph.options.kernel", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    a, b = make(OptionTD3, [16]), by_torch(make(OptionTD3, [16]))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for model in (a, b, make(OptionTD3, [16])):
            train(model, 4)
            train(model, 4)
    hints = [str(warning.message) for warning in caught if "numba" in str(warning.message)]
    assert len(hints) == 1 and 'pip install "sb3_skillgraph[fast]"' in hints[0]
    assert a.update_path == "reference"
    assert same(a, b)


def test_importing_the_package_imports_nothing_that_takes_long_and_may_not_be_used():
    slow = {"numba", "sklearn", "matplotlib", "networkx", "mujoco", "gymnasium_robotics", "scipy.stats", "scipy.sparse"}
    code = f"""
import sys, stable_baselines3
before = set(sys.modules)
import sb3_skillgraph, sb3_skillgraph.options.learner
print(sorted((set(sys.modules) - before) & {slow}))
"""
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip() == "[]"


def test_no_steps_are_no_updates():
    model = make(OptionDDPG, [16])
    train(model, 0)
    assert model._n_updates == 0
    assert "train/critic_loss" not in model.logger.name_to_value
